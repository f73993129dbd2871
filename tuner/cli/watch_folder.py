"""``tune watch-folder``: new recordings in a folder become jobs on a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tuner.cli.server_options import Server, Token, client_of


def watch_folder(
    folder: Path,
    /,
    *,
    server: Server = None,
    token: Token = None,
    settle: Annotated[
        float, Parameter(help="Take a recording once it has not changed for s.")
    ] = 10,
    once: Annotated[bool, Parameter(negative=())] = False,
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
    from tuner.client.folder import watch

    with client_of(server, token) as client:
        watch(client, folder, settle=settle, once=once, say=lambda text: print(text, flush=True))
