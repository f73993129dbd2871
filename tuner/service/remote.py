"""A job worked on by a machine of a cluster: its files come from the store and go back there.

The machine has a folder of its own for as long as it works. What its search has found so far goes
into the store as well, so that any other machine can go on from it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from tuner.core.content_store import ContentStore
from tuner.core.disk import inside
from tuner.core.errors import EngineError
from tuner.engine.engine import Engine
from tuner.engine.engine import Report as Channel
from tuner.service.attempt import (
    BEAT,
    CHECKPOINTS,
    DiedError,
    Events,
    Report,
    UnwantedError,
    attempt,
    outcome_of,
    prepare,
    put,
)
from tuner.service.queue import Claim, Outcome
from tuner.service.settings import Limits
from tuner.service.worker import RESULT


@dataclass(frozen=True)
class RemoteTask:
    """What a machine of the cluster is to do: the claim on a job, and the store's URL."""

    claim: Claim
    store: str
    limits: Limits


def fit_remotely(task: RemoteTask, report: Channel) -> Outcome:
    """Work on a job, on the machine that an engine has chosen for it.

    Raises
    ------
    DiedError
        Its process died.
    """
    store, claim = ContentStore(task.store), task.claim
    kept = dict(claim.checkpoint)
    with tempfile.TemporaryDirectory(prefix="tune-job-") as name:
        folder = Path(name)
        (folder / RESULT).mkdir()
        for file, digest in kept.items():
            store.fetch(digest, inside(folder / RESULT, file))
        asked = prepare(folder, claim, store)

        def relay(events: Events, standing: Mapping[str, Any]) -> bool:
            for file in (folder / RESULT).glob(CHECKPOINTS):
                kept[file.name] = put(file, store)
            report({"events": list(events), "standing": dict(standing), "checkpoint": dict(kept)})
            return True

        last = attempt(
            folder,
            claim,
            asked,
            limits=task.limits,
            cores=(),
            report=relay,
            is_unwanted=lambda: False,
        )
        return outcome_of(last, folder, store)


def run_remotely(
    task: RemoteTask, engine: Engine, report: Report, is_unwanted: Callable[[], bool]
) -> Outcome:
    """Have a job worked on by a machine of a cluster, and return what came of it.

    Raises
    ------
    UnwantedError
        The attempt holds its job no more, or the server is ending; the machine stops working.
    DiedError
        The process of the job died, or the machine did.
    """
    heard: SimpleQueue[dict[str, Any]] = SimpleQueue()
    future = engine.submit(fit_remotely, task, heard.put)
    try:
        while True:
            has_ended = wait([future], timeout=BEAT).done
            events, standing = _all(heard)
            if is_unwanted() or not report(events, standing):
                raise UnwantedError
            if has_ended:
                return future.result()
    except EngineError as error:
        raise DiedError(f"{error.where} {error.what}") from None
    finally:
        future.cancel()


def _all(heard: SimpleQueue[dict[str, Any]]) -> tuple[Events, dict[str, Any]]:
    """Return what was heard since the last time."""
    events: list[tuple[str, Mapping[str, Any]]] = []
    standing: dict[str, Any] = {}
    while True:
        try:
            message = heard.get_nowait()
        except Empty:
            return events, standing
        events += [(kind, content) for kind, content in message["events"]]
        standing |= {**message["standing"], "checkpoint": message["checkpoint"]}
