"""The exports that a job asks for, once its run has finished."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date
from pathlib import Path

from tuner.config.job import ExportSettings
from tuner.errors import InputError
from tuner.exporters.export import export
from tuner.exporters.gates import Refly
from tuner.exporters.target import target_of
from tuner.result import read_run

FOLDER = "export"


def exports_of_job(
    folder: Path, wanted: ExportSettings, *, refly: Refly, today: date
) -> Iterator[str]:
    """Write every format that a job asks for into its result folder.

    A format that is refused is no failure of the run: the line gives the reason.

    Parameters
    ----------
    folder
        A finished result folder.
    wanted
        Formats, and the model for ``sdf``, which stays as it is.
    refly, today
        As of `export`.

    Yields
    ------
    str
        One line a format.
    """
    run = read_run(folder)
    for kind in wanted.formats:
        target = target_of(kind)
        into = wanted.into if target.patches else None
        name = into.name if into else f"{run.vehicle.name}{target.suffix}"
        out = folder / FOLDER / name
        try:
            done = export(run, kind, refly=refly, today=today, into=into, out=out)
            yield f"exported {done.path}"
        except InputError as error:
            yield f"not exported as {kind}: {error}"
