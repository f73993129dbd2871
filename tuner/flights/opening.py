"""Open a recording with the reader of what it is, whatever its name says."""

from __future__ import annotations

from pathlib import Path

from tuner.errors import RecordingError
from tuner.flights.recording import Recording


def open_recording(path: Path, messages: tuple[Path, ...] = ()) -> Recording:
    """Open a recording by what it begins with.

    Parameters
    ----------
    path
        A file, or a folder as ROS 2 writes it.
    messages
        ``.msg`` files, or folders of them, for ROS types that the recording does not define.

    Raises
    ------
    RecordingError
        It is missing, unreadable or of no known kind.
    """
    # Each format's library is imported for that format only: together they take half a second.
    try:
        if path.is_dir():
            from tuner.flights.ros.folder import Folder  # noqa: PLC0415
            from tuner.flights.ros.recording import RosRecording  # noqa: PLC0415

            return RosRecording(path, Folder(path), messages)
        with path.open("rb") as stream:
            start = stream.read(4096)
        if start.startswith(b"#ROSBAG") or (path.suffix == ".bag" and not start):
            from tuner.flights.ros.bag1 import Bag1  # noqa: PLC0415
            from tuner.flights.ros.recording import RosRecording  # noqa: PLC0415

            return RosRecording(path, Bag1(path), messages)
        if start.startswith((b"\x89MCAP", b"SQLite format 3")):
            from tuner.flights.ros.folder import open_file  # noqa: PLC0415
            from tuner.flights.ros.recording import RosRecording  # noqa: PLC0415

            return RosRecording(path, open_file(path), messages)
        if start.startswith(b"ULog"):
            from tuner.flights.ulog import ULogRecording  # noqa: PLC0415

            return ULogRecording(path)
        if start.startswith(b"PAR1") or _is_text(start):
            from tuner.flights.table import Table  # noqa: PLC0415

            return Table(path)
    except OSError as err:
        said = "no such file" if isinstance(err, FileNotFoundError) else err.strerror or str(err)
        raise RecordingError(path, said, "check the path") from None
    said = "is empty" if not start else "is of no known kind"
    if start.startswith((b"\x1f\x8b", b"PK\x03\x04", b"BZh", b"\xfd7zXZ")):
        raise RecordingError(path, "is packed", "unpack it first")
    raise RecordingError(
        path, said, "known are ROS 1 .bag, ROS 2 folders, .db3 and .mcap, .ulg, .csv and .parquet"
    )


def _is_text(start: bytes) -> bool:
    """Tell whether a file can be a table: text with a separator in its first line."""
    line, _, _ = start.partition(b"\n")
    printable = all(byte >= 32 or byte in b"\r\n\t" for byte in start)
    return printable and any(separator in line for separator in b",;\t")
