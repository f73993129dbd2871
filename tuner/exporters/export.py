"""Exports from a run to files, one or all that a job asks for: gates, writing, reading back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from tuner.config.job import ExportSettings
from tuner.disk import check_file, file_name, inside
from tuner.errors import ExportError, InputError
from tuner.exporters.draft import write
from tuner.exporters.gates import Gate, Refly, check
from tuner.exporters.provenance import exported_vehicle, in_simulator, provenance
from tuner.exporters.target import (
    Choices,
    Simulator,
    check_every_coefficient,
    not_carried,
    target_of,
)
from tuner.result import Run, read_run
from tuner.wording.result import what_is_exported, what_is_lost

FOLDER = "export"
"""Of a result folder, for its exports."""


@dataclass(frozen=True)
class Exported:
    """A file that was written and read back.

    Attributes
    ----------
    path
        The file.
    gates
        The conditions that were checked; those not met were accepted.
    notes
        What was done, and what the format has no place for.
    """

    path: Path
    gates: tuple[Gate, ...]
    notes: tuple[str, ...]


def export(
    run: Run,
    kind: str,
    *,
    refly: Refly,
    today: date,
    into: Path | None = None,
    out: Path | None = None,
    simulator: Simulator = "gazebo-classic",
    accept: str = "",
) -> Exported:
    """Write a run's coefficients in a format, if they hold there.

    Parameters
    ----------
    run
        A result folder. A target that lacks some of its terms gets its effective coefficients,
        unless its job wants the physical ones.
    kind
        The name of a target, as ``yaml``, ``sdf`` or ``px4``.
    refly
        Flies the run's flights with a vehicle.
    today
        For the provenance.
    into
        With ``sdf``, the model to patch; without, the tags alone are written.
    out
        Where to write; by default the model itself, or ``export/`` in the result folder.
    simulator
        Whose plugins a bare snippet is for.
    accept
        A reason to export in spite of gates that are not met; it goes into the provenance.

    Raises
    ------
    ExportError
        A gate is not met, the model cannot be patched, or the file would not read back.
    OutputError
        The file cannot be written.
    """
    target = target_of(kind)
    own = f"{FOLDER}/{file_name(run.vehicle.name, target.suffix)}"
    path = out or into or inside(run.folder, own)
    check_file(path, folder_is_made=True)
    if into is not None and not target.patches:
        raise ExportError("--into", f"does not go with --format {kind}", "leave it out")
    physical, run = run, in_simulator(run, target)
    vehicle, decided = exported_vehicle(run, today)
    check_every_coefficient(physical.vehicle, target)
    line, effective = provenance(run, today, accept), physical.result.effective
    if run is not physical and effective is not None:
        line = f"{what_is_exported(effective)}; {line}"
        decided = (*decided, *what_is_lost(effective, target.entry))
    draft = target.draft(vehicle, line, Choices(into, simulator))
    gates = check(run, draft.vehicle, refly)
    refused = [objection for gate in gates for objection in gate.objections]
    if refused and not accept:
        raise ExportError(
            run.folder,
            f"its numbers are not fit to export: {'; '.join(refused)}",
            "fit again, or export with --accept 'REASON'",
        )
    write(draft, path)
    return Exported(path, gates, (*decided, *draft.notes, *not_carried(vehicle, target)))


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
        try:
            out = inside(folder / FOLDER, into.name) if into else None
            yield kind, export(run, kind, refly=refly, today=today, into=into, out=out).path
        except InputError as error:
            yield kind, error
