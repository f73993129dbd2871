"""Downloads of a result: a file, or an archive that is made while it is sent."""

from __future__ import annotations

import io
import zipfile
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import PurePosixPath

import anyio.to_thread
from fastapi.responses import StreamingResponse

from tuner.core.content_store import ContentStore
from tuner.core.disk import file_name
from tuner.service.errors import NotKnownError
from tuner.service.safety import REPORT_POLICY
from tuner.service.tables import FileRow

BLOCK = 1 << 20
"""bytes that are read at a time"""
_KINDS = {".json": "application/json", ".csv": "text/csv", ".svg": "image/svg+xml"}


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


def zipped(store: ContentStore, files: Sequence[FileRow], folder: str) -> Iterator[bytes]:
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


def file_response(store: ContentStore, row: FileRow) -> StreamingResponse:
    """Return a stored file; a report as a page that reaches nothing, the rest to be saved."""
    suffix, base = row.name[row.name.rfind(".") :], row.name.rpartition("/")[2]
    headers = {
        "content-length": str(row.size),
        "content-security-policy": REPORT_POLICY,
        "etag": f'"{row.sha256}"',
    }
    if suffix == ".html":
        kind = "text/html; charset=utf-8"
    else:
        kind = _KINDS.get(suffix, "application/octet-stream")
        headers["content-disposition"] = f'attachment; filename="{file_name(base)}"'
    if not store.has(row.sha256):
        raise NotKnownError(row.name, "is gone from the store", "submit the job again")

    async def blocks() -> AsyncIterator[bytes]:
        with store.reading(row.sha256) as file:
            read: Callable[[int], bytes] = file.read
            while block := await anyio.to_thread.run_sync(read, BLOCK):
                yield block

    return StreamingResponse(blocks(), media_type=kind, headers=headers)
