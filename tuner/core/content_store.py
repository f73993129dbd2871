"""A store of content by its SHA-256, in a folder or at any fsspec URL.

Writes are atomic. The digest verifies content from an untrusted store.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import tempfile
import uuid
from pathlib import Path
from typing import IO

import fsspec
from fsspec.implementations.local import LocalFileSystem

from tuner.core.errors import InputError


class ContentStore:
    """Files by their digests.

    Parameters
    ----------
    url
        A folder, or what fsspec opens, as ``s3://bucket/tune``.

    Raises
    ------
    InputError
        It cannot be opened, or what opens it is not installed.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            self._files, self._root = fsspec.url_to_fs(url)
            self._files.makedirs(self._root, exist_ok=True)
        except (ValueError, ImportError, OSError) as error:
            raise InputError(
                f"store {url}", f"cannot be opened ({error})", "give a folder or an fsspec URL"
            ) from None

    @property
    def is_folder(self) -> bool:
        """Whether it is a local folder."""
        return isinstance(self._files, LocalFileSystem)

    def path(self, digest: str) -> str:
        """Return where the content of a digest lies, in the store's own words."""
        return f"{self._root}/{digest[:2]}/{digest[2:]}"

    def has(self, digest: str) -> bool:
        """Return whether there is content of this digest."""
        return bool(self._files.exists(self.path(digest)))

    def take(self, file: Path, digest: str) -> None:
        """Move a file of this machine into the store, which may have it already."""
        path = self.path(digest)
        if self.has(digest):
            file.unlink()
        elif self.is_folder:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            _move(file, Path(path))
        else:
            try:
                self._files.put_file(str(file), path)
            except BaseException:
                if self.has(digest):
                    self._files.rm(path)
                raise
            file.unlink()

    def put(self, content: bytes) -> str:
        """Keep some content, and return its digest."""
        digest = hashlib.sha256(content).hexdigest()
        if not self.has(digest):
            self._files.makedirs(self._root, exist_ok=True)
            beside = self._root if self.is_folder else None
            with tempfile.TemporaryDirectory(prefix=".", dir=beside) as folder:
                file = Path(folder) / digest
                file.write_bytes(content)
                self.take(file, digest)
        return digest

    def fetch(self, digest: str, target: Path) -> None:
        """Put the content of a digest at a path of this machine; a link where that is possible."""
        if not self.is_folder:
            self._files.get_file(self.path(digest), str(target))
            return
        try:
            os.link(self.path(digest), target)
        except OSError:  # another disk, or a file system without links
            shutil.copyfile(self.path(digest), target)

    def reading(self, digest: str) -> IO[bytes]:
        """Open the content of a digest."""
        file: IO[bytes] = self._files.open(self.path(digest), "rb")
        return file

    def read(self, digest: str) -> bytes:
        """Return some content that is what its digest says.

        Raises
        ------
        InputError
            It is not there, or is something else.
        """
        try:
            content: bytes = self._files.cat_file(self.path(digest))
        except OSError:
            remedy = "name a store that all machines reach"
            raise InputError(f"store {self.url}", f"does not hold {digest[:12]}…", remedy) from None
        if hashlib.sha256(content).hexdigest() != digest:
            what = f"holds something else as {digest[:12]}…"
            raise InputError(f"store {self.url}", what, "delete it there")
        return content

    def free_bytes(self) -> int | None:
        """Return the free bytes on the disk; None if unknown."""
        return shutil.disk_usage(self._root).free if self.is_folder else None

    def clear(self) -> None:
        """Delete the store with everything in it."""
        if self._files.exists(self._root):
            self._files.rm(self._root, recursive=True)


def _move(file: Path, target: Path) -> None:
    """Move a file, across disks too, so that the target appears whole."""
    try:
        file.replace(target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        part = target.with_name(f"{target.name}.{uuid.uuid4().hex}")
        try:
            shutil.copyfile(file, part)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
        file.unlink()
