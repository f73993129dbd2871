"""Exports from a run to files: which numbers, their origin, gates, writing, reading back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from pydantic import JsonValue

from tuner.config.job import ExportSettings
from tuner.core.disk import check_file, file_name, inside
from tuner.core.errors import ExportError, InputError
from tuner.exporters.draws import draws_of, write_draws
from tuner.exporters.effective import Effective, kept_effective, refly
from tuner.exporters.gates import Refly, check, check_hover, check_in_simulator, not_flown
from tuner.exporters.simulators import GAZEBO_CLASSIC
from tuner.exporters.target import (
    Draft,
    Target,
    check_every_coefficient,
    not_carried,
    quantity,
    target_of,
    write,
)
from tuner.options import ExportOptions
from tuner.report.result_texts import what_is_exported, what_is_lost
from tuner.result import (
    EXPORTS,
    OF_A_RUN,
    EffectiveResult,
    ExportRecord,
    ExportRecords,
    Gate,
    Run,
    read_run,
)
from tuner.uncertainty.verdict_texts import judgement_in_words
from tuner.vehicle import COEFFICIENTS, VehicleFile, read_vehicle, values_of

FOLDER = EXPORTS


@dataclass(frozen=True)
class Exported:
    """A file that was written and read back.

    Attributes
    ----------
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
    asked: ExportOptions,
    *,
    today: date,
    refly: Refly = refly,
    copies: Path | None = None,
) -> Exported:
    """Write a run's coefficients in a format, if they hold there.

    Parameters
    ----------
    run
        A result folder. A target that lacks some of its terms gets its effective coefficients,
        unless its job wants the physical ones.
    asked
        The format, and where to write. A reason to export in spite of gates that are not met goes
        into the provenance.
    copies
        Folder for a copy of the model, which then stays as it is.

    Raises
    ------
    ExportError
        A gate is not met, the model cannot be patched, or the file would not read back.
    OutputError
        The file cannot be written.
    """
    target, into, out = target_of(asked.format), asked.into, asked.out
    own = f"{FOLDER}/{file_name(run.vehicle.name, target.suffix)}"
    if out is not None and out.name in OF_A_RUN:
        _keep(out, run.folder / out.name)
    if out is None or out.suffix:  # before anything is computed
        check_file(out or into or inside(run.folder, own))
    target = target.for_simulator(asked.simulator, into)
    physical, (run, effective) = run, in_simulator(run, target)
    vehicle, decided = exported_vehicle(run, today)
    check_every_coefficient(physical.vehicle, target)
    line = provenance(run, today, asked.accept)
    if effective is not None:
        line = f"{what_is_exported(effective, target.simulator.title)}; {line}"
        decided = (
            f"these are {what_is_exported(effective, target.simulator.title)}",
            *decided,
            *what_is_lost(effective, target.simulator.entry, target.simulator.deviations),
        )
    draft = target.draft(vehicle, line, target.simulator, into)
    if into is not None and copies is not None and out is None:
        out = copies if draft.others else inside(copies, into.name)
    places = _places(draft, out or into or inside(run.folder, own), into)
    gates = (
        *draft.gates,
        check_hover(target.simulator.flown(vehicle), draft.vehicle),
        *check(run, draft.vehicle, refly),
    )
    flown: tuple[str, ...] = ()
    if draft.flier is not None and run.result.flights:
        gate, sentence = check_in_simulator(run, draft, refly, target.simulator.title)
        gates, flown = (*gates, gate), (sentence,)
    refuse(run.folder, gates, asked.accept, "fit again")
    write(draft, *places)
    notes = (*decided, *flown, *draft.notes, *not_carried(vehicle, target))
    if places[0].is_relative_to(run.folder):
        file = places[0].relative_to(run.folder).as_posix()
        _record(run.folder, ExportRecord(format=asked.format, file=file, gates=gates))
    return Exported(places[0], gates, notes)


def _keep(out: Path, read: Path) -> None:
    """Refuse to write over what the numbers come from."""
    if out.resolve() == read.resolve():
        raise ExportError("--out", f"{out} is what is exported", "name another file")


def _record(folder: Path, made: ExportRecord) -> None:
    """Note in a result folder what was exported into it, or was not."""
    known = ExportRecords.read_if_any(folder) or ExportRecords()
    ExportRecords(exports={**known.exports, made.format: made}).write(folder)


def export_vehicle(file: Path, asked: ExportOptions, *, today: date) -> Exported:
    """Write the coefficients of a vehicle file in a format: no flight says that they are right.

    Parameters
    ----------
    file
        Of the vehicle; what its ``source`` says of each number is handed on.
    asked, today
        As of `export`; by default it is written beside the vehicle file.

    Raises
    ------
    ConfigError
        The file is no vehicle's.
    ExportError, OutputError
        As of `export`.
    """
    vehicle = read_vehicle(file)
    if asked.out is not None:
        _keep(asked.out, file)
    target = target_of(asked.format).for_simulator(asked.simulator, asked.into)
    simulator = target.simulator
    check_every_coefficient(vehicle, target)
    line, sources = provenance_of_file(vehicle, file, today, asked.accept)
    draft = target.draft(vehicle, line, simulator, asked.into)
    beside = file.with_name(f"{file.stem}{target.suffix}")
    if beside.name == file.name:
        beside = file.with_name(f"{file.stem}_exported{target.suffix}")
    places = _places(draft, asked.out or asked.into or beside, asked.into)
    gates = (*draft.gates, check_hover(simulator.flown(vehicle), draft.vehicle), *not_flown())
    refuse(file, gates, asked.accept, "correct the vehicle file or the model")
    write(draft, *places)
    lacks = (f"{simulator.name} computes otherwise: {what}" for what in simulator.deviations)
    notes = (*sources, *draft.notes, *not_carried(vehicle, target), *lacks)
    return Exported(places[0], gates, notes)


def export_draws(
    run: Run,
    asked: ExportOptions,
    *,
    today: date,
    refly: Refly = refly,
) -> Exported:
    """Write draws of a run's joint posterior in a format, once the run itself may be exported.

    Parameters
    ----------
    run, asked, today, refly
        As of `export`; written into a folder, by default ``export/draws`` in the result folder.

    Raises
    ------
    InputError
        As `export` raises, or the run has no covariance to draw from.
    """
    assert asked.draws is not None
    folder = asked.out or run.folder / FOLDER / "draws"
    draws = draws_of(run, asked.draws)
    target = target_of(asked.format).for_simulator(asked.simulator)
    name = file_name(run.vehicle.name, target.suffix)
    first = replace(asked, out=inside(folder, name))
    done = export(run, first, today=today, refly=refly)
    flying, _ = in_simulator(run, target)
    line = f"draw of the posterior; {provenance(run, today, asked.accept)}"
    notes = write_draws(draws, flying.vehicle, folder, target, line)
    return replace(done, path=folder, notes=(*done.notes, *notes))


def refuse(subject: Path, gates: Sequence[Gate], accept: str, remedy: str) -> None:
    """Refuse numbers against which something stands, unless a reason accepts them.

    Raises
    ------
    ExportError
        They are refused.
    """
    refused = dict.fromkeys(objection for gate in gates for objection in gate.objections)
    if refused and not accept:
        raise ExportError(
            subject,
            f"its numbers are not fit to export: {'; '.join(refused)}",
            f"{remedy}, or export with --accept 'REASON'",
        )


def _places(draft: Draft, path: Path, into: Path | None) -> tuple[Path, dict[Path, Path]]:
    """Return where a draft is written, and where its further files are.

    A model that is split over several files stays where it is, or is written into a folder, each
    file in a folder of the name of its own.
    """
    if into is None or path == into or not draft.others:
        check_file(path)
        return path, {}
    if path.suffix:
        raise ExportError(
            path,
            f"is one file, and {into} is split over {len(draft.others) + 1}",
            "give --out a folder, or leave it out to change the model where it is",
        )
    files = (into, *draft.others)
    places = {f: inside(path, f"{f.absolute().parent.name}/{f.name}") for f in files}
    for place in places.values():
        check_file(place)
    return places.pop(into), places


def exports_of_job(
    folder: Path,
    wanted: ExportSettings,
    *,
    today: date,
    refly: Refly = refly,
) -> Iterator[tuple[str, Path | InputError]]:
    """Write every format that a job asks for into its result folder.

    A format that is refused is no failure of the run.

    Parameters
    ----------
    wanted
        Formats, and the model for ``sdf``, which stays as it is.

    Yields
    ------
    tuple
        Each format with the file that was written, or with the reason why it was not.
    """
    run = read_run(folder)
    for kind in wanted.formats:
        into = wanted.into if target_of(kind).simulator_of else None
        try:
            asked, copies = ExportOptions(kind, into=into), folder / FOLDER
            done = export(run, asked, today=today, refly=refly, copies=copies)
            yield kind, done.path
        except InputError as error:
            _record(folder, ExportRecord(format=kind, refused=str(error)))
            yield kind, error


def exported_vehicle(run: Run, today: date) -> tuple[VehicleFile, tuple[str, ...]]:
    """Return the run's best vehicle with source and confidence, and a note on each doubtful number.

    What the run held at its initial value has that value there; what was fitted beside it keeps
    the value that goes with it.
    """
    notes = tuple(
        f"{name} = {row.best:g} is {judgement_in_words(row.verdict, row.reason)}"
        for name, row in run.result.coefficients.items()
        if row.fitted and row.identifiable is False
    )
    result = run.result
    source: dict[str, JsonValue] = {
        "run": str(run.folder.resolve()),
        "date": today.isoformat(),
        "versions": dict(result.versions),
        "flights": {
            flight.name: f"{flight.split}, sha256 {flight.sha256}" for flight in result.flights
        },
        "coefficients": {name: _confidence(run, name) for name in result.coefficients},
    }
    return run.vehicle.replace(source=source), notes


def provenance(run: Run, today: date, accepted: str = "") -> str:
    """Return one line that says where the numbers come from."""
    fitted = [flight.name for flight in run.result.flights if flight.split == "fit"]
    how = f"fitted to {', '.join(fitted)}" if fitted else "measured, no flight was simulated"
    line = f"{how}; run {run.folder.resolve().name}; {today.isoformat()}"
    return _one_line(line, accepted)


def _one_line(provenance: str, accepted: str) -> str:
    """Return where numbers come from, and why in spite of a refusal, for a comment of any file."""
    line = f"{provenance}; exported against a refusal: {accepted}" if accepted else provenance
    return " ".join("".join(c if c.isprintable() else " " for c in line).split())


def provenance_of_file(
    vehicle: VehicleFile, file: Path, today: date, accepted: str = ""
) -> tuple[str, tuple[str, ...]]:
    """Return a line on where a vehicle file's numbers come from, and one on each that it says."""
    how = vehicle.source.get("method", "as the vehicle file has it")
    line = f"{file.name}: {how}; no flight was compared; {today.isoformat()}"
    values = values_of(vehicle)
    sources = tuple(
        f"{name} {quantity(values[name], COEFFICIENTS[name])}: {text}"
        for name, text in vehicle.source.items()
        if name in values
    )
    return _one_line(line, accepted), sources


def _confidence(run: Run, name: str) -> dict[str, JsonValue]:
    coefficient = run.result.coefficients[name]
    if not coefficient.fitted:
        return {"status": "fixed"}
    if coefficient.identifiable is False:
        words = judgement_in_words(coefficient.verdict, coefficient.reason)
        return {"status": words}
    known: dict[str, JsonValue] = {"status": "fitted"}
    if coefficient.std_error is not None:
        known["std_error"] = coefficient.std_error
    if coefficient.ci95 is not None:
        known["ci95"] = list(coefficient.ci95)
    return known


def in_simulator(run: Run, target: Target) -> tuple[Run, EffectiveResult | None]:
    """Return a run as a target's simulator flies it, and how that was found.

    The run itself where the simulator lacks nothing, where there is none, and where the job wants
    physical coefficients.
    """
    simulator, found = target.simulator, None
    job = run.result.settings.get("job")
    wanted = job.get("target") if isinstance(job, dict) else None
    if not simulator.name or wanted == "physical":
        return run, None
    if simulator is GAZEBO_CLASSIC and run.effective is not None and run.result.effective:
        found = Effective(run.effective, run.result.effective)
    else:
        with suppress(InputError):  # recordings that are gone: the gate that flies them says so
            found = kept_effective(run, simulator)
    if found is None:
        return run, None
    effective = found.result
    lost = {name for term in effective.lost for name in term.names}
    coefficients = {
        name: row.model_copy(update={"best": effective.coefficients[name]})
        for name, row in run.result.coefficients.items()
        if name in effective.coefficients
    }
    flights = tuple(
        flight.model_copy(
            update={
                "rmse_best": effective.flights[flight.name],
                "conditions": {n: v for n, v in flight.conditions.items() if n not in lost},
            }
        )
        for flight in run.result.flights
    )
    result = run.result.model_copy(update={"coefficients": coefficients, "flights": flights})
    return run.model_copy(update={"vehicle": found.vehicle, "result": result}), effective
