"""``tune fetch``: the result of a job on a server."""

from __future__ import annotations

from pathlib import Path

from tuner.cli.options import Quiet
from tuner.cli.server_options import JobName, Server, Token, client_of


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
