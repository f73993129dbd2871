"""The receiver of uploads: a multipart body to the disk, hashed, never held in memory."""

from __future__ import annotations

import errno
import hashlib
import secrets
import shutil
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import anyio.to_thread
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from tuner.core.errors import InputError
from tuner.service.errors import full_disk
from tuner.service.names import shown_name

BUFFER_BYTES = 2**20
"""bytes that are gathered before they are hashed and written"""
FORM_FIELD = "file"
REMEDY = f"send it as multipart/form-data with a field '{FORM_FIELD}'"


@dataclass(frozen=True)
class Upload:
    """A complete file of an upload.

    Attributes
    ----------
    path
        Where it lies, until it is moved away.
    name
        What its sender calls it, without folders.
    """

    path: Path
    name: str
    sha256: str
    size: int


class _Receiver:
    """Callbacks of a request's parser, which write the first file of the field."""

    def __init__(self, path: Path, free_bytes: int) -> None:
        self.name: str | None = None
        self.complete = False
        self.size = 0
        self.hash = hashlib.sha256()
        self.buffer = bytearray()
        self.path = path
        self._free_bytes = free_bytes
        self._file: IO[bytes] | None = None
        self._header = bytearray()
        self._value = bytearray()
        self._disposition = b""
        self._is_ours = False

    def callbacks(self) -> dict[str, object]:
        """Return the parser's callbacks."""
        return {
            "on_part_begin": self._on_part_begin,
            "on_header_field": lambda data, start, end: self._header.extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._value.extend(data[start:end]),
            "on_header_end": self._on_header_end,
            "on_headers_finished": self._on_headers_finished,
            "on_part_data": self._on_part_data,
            "on_part_end": self._on_part_end,
        }

    def _on_part_begin(self) -> None:
        self._disposition = b""

    def _on_header_end(self) -> None:
        if bytes(self._header).lower() == b"content-disposition":
            self._disposition = bytes(self._value)
        self._header.clear()
        self._value.clear()

    def _on_headers_finished(self) -> None:
        _, options = parse_options_header(self._disposition)
        wanted = options.get(b"name") == FORM_FIELD.encode() and b"filename" in options
        self._is_ours = wanted and self.name is None
        if self._is_ours:
            self.name = options[b"filename"].decode("utf-8", "replace")

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        if not self._is_ours:
            return
        self.size += end - start
        self.buffer += data[start:end]

    def _on_part_end(self) -> None:
        self.complete = self.complete or self._is_ours
        self._is_ours = False

    def flush(self) -> None:
        """Hash and write the buffer, unless others need what is free on the disk."""
        with full_disk():
            if shutil.disk_usage(self.path.parent).free < self._free_bytes:
                raise OSError(errno.ENOSPC, "")
            if self._file is None:
                self._file = self.path.open("xb")
            self.hash.update(self.buffer)
            self._file.write(self.buffer)
        self.buffer.clear()

    def close(self) -> None:
        """Close the file, which is on the disk then."""
        if self._file is not None:
            with full_disk():
                self._file.close()


async def receive(
    stream: AsyncIterator[bytes], content_type: str, folder: Path, free_bytes: int
) -> Upload:
    """Write the file of a request to the disk, and return where it lies.

    Parameters
    ----------
    folder
        For files that are not complete; nothing is left there if anything fails.
    free_bytes
        Left on its disk, below which nothing more is taken.

    Raises
    ------
    InputError
        The request holds no file, or not all of one.
    NoSpaceError
        The disk is full.
    """
    kind, options = parse_options_header(content_type)
    boundary = options.get(b"boundary")
    if kind != b"multipart/form-data" or not boundary:
        raise InputError("upload", "is no form", REMEDY)
    receiver = _Receiver(folder / secrets.token_hex(16), free_bytes)
    path = receiver.path
    try:
        try:
            parser = MultipartParser(boundary, receiver.callbacks())  # type: ignore[arg-type]
            async for chunk in stream:
                parser.write(chunk)
                if len(receiver.buffer) >= BUFFER_BYTES:
                    await anyio.to_thread.run_sync(receiver.flush)
            await anyio.to_thread.run_sync(receiver.flush)
        except FormParserError:
            raise InputError("upload", "is no form that can be read", REMEDY) from None
        finally:
            receiver.close()
        if receiver.name is None:
            raise InputError("upload", "holds no file", REMEDY)
        if not receiver.complete:
            raise InputError("upload", "was cut off before its end", "upload the recording again")
        if receiver.size == 0:
            raise InputError(shown_name(receiver.name), "is empty", "check the recording")
        return Upload(path, shown_name(receiver.name), receiver.hash.hexdigest(), receiver.size)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
