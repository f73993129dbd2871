"""``tune watch``: a job on a server, as it goes."""

from __future__ import annotations

from tuner.cli.options import Quiet
from tuner.cli.server_options import JobName, Server, Token, client_of, show


def watch(
    job: JobName, /, *, server: Server = None, token: Token = None, quiet: Quiet = False
) -> None:
    """Show what a job does until it ends, and end as tune would have ended.

    Parameters
    ----------
    job
        Its id.
    """
    from tuner.cli.progress import listening
    from tuner.client.client import ended_well

    with client_of(server, token) as client:
        with listening(quiet=quiet) as listener:
            show(client.follow(job), listener)
        ended_well(client.job(job))
    if not quiet:
        print(f"Job {job} is done; its result comes with: tune fetch {job}")
