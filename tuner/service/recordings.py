"""Recordings: received as a multipart body, never held in memory; inspected, stored, found."""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import anyio.to_thread
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import defer

from tuner.core.content_store import ContentStore
from tuner.core.disk import inside
from tuner.core.errors import InputError
from tuner.service.database import Database, RecordingRow
from tuner.service.errors import NotKnownError, TooManyError, full_disk, no_space, shown
from tuner.service.inspection import inspect
from tuner.service.request import recording_name, shown_name, stems
from tuner.service.settings import ServiceSettings

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
                raise no_space()
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


def check_space(database: Database, store: ContentStore, settings: ServiceSettings) -> None:
    """Refuse an upload before it begins, where there is no room for one.

    Raises
    ------
    TooManyError, NoSpaceError
        There are too many recordings, or the disk is nearly full.
    """
    limits = settings.limits
    free = (store.free_bytes(), shutil.disk_usage(settings.incoming).free)
    if any(left is not None and left < limits.free_bytes for left in free):
        raise no_space()
    with database.reading() as session:
        stored = session.scalar(select(func.count()).select_from(RecordingRow)) or 0
    if stored >= limits.recordings:
        raise TooManyError("the server", f"keeps {stored} recordings", "ask who runs it for more")


def store_recording(
    database: Database, store: ContentStore, settings: ServiceSettings, upload: Upload
) -> tuple[RecordingRow, bool]:
    """Inspect an upload, store and enter it, and return its row and whether it is new.

    Raises
    ------
    InputError
        It is no recording that can be read; nothing of it is kept.
    """
    try:
        with database.reading() as session:
            known = session.get(RecordingRow, upload.sha256)
        if known is not None and store.has(upload.sha256):
            return _insert(database, upload, known.inspection), False
        inspection = _inspect(upload, settings)
        with full_disk():
            store.take(upload.path, upload.sha256)
        return _insert(database, upload, inspection), known is None
    finally:
        upload.path.unlink(missing_ok=True)


def _inspect(upload: Upload, settings: ServiceSettings) -> dict[str, Any]:
    """Return the inspection of an upload, read under a name of our own."""
    with tempfile.TemporaryDirectory(dir=settings.incoming) as folder:
        file = inside(Path(folder), recording_name(upload.name))
        os.link(upload.path, file)
        try:
            return inspect(file, settings.limits)
        except InputError as error:
            raise type(error)(upload.name, error.what, error.remedy) from None


def _insert(database: Database, upload: Upload, inspection: dict[str, Any]) -> RecordingRow:
    """Enter a recording, and return its row under the upload's name, which the first one keeps."""
    for last in (False, True):
        try:
            with database.writing() as session:
                row = session.get(RecordingRow, upload.sha256)
                if row is None:
                    row = RecordingRow(sha256=upload.sha256, size=upload.size, name=upload.name)
                    row.inspection = inspection | {"path": upload.name}
                    session.add(row)
                row.uploaded = time.time()
            row.name, row.inspection = upload.name, row.inspection | {"path": upload.name}
            return row
        except IntegrityError:  # entered by another upload of the same recording
            if last:
                raise
    raise AssertionError


def flight_name(name: str) -> str:
    """Return the name of a recording's flight in a job."""
    return stems([recording_name(name)])[0]


def latest(database: Database, most: int) -> Sequence[RecordingRow]:
    """Return the recordings that were uploaded last, without their inspections."""
    with database.reading() as session:
        return session.scalars(
            select(RecordingRow)
            .options(defer(RecordingRow.inspection))
            .order_by(RecordingRow.uploaded.desc())
            .limit(most)
        ).all()


def recording(database: Database, digest: str) -> RecordingRow:
    """Return a recording.

    Raises
    ------
    NotKnownError
        There is none of this id.
    """
    with database.reading() as session:
        row = session.get(RecordingRow, digest) if digest.isalnum() else None
    if row is None:
        raise NotKnownError(f"recording {shown(digest)}", "is not known here", "upload it")
    return row
