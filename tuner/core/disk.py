"""The file system: what is written appears whole, a refusal becomes one line, globs become paths.

Standard library only, so that a recording seen before is answered before anything heavy is loaded.
"""

from __future__ import annotations

import datetime
import errno
import glob
import hashlib
import itertools
import os
import re
import secrets
import stat
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from tuner.core.errors import ConfigError, InputError, OutputError, RecordingError

MAX_NAME_LETTERS = 100
"""Letters of a file's name that is made of another name, its suffix included."""
_PLAIN = re.compile(r"\w(?:[\w.-]*[\w-])?", re.ASCII)


def file_name(name: str, suffix: str = "") -> str:
    """Return a file's name for what a recording, a file or a request calls something.

    It has ASCII letters, digits, ``_``, ``-`` and dots inside it, and begins with no dot or dash. A
    plain name is kept. Another is made plain and gets some digits of its digest, so that two names
    do not come to one file.
    """
    most = MAX_NAME_LETTERS - len(suffix)
    if len(name) <= most and _PLAIN.fullmatch(name):
        return name + suffix
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    plain = re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII).lstrip(".-")[: most - 1 - len(digest)]
    return f"{plain or 'unnamed'}-{digest}{suffix}"


def inside(folder: Path, name: str) -> Path:
    """Return the path of a name below a folder, once it is sure that it lies there.

    Raises
    ------
    OutputError
        The name, or a link that stands there, leads elsewhere.
    """
    path = folder / name
    with _refusals(path):
        if "\0" not in name and "\\" not in name:
            place, whole = path.resolve(), folder.resolve()
            if whole in place.parents:
                return path
    raise OutputError(repr(name), f"leads out of {folder}", "name a file inside it")


def check_links(folder: Path, names: Iterable[str]) -> None:
    """Refuse a folder of others if a symbolic link among some files and folders leads out of it.

    Raises
    ------
    InputError
        One does: what is read or written there would lie elsewhere.
    """
    whole = folder.resolve()
    for path in (path for name in names for path in _with_all_in(folder / name)):
        if path.is_symlink() and not path.resolve().is_relative_to(whole):
            what = f"is a link that leads out of {folder}"
            raise InputError(path, what, "put what it leads to in its place, or remove it")


def _with_all_in(path: Path) -> Iterator[Path]:
    yield path  # before the walk, which would follow a link
    for place, *kinds in os.walk(path):
        yield from (Path(place, name) for names in kinds for name in names)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8 that appears whole or not at all.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    with whole_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8", newline="")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give the path of an unfinished file beside ``path`` that takes its place in the end.

    A link stays one: what it leads to is written. Its folder is made where there is none. If
    anything fails before, what stood at ``path`` stays as it was and nothing is left beside it.

    Raises
    ------
    OutputError
        The system refuses to write there.
    """
    with _refusals(path):
        _check_kind(path)
        path = Path(os.path.realpath(path))
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f".{secrets.token_hex(8)}{path.suffix}")
        mode = path.stat().st_mode & 0o777 if path.is_file() else None
        unfinished.touch(0o666 if mode is None else 0o600, exist_ok=False)  # less the user's umask
        try:
            yield unfinished
            if mode is not None:
                unfinished.chmod(mode)
            unfinished.replace(path)
        finally:
            unfinished.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, where they do not exist yet.

    Raises
    ------
    OutputError
        A file is in the way, or the system refuses.
    """
    with _refusals(path):
        path.mkdir(parents=True, exist_ok=True)


def check_folder(path: Path) -> None:
    """Refuse a folder that could not be made or written to, without making it.

    Raises
    ------
    OutputError
        A file is in the way, or the system refuses.
    """
    with _refusals(path):
        if _is_regular_file(path) and not path.is_dir():
            raise OSError(errno.EEXIST, "")
        _check_writable(path)


def check_file(path: Path) -> None:
    """Refuse a file that `whole_file` could not write, without touching it.

    Raises
    ------
    OutputError
        It is a folder, or the system refuses.
    """
    with _refusals(path):
        if _is_regular_file(path):
            if path.is_dir():
                raise OSError(errno.EISDIR, "")
            if not os.access(path, os.W_OK):
                raise OSError(errno.EACCES, "")
            _check_kind(path)
        _check_writable(Path(os.path.realpath(path)).parent)


def _check_kind(path: Path) -> None:
    """Raise what the system would not say to a file in the place of a device or a pipe."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "")


def _check_writable(folder: Path) -> None:
    """Raise what the system would say to something new in a folder that may not exist yet."""
    whole = folder.absolute()
    nearest = next(above for above in (whole, *whole.parents) if _is_regular_file(above))
    if not nearest.is_dir():
        raise OSError(errno.ENOTDIR, "")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, "")


def _is_regular_file(path: Path) -> bool:
    """Return whether something has this path; a refusal to look is raised as it is."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:  # it could stand in no report
        raise OSError(errno.EILSEQ, "its name is not UTF-8") from None
    if len(str(path).splitlines()) > 1:  # it would be two lines in every heading and table
        raise OSError(errno.EILSEQ, "its path has a line break")
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a null byte
        return False
    return True


#: The operating system's refusals to write: why, and what to do.
_REFUSALS = {
    errno.EACCES: ("this user may not write there", "name a place that you may write to"),
    errno.EPERM: ("this user may not write there", "name a place that you may write to"),
    errno.EROFS: ("the file system is read-only", "name a place that can be written to"),
    errno.ENOSPC: ("the disk is full", "free some space and try again"),
    errno.EDQUOT: ("the disk quota is used up", "free some space and try again"),
    errno.EFBIG: ("it is larger than this user may write", "raise ulimit -f and try again"),
    errno.ENAMETOOLONG: ("the path is too long", "give a shorter one"),
    errno.ENOTDIR: ("it lies inside a file", "name a place in a folder"),
    errno.EEXIST: ("it is a file", "name a folder"),
    errno.EILSEQ: ("", "give another name"),
    errno.EISDIR: ("it is a folder", "name a file"),
    errno.EINVAL: ("it is a device or a pipe", "name a file"),
    errno.ENOENT: ("its folder does not exist", "make the folder first"),
}


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """Turn a refusal of the operating system into one line that says what to do."""
    try:
        yield
    except OSError as error:
        why, remedy = _REFUSALS.get(error.errno or 0, (str(error), "name another place"))
        raise OutputError(path, f"cannot be written: {why or error.strerror}", remedy) from None


def exists(path: Path) -> bool:
    """Return whether there is a file or folder of this path.

    Raises
    ------
    InputError
        The system refuses to look: the path is too long, or a folder above may not be read.
    """
    try:
        return _is_regular_file(path)
    except OSError as error:
        renamed = error.errno == errno.EILSEQ
        remedy = "rename it" if renamed else "check the path and its rights"
        raise InputError(path, f"cannot be read ({error.strerror})", remedy) from None


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn the system's refusal to read a recording, at its start or midway, into one line.

    Midway it comes of a disk that fails or of a network drive that goes away.

    Raises
    ------
    RecordingError
        The system refused, or the path is a device or a pipe, which may never end.
    """
    try:
        if not stat.S_ISREG(mode := path.stat().st_mode) and not stat.S_ISDIR(mode):
            raise RecordingError(path, "is neither a file nor a folder", "give a recording")
        yield
    except FileNotFoundError:
        raise RecordingError(path, "no such file", "check the path") from None
    except OSError as error:
        what = f"cannot be read ({error.strerror or error})"
        raise RecordingError(path, what, "check its rights and the disk") from None


def home_folder() -> Path:
    """Return the user's home; where there is none, as in a container, one that keeps nothing."""
    try:
        return Path.home()
    except RuntimeError:
        return Path(os.devnull)


def expanded(path: str | Path) -> Path:
    """Return a path with a home for its ``~``; as it is, if there is none."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def cache_folder() -> Path:
    """Return the folder in which this program may keep what it can make again."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if chosen.is_absolute():  # another would be a folder wherever a command runs
        base = chosen
    elif sys.platform == "darwin":
        base = home_folder() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", home_folder() / "AppData" / "Local"))
    else:
        base = home_folder() / ".cache"
    return base / "multirotor-tune"


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def find_flights(patterns: Iterable[str]) -> tuple[Path, ...]:
    """Return the recordings that paths and quoted globs mean, each once, globs sorted.

    Raises
    ------
    InputError
        A path does not exist, a glob matches nothing, or nothing is named at all.
    """
    recordings: dict[Path, Path] = {}
    for pattern in patterns:
        path = expanded(pattern)
        if exists(path):
            matches = [path]
        elif glob.has_magic(pattern):
            matches = [Path(match) for match in sorted(glob.glob(str(path)))]  # noqa: PTH207
            if not matches:
                raise InputError(pattern, "matches no file", "check the folder and the pattern")
        else:
            raise InputError(path, "does not exist", "check the path")
        for match in matches:
            if exists(match) and match.is_dir() and not (match / "metadata.yaml").exists():
                within = match / f"*{_most_common_suffix(match)}"
                raise InputError(match, "is a folder", f"give the recordings in it: '{within}'")
            recordings.setdefault(match.resolve(), match)
    if not recordings:
        raise InputError("--flights", "names no recording", "give the recordings to use")
    return tuple(recordings.values())


SUFFIXES = (".bag", ".csv", ".db3", ".mat", ".mcap", ".parquet", ".tsv", ".ulg")
"""Of files that may be recordings; a bare log of a Crazyflie has none."""


def _most_common_suffix(folder: Path) -> str:
    """Return the suffix of most files of a folder that may be recordings."""
    suffixes = Counter(path.suffix for path in folder.glob("*.*") if path.suffix in SUFFIXES)
    return suffixes.most_common(1)[0][0] if suffixes else ""


def folder_for(out: Path | None, *, resume: bool = False) -> Path:
    """Return the folder to write into: the one named, or a new one under ``runs/``.

    `result_folder` makes it, once there is something to write.

    Parameters
    ----------
    resume
        Whether a search that was interrupted there is gone on with.

    Raises
    ------
    InputError
        The folder cannot be made or written to, or there is none to go on in.
    """
    if resume and out is None:
        raise InputError("--resume", "needs the folder to go on in", "name it with --out")
    if out is None:
        out = Path("runs") / datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    check_folder(out)
    if resume and not exists(out):
        raise InputError(out, "does not exist, so there is nothing to resume", "leave --resume out")
    return out


@contextmanager
def result_folder(out: Path | None) -> Iterator[Path]:
    """Make the folder of `folder_for`, and give it to nobody else meanwhile.

    Raises
    ------
    OutputError
        A file is in the way, the system refuses, or another run writes there.
    """
    folder = folder_for(out)
    make_folder(folder if out is not None else folder.parent)
    for number in itertools.count(2) if out is None else ():
        with _refusals(folder), suppress(FileExistsError):
            folder.mkdir()
            break
        folder = folder.with_name(f"{folder.name.partition('.')[0]}.{number}")
    with _locked(folder):
        yield folder


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the system's lock of a folder, which ends with the process, where there are locks."""
    if sys.platform == "win32":
        yield
        return
    import fcntl  # noqa: PLC0415 (not on Windows)

    with _refusals(folder):
        handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            what, remedy = "another run writes there", "wait for its end, or name another folder"
            raise OutputError(folder, what, remedy) from None
        except OSError:  # some network drives lock no folder
            pass
        yield
    finally:
        os.close(handle)


def remove_file(path: Path) -> None:
    """Remove a file, if there is one.

    Raises
    ------
    OutputError
        It is a folder, or the system refuses.
    """
    with _refusals(path):
        path.unlink(missing_ok=True)


def open_file(path: Path) -> BinaryIO:
    """Open a file, and no pipe or device in a folder: none of its bytes may ever come.

    Those of ``/dev`` are what a shell makes of ``<(command)``.
    """
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or path.is_relative_to("/dev")):
        raise OSError(errno.EINVAL, "it is no file")
    return path.open("rb")


def read_bytes(path: Path, *, most: int, remedy: str) -> bytes:
    """Return the content of a file, if it holds no more than so many bytes.

    Raises
    ------
    ConfigError
        The file does not exist, cannot be read or is larger; ``remedy`` says what to do.
    """
    try:
        with open_file(path) as file:
            raw = file.read(most + 1)
    except (FileNotFoundError, NotADirectoryError):
        what = "is a link to nothing" if path.is_symlink() else "does not exist"
        raise ConfigError(path, what, remedy) from None
    except OSError as error:
        raise ConfigError(path, f"cannot be read ({error.strerror})", remedy) from None
    if len(raw) > most:
        raise ConfigError(path, f"is larger than {most // 1_000_000} MB", remedy)
    return raw
