"""Operations on recordings: inspect and store an upload, find, list."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import defer

from tuner.core.content_store import ContentStore
from tuner.core.disk import inside
from tuner.core.errors import InputError
from tuner.service.database import Database
from tuner.service.errors import NoSpaceError, NotKnownError, TooManyError, full_disk
from tuner.service.inspection import inspect
from tuner.service.names import recording_name, shown, stems
from tuner.service.settings import ServiceSettings
from tuner.service.tables import RecordingRow
from tuner.service.upload import Upload


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
        raise NoSpaceError("the server", "has no space left", "free some space and try again")
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
