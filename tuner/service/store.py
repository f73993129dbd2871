"""The store: recordings and results by their SHA-256, in a folder or at any fsspec URL.

What is written appears whole: it is moved into place in a folder, and an object store shows no
object before it is complete.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import fsspec
from fsspec.implementations.local import LocalFileSystem

from tuner.core.errors import InputError
from tuner.service.errors import NoSpaceError

BLOCK = 2**20
"""bytes that are read at once"""


class Store:
    """Files by their digests.

    Parameters
    ----------
    url
        A folder, or what fsspec opens, as ``s3://bucket/tune``.

    Raises
    ------
    InputError
        The URL cannot be opened.
    """

    def __init__(self, url: str) -> None:
        try:
            self._files, self._root = fsspec.url_to_fs(url)
            self._files.makedirs(self._root, exist_ok=True)
        except (ValueError, ImportError, OSError) as error:
            raise InputError(
                "--store", f"'{url}' cannot be opened ({error})", "give a folder or an fsspec URL"
            ) from None

    @property
    def is_folder(self) -> bool:
        """Whether it is a folder of this machine."""
        return isinstance(self._files, LocalFileSystem)

    def path(self, digest: str) -> str:
        """Return where the content of a digest lies, in the store's own words."""
        return f"{self._root}/{digest[:2]}/{digest[2:]}"

    def take(self, file: Path, digest: str) -> None:
        """Move a file of this machine into the store, which may have it already.

        Raises
        ------
        NoSpaceError
            The disk is full.
        """
        path = self.path(digest)
        with full_disk():
            if self._files.exists(path):
                file.unlink()
            elif self.is_folder:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                _move(file, Path(path))
            else:
                self._files.put_file(str(file), path)
                file.unlink()

    def fetch(self, digest: str, target: Path) -> None:
        """Put the content of a digest at a path of this machine; a link where that is possible."""
        if not self.is_folder:
            self._files.get_file(self.path(digest), str(target))
            return
        try:
            os.link(self.path(digest), target)
        except OSError:  # another disk, or a file system without links
            shutil.copyfile(self.path(digest), target)

    def has(self, digest: str) -> bool:
        """Return whether there is content of this digest."""
        return bool(self._files.exists(self.path(digest)))

    @contextmanager
    def reading(self, digest: str) -> Iterator[IO[bytes]]:
        """Open the content of a digest."""
        with self._files.open(self.path(digest), "rb") as file:
            yield file

    def free_bytes(self) -> int | None:
        """Return what is left on the disk; None where the store does not say."""
        return shutil.disk_usage(self._root).free if self.is_folder else None


@contextmanager
def full_disk() -> Iterator[None]:
    """Turn a full disk into a sentence for the user."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise NoSpaceError(
            "the server", "has no space left", "free some space and try again"
        ) from None


def _move(file: Path, target: Path) -> None:
    """Move a file, across disks too, so that the target appears whole."""
    try:
        file.replace(target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        part = target.with_suffix(".part")
        try:
            shutil.copyfile(file, part)
            part.replace(target)
        finally:
            with suppress(FileNotFoundError):
                part.unlink()
        file.unlink()
