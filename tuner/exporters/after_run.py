"""The exports that a job asks for, once its run has finished."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date
from pathlib import Path

from tuner.config.job import ExportSettings
from tuner.errors import InputError
from tuner.exporters.export import FOLDER, export
from tuner.exporters.gates import Refly
from tuner.exporters.target import target_of
from tuner.result import read_run


def exports_of_job(
    folder: Path, wanted: ExportSettings, *, refly: Refly, today: date
) -> Iterator[tuple[str, Path | InputError]]:
    """Write every format that a job asks for into its result folder.

    A format that is refused is no failure of the run.

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
    tuple
        Each format with the file that was written, or with the reason why it was not.
    """
    run = read_run(folder)
    for kind in wanted.formats:
        into = wanted.into if target_of(kind).patches else None
        out = folder / FOLDER / into.name if into else None
        try:
            yield kind, export(run, kind, refly=refly, today=today, into=into, out=out).path
        except InputError as error:
            yield kind, error
