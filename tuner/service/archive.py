"""A job's files as one archive, made while it is sent: no more than a block of it is held."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath

from tuner.core.disk import file_name
from tuner.service.store import Store
from tuner.service.tables import FileRow

BLOCK = 1 << 20
"""bytes that are read at a time"""


class _Passing(io.RawIOBase):
    """A file that hands on what is written to it, and cannot go back."""

    def __init__(self) -> None:
        self._written: list[bytes] = []
        self._position = 0

    def writable(self) -> bool:
        return True

    def write(self, content: object) -> int:
        raw = bytes(content)  # type: ignore[call-overload]
        self._written.append(raw)
        self._position += len(raw)
        return len(raw)

    def tell(self) -> int:
        return self._position

    def taken(self) -> bytes:
        """Return what was written since the last time."""
        raw, self._written = b"".join(self._written), []
        return raw


def zipped(store: Store, files: Sequence[FileRow], folder: str) -> Iterator[bytes]:
    """Yield an archive of stored files, in a folder of a name, under plain names.

    Parameters
    ----------
    store
        With the files.
    files
        Of a job.
    folder
        What the archive unpacks to: a plain name.
    """
    passing = _Passing()
    with zipfile.ZipFile(passing, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            parts = [file_name(part) for part in PurePosixPath(file.name).parts]
            entry = zipfile.ZipInfo("/".join([folder, *parts]))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            with (
                store.reading(file.sha256) as stream,
                archive.open(entry, "w", force_zip64=file.size > 2**31 - 1) as target,
            ):
                while block := stream.read(BLOCK):
                    target.write(block)
                    yield passing.taken()
    yield passing.taken()
