"""The cache of read recordings, keyed by their content, the settings and the readers' source.

It imports no numpy, so that a cached answer does not wait for it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from tuner.core.disk import cache_folder, readable, whole_file
from tuner.core.errors import OutputError

logger = logging.getLogger(__name__)
T = TypeVar("T")

#: Larger files are recognised by name, size and time of change instead of their content.
MAX_HASHED_BYTES = 256 << 20
#: The cached files together take no more, but for `UNCHECKED_SHARE`; the longest unused go first.
MAX_CACHE_BYTES = 2 << 30
#: Share of that which a process stores before it looks through all files again.
UNCHECKED_SHARE = 0.01

_unchecked = math.inf
"""bytes that this process has stored since it looked."""


def cache_root() -> Path:
    """Return the folder of the cache: ``TUNE_CACHE_DIR``, or the user's own for this program."""
    named = os.environ.get("TUNE_CACHE_DIR")
    return Path(named) if named else cache_folder()


def sidecar_path(recording: Path) -> Path:
    """Return the path of a recording's side-car, whether or not it exists."""
    return recording / "flight.yaml" if recording.is_dir() else recording.with_suffix(".yaml")


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of all the files in a folder with their names.

    Raises
    ------
    RecordingError
        A file cannot be read.
    """
    with readable(path):
        inside = path.rglob("*") if path.is_dir() else [path]
        files = sorted(file for file in inside if file.is_file() or file == path)
        about = [(str(file), file.stat()) for file in files]
        if sum(stat.st_size for _, stat in about) <= MAX_HASHED_BYTES:
            return _digest(path, files)
        parts = [(n, s.st_size, s.st_mtime_ns, s.st_ino) for n, s in about]
        known = cache_file("digest", json.dumps(parts))
        if (known_digest := load(known)) is not None and len(known_digest) == 64:
            return known_digest.decode()
        fresh = _digest(path, files)
        store(known, fresh.encode())
        return fresh


def _digest(path: Path, files: Iterable[Path]) -> str:
    total = hashlib.sha256()
    for file in files:
        if path.is_dir():
            total.update(os.fsencode(file.relative_to(path)))
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                total.update(block)
    return total.hexdigest()


@functools.cache
def source_version(folder: str = "") -> str:
    """Return a digest of the source in a folder of this package and of the shipped topic maps.

    Parameters
    ----------
    folder
        Its path inside the package; the whole package where empty.
    """
    package = Path(__file__).resolve().parents[1]
    maps = package / "configs" if (package / "configs").is_dir() else package.parent / "configs"
    source = [*(package / folder).rglob("*.py"), *(maps / "topics").glob("*.yaml")]
    return _digest(package.parent, sorted(source))


def cache_file(kind: str, *key: str) -> Path:
    """Return the cache's file for a key."""
    parts = source_version("recordings"), kind, *key
    return cache_root() / kind / hashlib.sha256("\0".join(parts).encode()).hexdigest()[:40]


def load(path: Path) -> bytes | None:
    """Return the content of a cached file; None if it is missing or unreadable."""
    try:
        content = path.read_bytes()
        path.touch()
    except OSError:
        return None
    return content


def load_or_compute(kind: type[T], path: Path, compute: Callable[[], T]) -> T:
    """Return a dataclass from the cache, or compute and cache it.

    Parameters
    ----------
    path
        The file; a damaged one is replaced.
    """
    if (content := load(path)) is not None:
        with contextlib.suppress(ValidationError):
            return TypeAdapter(kind).validate_json(content)
    computed = compute()
    store(path, json.dumps(asdict(computed)).encode())  # type: ignore[call-overload]
    return computed


def store(path: Path, content: bytes) -> None:
    """Write a cached file atomically; a full disk is no error."""
    global _unchecked  # noqa: PLW0603 (of this process)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as unfinished:
            unfinished.write_bytes(content)
        _unchecked += len(content)
        if _unchecked > UNCHECKED_SHARE * MAX_CACHE_BYTES:
            _remove_oldest()
            _unchecked = 0.0
    except (OSError, OutputError) as err:
        logger.info("nothing is cached in %s: %s", path.parent, err)


def _remove_oldest() -> None:
    files = []
    for file in cache_root().rglob("*"):
        with contextlib.suppress(OSError):
            if file.is_file():
                stat = file.stat()
                files.append((stat.st_mtime, stat.st_size, file))
    total = sum(size for _, size, _ in files)
    for _, size, file in sorted(files, key=lambda entry: entry[0]):
        if total <= MAX_CACHE_BYTES:
            break
        file.unlink(missing_ok=True)
        total -= size
