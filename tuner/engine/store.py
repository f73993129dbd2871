"""Files by their content: what is asked for by its SHA-256 is that, or an error.

A store is a folder, or anything that fsspec reaches by a URL. Who knows a digest from a source that
he trusts may take the content from a store that he does not.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fsspec.core import url_to_fs

from tuner.disk import digest_of, make_folder, whole_file
from tuner.errors import InputError

BLOCK = 1 << 20


class Store:
    """A place of content.

    Parameters
    ----------
    url
        A folder, or a URL of fsspec's, as ``s3://bucket/tune``.

    Raises
    ------
    InputError
        The URL cannot be understood, or what reads it is not installed.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            self._files, self._root = url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise InputError(
                f"store {url}", f"cannot be reached ({error})", "name a folder or a URL of fsspec's"
            ) from None

    def __reduce__(self) -> tuple[Callable[[str], Store], tuple[str]]:
        return Store, (self.url,)

    def _place(self, sha256: str) -> str:
        return f"{self._root.rstrip('/')}/{sha256[:2]}/{sha256}"

    def holds(self, sha256: str) -> bool:
        """Return whether there is such content."""
        return bool(self._files.exists(self._place(sha256)))

    def put(self, content: bytes) -> str:
        """Keep some content and return its SHA-256; what is there already is not written again."""
        sha256 = hashlib.sha256(content).hexdigest()
        if not self.holds(sha256):
            with self._arriving(sha256) as place:
                self._files.pipe_file(place.name, content)
        return sha256

    def put_file(self, path: Path) -> str:
        """Keep a file and return its SHA-256."""
        sha256 = digest_of(path)
        if not self.holds(sha256):
            with self._arriving(sha256) as place:
                self._files.put_file(str(path), place.name)
        return sha256

    def _arriving(self, sha256: str) -> _Arriving:
        return _Arriving(self._files, self._place(sha256))

    def read(self, sha256: str) -> bytes:
        """Return some content.

        Raises
        ------
        InputError
            It is not there, or not what its name says.
        """
        try:
            content: bytes = self._files.cat_file(self._place(sha256))
        except OSError:
            raise self._missing(sha256) from None
        if hashlib.sha256(content).hexdigest() != sha256:
            raise self._changed(sha256)
        return content

    def fetch(self, sha256: str, path: Path) -> Path:
        """Write some content to a file, if it is not there yet, and return the file.

        Raises
        ------
        InputError
            It is not in the store, or not what its name says.
        """
        if path.is_file() and digest_of(path) == sha256:
            return path
        make_folder(path.parent)
        total = hashlib.sha256()
        with whole_file(path) as unfinished:
            try:
                with (
                    self._files.open(self._place(sha256), "rb") as source,
                    unfinished.open("wb") as target,
                ):
                    while block := source.read(BLOCK):
                        total.update(block)
                        target.write(block)
            except FileNotFoundError:
                raise self._missing(sha256) from None
            if total.hexdigest() != sha256:
                raise self._changed(sha256)
        return path

    def clear(self) -> None:
        """Delete everything in the store, and the store."""
        if self._files.exists(self._root):
            self._files.rm(self._root, recursive=True)

    def _missing(self, sha256: str) -> InputError:
        return InputError(
            f"store {self.url}",
            f"does not hold {sha256[:12]}…",
            "name a store that all machines reach",
        )

    def _changed(self, sha256: str) -> InputError:
        return InputError(
            f"store {self.url}", f"holds something else as {sha256[:12]}…", "delete it there"
        )


class _Arriving:
    """A name beside the final one, which what was written there takes in the end."""

    def __init__(self, files: Any, place: str) -> None:
        self._files, self._place = files, place
        self.name = f"{place}.{uuid.uuid4().hex}"

    def __enter__(self) -> _Arriving:
        self._files.makedirs(self._place.rpartition("/")[0], exist_ok=True)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._files.mv(self.name, self._place)
        elif self._files.exists(self.name):
            self._files.rm(self.name)
