"""``tune cancel``: a job on a server, ended without a result."""

from __future__ import annotations

from tuner.cli.server_options import JobName, Server, Token, client_of


def cancel(job: JobName, /, *, server: Server = None, token: Token = None) -> None:
    """Cancel a job; what its search has found so far is kept there, for a retry.

    Parameters
    ----------
    job
        Its id.
    """
    with client_of(server, token) as client:
        client.cancel(job)
    print(f"job {job}: cancelled")
