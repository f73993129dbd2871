"""``tune jobs``: what a server has to do and has done."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from tuner.cli.server_options import Server, Token, client_of


def jobs(
    *,
    server: Server = None,
    token: Token = None,
    vehicle: str | None = None,
    state: Literal["queued", "running", "done", "failed", "cancelled"] | None = None,
    after: str | None = None,
    json: Annotated[bool, Parameter(negative=())] = False,
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
    from rich.table import Table

    from tuner.cli.tables import console

    with client_of(server, token) as client:
        page = client.jobs(vehicle=vehicle, state=state, after=after)
    if json:
        from json import dumps

        print(dumps(page, indent=2))
        return
    table = Table(box=None)
    for column in ("job", "state", "vehicle", "name", "submitted", "RMSE mm", ""):
        table.add_column(column, justify="right" if column == "RMSE mm" else "left")
    for job in page["jobs"]:
        rmse = "" if job["rmse"] is None else f"{1000 * job['rmse']:.2f}"
        about = job["error"] or (job["stage"] if job["state"] == "running" else "") or ""
        submitted = job["submitted"][:16].replace("T", " ")
        words = (job["id"], job["state"], job["vehicle"], job["name"], submitted, rmse, about)
        table.add_row(*(_plain(word) for word in words))
    screen = console()
    screen.print(table)
    if page["next"]:
        screen.print(f"more with --after {page['next']}")


def _plain(word: str) -> str:
    """Return a server's word so that the terminal takes nothing in it for markup or control."""
    from rich.markup import escape

    return escape("".join(c if c.isprintable() else "?" for c in word))
