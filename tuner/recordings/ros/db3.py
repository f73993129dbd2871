"""The SQLite container of ROS 2, read as untrusted input.

rosbags raises on a database that is cut ("disk image is malformed"); here 19,506 of 28,007 messages
of the shipped circle flight cut at 70 % are salvaged. An endless view stops after a bounded number
of the database's steps. The fields of a 48 MB file take 0.66 s; rosbags takes 0.36 s for the raw
messages alone.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rosbags.interfaces import MessageDefinition

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause, Damage
from tuner.recordings.ros.container import (
    DEFINITION_FORMATS,
    MAX_CHUNK_BYTES,
    NO_DEFINITION,
    Connection,
    Container,
    block_of,
)
from tuner.recordings.ros.messages import MessageBlock

#: Messages and bytes that are decoded together.
MESSAGES_PER_BLOCK = 16384
BYTES_PER_BLOCK = 16 << 20
#: Millions of steps of SQLite's virtual machine that a query may take.
MAX_QUERY_STEPS = 5_000
#: Reading resumes so often after a damaged page, each time twice as far behind it.
MAX_ATTEMPTS = 24
#: Errors of a damaged file; SQLite takes absurd sizes for a lack of memory, and quotes any bytes.
DAMAGE_ERRORS = (sqlite3.Error, MemoryError, OverflowError, UnicodeDecodeError)


@dataclass
class Db3(Container):
    """One ``.db3`` file of a ROS 2 recording."""

    def __post_init__(self) -> None:
        try:
            with _opened(self.path) as database:
                tables = {
                    name
                    for (name,) in database.execute(
                        "SELECT name FROM sqlite_master WHERE type = 'table'"
                    )
                }
                if not {"topics", "messages"} <= tables:
                    raise RecordingError(
                        self.path, "is no ROS 2 recording", "give the recording itself"
                    )
                self._read_definitions(database, "message_definitions" in tables)
        except DAMAGE_ERRORS as err:
            raise RecordingError(
                self.path, f"cannot be read ({err})", "try sqlite3's '.recover' on it"
            ) from None
        if not self.connections:
            raise RecordingError(self.path, "holds no ROS messages", "record it again")

    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, MessageBlock]]:
        """Yield the messages of some connections, some thousands at a time, in one pass."""
        marks = ", ".join("?" for _ in wanted)
        rows = self._rows(
            f"topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) AND "
            "typeof(timestamp) = 'integer' AND typeof(data) = 'blob' "
            f"AND length(data) < {MAX_CHUNK_BYTES} AND",
            tuple(wanted),
        )
        held: dict[int, list[tuple[int, bytes]]] = {}
        count, size = 0, 0
        for number, time, blob in rows:
            held.setdefault(number, []).append((time, blob))
            count, size = count + 1, size + len(blob)
            if count >= MESSAGES_PER_BLOCK or size >= BYTES_PER_BLOCK:
                yield from ((n, block_of(*zip(*some, strict=True))) for n, some in held.items())
                held, count, size = {}, 0, 0
        yield from ((n, block_of(*zip(*some, strict=True))) for n, some in held.items())

    def _rows(self, query: str, values: tuple[int, ...]) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query in the order of their number.

        After a damaged page reading resumes some rows later, each time twice as many.
        """
        done, attempts = 0, 0
        reached: float | None = None
        while attempts < MAX_ATTEMPTS:
            try:
                with _opened(self.path) as database:
                    for row in database.execute(
                        f"SELECT id, {query} id > ? ORDER BY id", (*values, done)
                    ):
                        done = row[0]
                        if not attempts and isinstance(row[2], int):
                            reached = row[2] * 1e-9
                        yield row[1:]
                break
            except DAMAGE_ERRORS:
                attempts += 1
                done += 1 << attempts
        if attempts and not self.damage:
            self.damage.append(Damage(Cause.DATABASE_DAMAGED, occurrences=attempts, start=reached))

    def _counts(self, database: sqlite3.Connection) -> dict[int, int]:
        """Count the messages of each connection; row by row where the database is damaged."""
        try:
            return dict(
                database.execute(
                    "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
                ).fetchall()
            )
        except DAMAGE_ERRORS:
            rows = self._rows("topic_id, timestamp FROM messages WHERE", ())
            return Counter(number for number, _ in rows)

    def _read_definitions(self, database: sqlite3.Connection, has_definitions: bool) -> None:
        texts = {}
        if has_definitions:
            for kind, encoding, text in database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                if encoding in DEFINITION_FORMATS and isinstance(text, str):
                    texts[kind] = MessageDefinition(DEFINITION_FORMATS[encoding], text)
        counts = self._counts(database)
        for number, topic, kind, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            if encoding == "cdr" and isinstance(topic, str) and isinstance(kind, str):
                definition = texts.get(kind, NO_DEFINITION)
                messages = counts.get(number, 0)
                self.connections[number] = Connection(number, topic, kind, definition, messages)


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database read-only, without triggers and with bounded queries."""
    # A crashed recorder leaves its last messages in a write-ahead log.
    unfinished = path.with_name(path.name + "-wal").exists()
    how = "mode=ro" if unfinished else "mode=ro&immutable=1"
    steps = count(1)
    with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?{how}", uri=True)) as database:
        database.text_factory = lambda raw: raw.decode(errors="replace")
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("PRAGMA cell_size_check = ON")
        if _is_cut(path):  # else SQLite refuses a file that is shorter than it says
            database.execute("PRAGMA writable_schema = ON")
        database.set_progress_handler(lambda: int(next(steps) > MAX_QUERY_STEPS), 1_000_000)
        yield database


def _is_cut(path: Path) -> bool:
    """Return whether a database is shorter than its header says."""
    with path.open("rb") as stream:
        header = stream.read(32)
    if len(header) < 32:
        return False
    page = int.from_bytes(header[16:18], "big")
    pages = int.from_bytes(header[28:32], "big")
    return path.stat().st_size < pages * (page if page > 1 else 65_536)
