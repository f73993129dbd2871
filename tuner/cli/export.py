"""``tune export``: the coefficients of a run, or of a vehicle file, into a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tuner.cli.options import Quiet


def export(
    run: Path,
    /,
    *,
    format: str,  # noqa: A002 (the option's name)
    into: Path | None = None,
    out: Path | None = None,
    simulator: str = "",
    accept: Annotated[str, Parameter(name="--accept")] = "",
    draws: int | None = None,
    quiet: Quiet = False,
) -> None:
    """Write the coefficients of a run, or a vehicle file, for a simulator.

    A run's are written once its flights fly there as in the run.

    Parameters
    ----------
    run
        Export from this result folder, or this vehicle file, which no flight is compared with.
    format
        Write a vehicle file with confidence intervals (yaml), numbers with units (json), a model of
        Gazebo classic (sdf) or gz-sim (gz-sim; or sdf, where the model is one), parameters of PX4
        (px4), MuJoCo's MJCF (mujoco), parameters of crazyflow (drone-models) or RotorPy (rotorpy),
        or arguments of Isaac Lab's multirotor (isaaclab).
    into
        Put the coefficients into this model (.sdf or .sdf.jinja), and into what it includes from
        folders beside its own. Default: write the tags alone.
    out
        Write this file; a folder, where the model is split over several. Default: the model itself,
        or export/ in the result folder.
    simulator
        Write for this simulator of a format's: gazebo-classic or gz-sim (sdf), sih or gz-sim
        (px4). Default: the one that the model is for, or the first.
    accept
        Export although a condition is not met, and record this reason in the file.
    draws
        Also write so many draws of the joint posterior into the folder --out: a table, a file for
        each in the format, and Isaac Lab's ranges. Default folder: export/draws of the result.
    """
    from tuner.api import export as export_run

    done = export_run(
        run, format, into=into, out=out, simulator=simulator, accept=accept, draws=draws
    )
    if not quiet:
        from tuner.cli.tables import print_export

        print_export(done)
