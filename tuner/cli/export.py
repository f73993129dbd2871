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
    """Write the coefficients of a run for a simulator, if they hold there.

    Parameters
    ----------
    run
        Result folder.
    format
        yaml is the vehicle file with confidences, sdf a model of Gazebo classic or gz-sim, px4 the
        parameters.
    into
        The model (.sdf or .sdf.jinja) to put the coefficients into; without, the tags alone.
    out
        File to write. Default: the model itself, or export/ in the result folder.
    simulator
        Whose plugins tags without a model are for.
    accept
        Export in spite of conditions that are not met, for this reason.
    """
    from datetime import date

    from tuner.runtime import configure

    configure()
    from tuner.exporters.export import export as export_run
    from tuner.exporters.refly import refly
    from tuner.result import read_run

    done = export_run(
        read_run(run),
        format,
        refly=refly,
        today=date.today(),
        into=into,
        out=out,
        simulator=simulator,
        accept=accept,
    )
    if not quiet:
        from tuner.cli.tables import print_export

        print_export(done)
