"""Content by its digest: what is asked for by its SHA-256 is that, or an error.

A store is a folder, or anything that fsspec reaches by a URL. Who knows a digest from a source that
he trusts may take the content from a store that he does not.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Callable

from fsspec.core import url_to_fs

from tuner.core.errors import InputError


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
            place = self._place(sha256)
            beside = f"{place}.{uuid.uuid4().hex}"  # it appears whole
            self._files.makedirs(place.rpartition("/")[0], exist_ok=True)
            try:
                self._files.pipe_file(beside, content)
                self._files.mv(beside, place)
            except BaseException:
                if self._files.exists(beside):
                    self._files.rm(beside)
                raise
        return sha256

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
            raise InputError(
                f"store {self.url}",
                f"does not hold {sha256[:12]}…",
                "name a store that all machines reach",
            ) from None
        if hashlib.sha256(content).hexdigest() != sha256:
            raise InputError(
                f"store {self.url}", f"holds something else as {sha256[:12]}…", "delete it there"
            )
        return content

    def clear(self) -> None:
        """Delete everything in the store, and the store."""
        if self._files.exists(self._root):
            self._files.rm(self._root, recursive=True)
