"""The parts of one server, made once and handed to whoever answers a request."""

from __future__ import annotations

import shutil
import threading
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from tuner.core.content_store import ContentStore
from tuner.core.disk import make_folder, write_text
from tuner.core.errors import InputError
from tuner.engine.engine import Engine
from tuner.service.database import Database
from tuner.service.dispatcher import Dispatcher
from tuner.service.queue import Queue
from tuner.service.settings import ServiceSettings


@dataclass
class Service:
    """The parts of one server.

    Attributes
    ----------
    settings, database, store, dispatcher
        See there.
    stopping
        Set once the server ends, so that answers which last for long end too.
    """

    settings: ServiceSettings
    database: Database
    store: ContentStore
    dispatcher: Dispatcher
    stopping: threading.Event = field(default_factory=threading.Event)
    _lock: IO[str] | None = None

    @classmethod
    def open(cls, settings: ServiceSettings, engine: Engine | None = None) -> Service:
        """Open the store and the database, and make the folders.

        Parameters
        ----------
        settings
            See there.
        engine
            A cluster that does the work; None for this machine.

        Raises
        ------
        InputError
            A folder, a URL or a database cannot be used, or another server uses the folder.
        """
        make_folder(settings.work)
        lock = _only_server(settings.data)
        shutil.rmtree(settings.incoming, ignore_errors=True)
        make_folder(settings.incoming)
        store = ContentStore(settings.store_url)
        database = Database(settings.database_url)
        database.migrate()
        jobs = Queue(database, _identity(settings.data), settings.lease_seconds)
        return cls(settings, database, store, Dispatcher(settings, jobs, store, engine), _lock=lock)

    def close(self) -> None:
        """Stop working; jobs under way go back into the queue."""
        self.stopping.set()
        self.dispatcher.stop()
        self.database.close()
        if self._lock is not None:
            self._lock.close()


def _identity(data: Path) -> str:
    """Return the name that the server of a data folder keeps when it is started again."""
    file = data / "server.id"
    if not file.exists():
        write_text(file, uuid.uuid4().hex)
    return file.read_text(encoding="utf-8").strip()


def _only_server(data: Path) -> IO[str]:
    """Take the lock of a data folder, which the system lets go when the process ends.

    Raises
    ------
    InputError
        Another server has it.
    """
    file = (data / "server.lock").open("w")
    try:
        import fcntl  # noqa: PLC0415 (not on Windows)
    except ImportError:
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise InputError(
            data, "is used by another server", "stop that one, or name another folder with --data"
        ) from None
    return file
