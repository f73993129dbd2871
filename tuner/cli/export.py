"""``tune export``: a run's coefficients into a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from tuner.cli.options import Quiet


def export(
    run: Path,
    /,
    *,
    format: str,  # noqa: A002 (the option's name)
    into: Path | None = None,
    out: Path | None = None,
    simulator: Literal["gazebo-classic", "gz-sim"] = "gazebo-classic",
    accept: Annotated[str, Parameter(name="--accept")] = "",
    quiet: Quiet = False,
) -> None:
    """Write the coefficients of a run for a simulator, once its flights fly there as in the run.

    Parameters
    ----------
    run
        Export from this result folder.
    format
        Write a vehicle file with confidence intervals (yaml), a model of Gazebo classic or gz-sim
        (sdf), or parameters of PX4 (px4).
    into
        Put the coefficients into this model (.sdf or .sdf.jinja). Default: write the tags alone.
    out
        Write this file. Default: the model itself, or export/ in the result folder.
    simulator
        Write tags without a model for the plugins of this simulator.
    accept
        Export although a condition is not met, and record this reason in the file.
    """
    from tuner.api import export as export_run

    done = export_run(run, format, into=into, out=out, simulator=simulator, accept=accept)
    if not quiet:
        from tuner.cli.tables import print_export

        print_export(done)
