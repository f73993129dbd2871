"""``tune report``: render a run's page again."""

from __future__ import annotations

from pathlib import Path

from tuner.cli.options import Quiet


def report(run: Path, /, *, quiet: Quiet = False) -> None:
    """Render report.html of a result folder again, from what the folder holds.

    Parameters
    ----------
    run
        The result folder.
    """
    from tuner.report import render

    path = render(run)
    if not quiet:
        print(path)
