"""``tune serve``: the tuning service, and who may use it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from tuner.cli.tune import MANY_WORDS
from tuner.core.errors import InputError
from tuner.core.runtime import extra

if TYPE_CHECKING:
    from tuner.service.database import Database

EXAMPLES = (
    "tune serve --port 8000",
    "tune serve --host 0.0.0.0 --data /srv/tune --workers 4",
    "tune serve --tokens always --allow-host tune.lab.example",
    "tune serve token add alice",
)
serve = App(
    name="serve",
    help="Run the tuning service: jobs of many people, over HTTP and as pages in a browser.",
    help_epilogue="\n".join(f"Example: {example}" for example in EXAMPLES),
    help_format="plaintext",
    default_parameter=MANY_WORDS,
    result_action="return_value",
    exit_on_error=False,
    print_error=False,
    suppress_keyboard_interrupt=False,
)
token = App(name="token", help="Make and take away the tokens that visitors show.")
serve.command(token)

Data = Annotated[
    Path | None,
    Parameter(help="Keep everything in this folder. Default: ~/.local/share/multirotor-tune."),
]
DatabaseUrl = Annotated[
    str | None,
    Parameter(help="Use this database, as postgresql://user@host/name. Default: SQLite."),
]


@serve.default
def _serve(
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    data: Data = None,
    database: DatabaseUrl = None,
    tokens: Literal["auto", "always"] = "auto",
    allow_host: tuple[str, ...] = (),
    store: str | None = None,
    workers: int = 2,
    cluster: str | None = None,
    max_upload: float = 4.0,
    memory: float = 8.0,
) -> None:
    """Run the tuning service until Ctrl-C; jobs under way go on when it is started again.

    Parameters
    ----------
    host
        Listen to this address. Any but the loopback one demands tokens of all visitors.
    port
        Listen to this port; 0 takes a free one.
    tokens
        Demand tokens on the loopback address, too (always): behind a proxy, or where others share
        this machine.
    allow_host
        Answer under these names alone, beside the loopback ones: what visitors of a proxy type.
    store
        Keep recordings and results in this folder or fsspec URL. Default: in the data folder.
    workers
        Work on so many jobs at the same time, each in a process of its own on this machine.
    cluster
        Have a Dask cluster do the work instead: the address of its scheduler, or a cluster file.
        Its machines must reach the store, and --workers is what the cluster has.
    max_upload
        Take recordings of up to so many GiB.
    memory
        Let a job take so many GiB of memory.
    """
    with extra("service", "tune serve"):
        from tuner.service.app import LOOPBACK, is_loopback
        from tuner.service.app import serve as run
    from tuner.service.settings import GIB, ServiceLimits, ServiceSettings, default_data

    if not 0 <= port < 2**16:
        raise InputError("--port", f"{port} is no port", "name one from 1 to 65535")
    for option, value, most in (
        ("workers", workers, 1000),
        ("max-upload", max_upload, 1e6),
        ("memory", memory, 1e6),
    ):
        if not 0 < value <= most:
            remedy = f"give a number above zero, up to {most:.0f}"
            raise InputError(f"--{option}", f"is {value}", remedy)
    for name in allow_host:
        if not re.fullmatch(r"[A-Za-z0-9.-]+", name):
            raise InputError("--allow-host", f"'{name}' is no host name", "write tune.lab.example")
    limits = ServiceLimits(upload_bytes=int(max_upload * GIB), memory_bytes=int(memory * GIB))
    settings = ServiceSettings(
        data=data or default_data(),
        database=database or "",
        store=store or "",
        workers=workers,
        demands_tokens=tokens == "always" or not is_loopback(host),
        hosts=(*LOOPBACK, *map(str.lower, allow_host)) if allow_host or is_loopback(host) else (),
        limits=limits,
    )
    run(settings, host=host, port=port, say=lambda text: print(text, flush=True), cluster=cluster)


@token.command
def add(name: str, /, *, data: Data = None, database: DatabaseUrl = None) -> None:
    """Make a token for a visitor, and print it: it cannot be shown again.

    Parameters
    ----------
    name
        Whose it is.
    """
    with _database(data, database) as opened:
        from tuner.service import tokens

        print(tokens.add(opened, name))


@token.command
def remove(name: str, /, *, data: Data = None, database: DatabaseUrl = None) -> None:
    """Let a visitor's token hold no more.

    Parameters
    ----------
    name
        Whose it is.
    """
    with _database(data, database) as opened:
        from tuner.service import tokens

        tokens.remove(opened, name)
        print(f"{name} has no token any more")


@token.command(name="list")
def names(*, data: Data = None, database: DatabaseUrl = None) -> None:
    """List who has a token."""
    with _database(data, database) as opened:
        from tuner.service import tokens

        for name in tokens.names(opened):
            print(name)


@contextmanager
def _database(data: Path | None, url: str | None) -> Iterator[Database]:
    """Open the database of a server, which may be running."""
    with extra("service", "tune serve"):
        from tuner.service.database import Database
    from tuner.core.disk import make_folder
    from tuner.service.settings import ServiceSettings, default_data

    settings = ServiceSettings(data=data or default_data(), database=url or "")
    make_folder(settings.data)
    opened = Database(settings.database_url)
    try:
        opened.migrate()
        yield opened
    finally:
        opened.close()
