"""``tune report``: render a run's page again."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tuner.cli.options import Quiet


def report(
    run: Path,
    /,
    *,
    open_: Annotated[bool, Parameter(name="--open", negative=())] = False,
    plots: bool = False,
    quiet: Quiet = False,
) -> None:
    """Render report.html of a result folder again, from what the folder holds.

    Parameters
    ----------
    run
        The result folder.
    open_
        Show the page in the browser.
    plots
        Also write its figures as SVG, into plots/ of the folder.
    """
    from tuner.core.errors import InputError
    from tuner.report import render

    path = render(run, plots=plots)
    if open_ and not webbrowser.open(path.resolve().as_uri()):
        raise InputError("--open", "finds no browser here", f"open {path} yourself")
    if not quiet:
        print(path)
