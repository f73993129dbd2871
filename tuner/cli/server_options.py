"""Options that the commands of a tuning service share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tuner.client.client import Client
    from tuner.job.listener import Listener

Server = Annotated[
    str | None,
    Parameter(
        help="Ask the server at this address. Default: $TUNE_SERVER, else http://127.0.0.1:8000."
    ),
]
Token = Annotated[
    str | None,
    Parameter(
        help="Show this token to the server. Default: $TUNE_TOKEN, which other users of this "
        "machine cannot see."
    ),
]
JobName = Annotated[str, Parameter(help="Take this job, by its id.")]


@contextmanager
def client_of(server: str | None, token: str | None) -> Iterator[Client]:
    """Yield a client of the server that the options name.

    Raises
    ------
    InputError
        The address is none, or an extra is missing.
    """
    from tuner.client.client import Client
    from tuner.client.connection import Connection

    client = Client(Connection(server, token))
    try:
        yield client
    finally:
        client.close()


def show(events: Iterable[tuple[str, dict[str, Any]]], listener: Listener) -> None:
    """Pass what happens to a job on to a listener, as a run on this machine does."""
    from tuner.search.iteration import Iteration

    for kind, content in events:
        if kind == "message":
            listener.on_message(content["text"])
        elif kind == "iteration":
            left = content.pop("seconds_left", None)
            listener.on_iteration(Iteration(**content), float("nan") if left is None else left)
        elif kind == "folds":
            listener.on_folds(_folds(content["folds"]))


def _folds(rows: list[dict[str, Any]]) -> Any:
    from tuner.job.cross_validation import Fold  # (jax)
    from tuner.result import AxesRmse

    return [
        Fold(row["left_out"], {}, None if row["rmse"] is None else AxesRmse(**row["rmse"]))
        for row in rows
    ]
