"""The commands that talk to a tuning service: jobs are submitted, listed, watched, fetched."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from tuner.cli.tune import FLATTENED, Quiet
from tuner.options import FitOptions

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from tuner.search.listener import Listener
    from tuner.service.client import Client

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


def client_of(server: str | None, token: str | None) -> closing[Client]:
    """Return a client of the server that the options name, closed at the end of the context.

    Raises
    ------
    InputError
        The address is none, or an extra is missing.
    """
    from tuner.service.client import Client

    return closing(Client(server, token))


def show(events: Iterable[tuple[str, dict[str, Any]]], listener: Listener) -> None:
    """Pass what happens to a job on to a listener, as a run on this machine does."""
    from tuner.search.listener import Iteration, PointEstimate
    from tuner.uncertainty.records import Refit

    for kind, content in events:
        if kind == "message":
            listener.on_message(content["text"])
        elif kind == "iteration":
            left = content.pop("seconds_left", None)
            listener.on_iteration(Iteration(**content), float("nan") if left is None else left)
        elif kind == "estimates":
            listener.on_estimates([PointEstimate(**row) for row in content["estimates"]])
        elif kind == "folds":
            listener.on_folds([Refit(**row) for row in content["folds"]])


def submit(
    *,
    fitted: Annotated[FitOptions, FLATTENED],
    server: Server = None,
    token: Token = None,
    wait: bool = False,
    out: Path | None = None,
    name: str = "",
    quiet: Quiet = False,
) -> None:
    """Send recordings to a server and have it fit them, as tune does on this machine.

    Parameters
    ----------
    wait
        Wait for the end, show what happens, and fetch the result, as tune does.
    out
        With --wait, fetch the result into this folder. Default: runs/ and the time.
    name
        Call the job so in lists.
    """
    from tuner.cli.progress import progress_on_terminal
    from tuner.cli.results import print_run
    from tuner.result import place_for
    from tuner.service.client import is_success

    with client_of(server, token) as client:
        if wait:
            place_for(out)
        job = client.submit(fitted, name=name)
        if not wait:
            print(job if quiet else f"job {job}: {client.url}/jobs/{job}")
            return
        try:
            with progress_on_terminal(quiet=quiet) as listener:
                show(client.follow(job), listener)
        except KeyboardInterrupt:
            if not quiet:
                print(f"Job {job} goes on at the server: tune watch {job}, or tune cancel {job}.")
            raise
        is_success(client.job(job))
        run = client.fetch(job, out)
    if not quiet:
        print_run(run.folder, run.result)


def jobs(
    *,
    server: Server = None,
    token: Token = None,
    vehicle: str | None = None,
    state: Literal["queued", "running", "done", "failed", "cancelled"] | None = None,
    after: str | None = None,
    json: bool = False,
) -> None:
    """List the jobs of a server, the newest first, fifty at a time.

    Parameters
    ----------
    vehicle
        List those of this vehicle.
    state
        List those in this state.
    after
        List those that were submitted before this job.
    json
        Print JSON instead of a table.
    """
    from tuner.cli.results import console, rich_table
    from tuner.report.section import Table

    with client_of(server, token) as client:
        page = client.jobs(vehicle=vehicle, state=state, after=after)
    if json:
        from json import dumps

        print(dumps(page, indent=2))
        return
    rows = [
        (
            _in_a_line(job["id"]),
            _state_of(job),
            *(_in_a_line(job[key]) for key in ("vehicle", "name")),
            _in_a_line(job["submitted"][:16].replace("T", " ")),
            "" if job["rmse"] is None else f"{1000 * job['rmse']:.2f}",
            _in_a_line(job["error"] or (job["stage"] if job["state"] == "running" else "") or ""),
        )
        for job in page["jobs"]
    ]
    columns = ("job", "state", "vehicle", "name", "submitted", "RMSE mm", "")
    words = tuple(name for name in columns if name != "RMSE mm")
    screen = console()
    screen.print(rich_table(Table(columns, rows, words=words)))
    if page["next"]:
        screen.print(f"more with --after {page['next']}")


def _state_of(job: Mapping[str, Any]) -> str:
    """Return a job's state, and of one that is done whether its result can be used."""
    return _in_a_line(", ".join(filter(None, (job["state"], job.get("usability")))))


def _in_a_line(word: str) -> str:
    """Return a server's word so that the terminal takes nothing in it for control."""
    return "".join(c if c.isprintable() else "?" for c in word)


def watch(
    job: JobName, /, *, server: Server = None, token: Token = None, quiet: Quiet = False
) -> None:
    """Show what a job does until it ends, and end as tune would have ended.

    Parameters
    ----------
    job
        Its id.
    """
    from tuner.cli.progress import progress_on_terminal
    from tuner.service.client import is_success

    with client_of(server, token) as client:
        with progress_on_terminal(quiet=quiet, verbose=True) as listener:
            show(client.follow(job), listener)
        done = client.job(job)
        is_success(done)
    if not quiet:
        print(f"Job {job} is {_state_of(done)}; its result comes with: tune fetch {job}")


def fetch(
    job: JobName,
    /,
    *,
    server: Server = None,
    token: Token = None,
    out: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Fetch the result folder of a job that is done, and print it as tune does.

    Parameters
    ----------
    job
        Its id.
    out
        Write into this folder. Default: runs/ and the time.
    """
    from tuner.cli.results import print_run

    with client_of(server, token) as client:
        run = client.fetch(job, out)
    if not quiet:
        print_run(run.folder, run.result)


def cancel(job: JobName, /, *, server: Server = None, token: Token = None) -> None:
    """Cancel a job; what its search has found so far is kept there, for a retry.

    Parameters
    ----------
    job
        Its id.
    """
    with client_of(server, token) as client:
        cancelled = client.cancel(job)["id"]
    print(f"job {_in_a_line(cancelled)}: cancelled")


def watch_folder(
    folder: Path,
    /,
    *,
    server: Server = None,
    token: Token = None,
    settle: Annotated[
        float, Parameter(help="Take a recording once it has not changed for s.")
    ] = 10,
    once: bool = False,
) -> None:
    """Submit a job whenever new recordings in a folder have settled.

    Recordings that arrive together become one job; a tune.yaml in the folder is its job file. What
    was submitted is noted in the folder, so that nothing is submitted twice.

    Parameters
    ----------
    folder
        Watch this folder.
    once
        Submit what is new there, and end.
    """
    from tuner.service.client import watch

    with client_of(server, token) as client:
        watch(client, folder, settle=settle, once=once, say=lambda text: print(text, flush=True))
