"""Exports from a run to files: numbers, provenance, gates, writing, reading back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from pydantic import JsonValue

from tuner.config import ExportSettings
from tuner.core.disk import check_file, exists, file_name, inside
from tuner.core.errors import ExportError, InputError
from tuner.evaluate.records import RMSE_UNITS, AxesRmse
from tuner.exporters import laws
from tuner.exporters.draws import draws_of, write_draws
from tuner.exporters.effective import (
    Effective,
    bound_at,
    cached_effective,
    exported_numbers,
    lost_groups,
    refly,
)
from tuner.exporters.simulators import GAZEBO_CLASSIC
from tuner.exporters.target import (
    Draft,
    Target,
    check_every_coefficient,
    not_carried,
    target_of,
    with_unit,
    write,
)
from tuner.options import ExportOptions
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
from tuner.uncertainty.verdict import judgement_in_words
from tuner.vehicle import COEFFICIENTS, VehicleFile, read_vehicle, values_of

FOLDER = EXPORTS

#: Simulates all flights of a run with a vehicle -> flight name -> RMSE, None for a crash.
Refly = Callable[[Run, VehicleFile], Mapping[str, AxesRmse]]

#: Share by which the RMSE of a flight that checks the run may grow in the fit.
MAX_RMSE_INCREASE = 0.01
#: Equal RMSEs differ by less, relatively or in m and degrees.
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 0.01, 1e-4
#: The RMSE in the target's simulator may exceed that of this project's by a factor and an offset.
MAX_RMSE_RATIO, RMSE_SLACK_M, RMSE_SLACK_DEG = 2.0, 0.02, 2.0
#: Hover throttles, 0..1, may differ by this.
THROTTLE_TOLERANCE = 0.005

#: The conditions of a run.
RUN_CONDITIONS = (
    "every trajectory of the run is flown without a crash",
    "the exported numbers fly as the run says",
    "no flight that checks the run is worse than before",
    "no coefficient that flights tell sits on a bound",
)


@dataclass(frozen=True)
class ExportedFile:
    """An exported file.

    Attributes
    ----------
    gates
        The checked conditions; unmet ones were accepted.
    notes
        Remarks, and coefficients that the format lacks.
    """

    path: Path
    gates: tuple[Gate, ...]
    notes: tuple[str, ...]


def export(
    run: Run,
    options: ExportOptions,
    *,
    today: date,
    refly: Refly = refly,
    copies: Path | None = None,
) -> ExportedFile:
    """Write a run's coefficients in a format, if they pass the gates.

    Parameters
    ----------
    run
        A result folder. A target that lacks some of its terms gets its effective coefficients,
        unless its job wants the physical ones.
    options
        The format, and the path. A reason to export in spite of unmet gates goes into the
        provenance.
    copies
        Folder for a patched copy of the model.

    Raises
    ------
    ExportError
        A gate is not met, the model cannot be patched, or the file would not read back.
    OutputError
        The file cannot be written.
    """
    target, into, out = target_of(options.format), options.into, options.out
    if out is not None and out.name in OF_A_RUN:
        _refuse_overwrite(out, run.folder / out.name)
    target = target.for_simulator(options.simulator, into)
    own = f"{FOLDER}/{file_name(run.vehicle.name, target.suffix)}"
    if out is None or out.suffix:  # before anything is computed
        check_file(out or into or inside(run.folder, own))
    physical, (run, effective) = run, run_in_simulator(run, target)
    vehicle, decided = exported_vehicle(run, today)
    check_every_coefficient(physical.vehicle, target)
    line = provenance(run, today, options.accept)
    if effective is not None:
        line = f"{exported_numbers(effective, target.simulator.title)}; {line}"
        decided = (
            f"these are {exported_numbers(effective, target.simulator.title)}",
            *decided,
            *lost_groups(effective, target.simulator.entry, target.simulator.deviations),
        )
    draft = target.draft(vehicle, line, target.simulator, into)
    if into is not None and copies is not None and out is None:
        out = copies if draft.others else inside(copies, into.name)
    places = _output_paths(draft, out or into or inside(run.folder, own), into)
    gates = (
        *draft.gates,
        check_hover(target.simulator.flown(vehicle), draft.vehicle),
        *check(run, draft.vehicle, refly),
    )
    flown: tuple[str, ...] = ()
    if draft.flier is not None and run.result.flights:
        gate, sentence = check_in_simulator(run, draft, refly, target.simulator.title)
        gates, flown = (*gates, gate), (sentence,)
    require_gates(run.folder, gates, options.accept, "fit again")
    write(draft, *places)
    notes = (*decided, *flown, *draft.notes, *not_carried(vehicle, target))
    if places[0].is_relative_to(run.folder):
        file = places[0].relative_to(run.folder).as_posix()
        _record(run.folder, ExportRecord(format=options.format, file=file, gates=gates))
    return ExportedFile(places[0], gates, notes)


def _refuse_overwrite(out: Path, read: Path) -> None:
    """Refuse to overwrite the source of the numbers."""
    if out.resolve() == read.resolve():
        raise ExportError("--out", f"{out} is what is exported", "name another file")


def _record(folder: Path, made: ExportRecord) -> None:
    """Record an export, or a refusal, in a result folder."""
    known = ExportRecords.read_if_any(folder) or ExportRecords()
    ExportRecords(exports={**known.exports, made.format: made}).write(folder)


def export_vehicle(file: Path, options: ExportOptions, *, today: date) -> ExportedFile:
    """Write the coefficients of a vehicle file in a format, without a check by flights.

    Parameters
    ----------
    file
        The vehicle file; the ``source`` of each number becomes a note.
    options, today
        As of `export`; by default it is written beside the vehicle file.

    Raises
    ------
    ConfigError
        The file is no vehicle file.
    ExportError, OutputError
        As of `export`.
    """
    vehicle = read_vehicle(file)
    if options.out is not None:
        _refuse_overwrite(options.out, file)
    target = target_of(options.format).for_simulator(options.simulator, options.into)
    simulator = target.simulator
    check_every_coefficient(vehicle, target)
    line, sources = provenance_of_file(vehicle, file, today, options.accept)
    draft = target.draft(vehicle, line, simulator, options.into)
    beside = file.with_name(f"{file.stem}{target.suffix}")
    if beside.name == file.name:
        beside = file.with_name(f"{file.stem}_exported{target.suffix}")
    if options.out is None and options.into is None and exists(beside):
        raise ExportError(beside, "is there already", "name the file to write with --out")
    places = _output_paths(draft, options.out or options.into or beside, options.into)
    gates = (*draft.gates, check_hover(simulator.flown(vehicle), draft.vehicle), *gates_not_run())
    require_gates(file, gates, options.accept, "correct the vehicle file or the model")
    write(draft, *places)
    lacks = (f"{simulator.name} computes otherwise: {what}" for what in simulator.deviations)
    notes = (*sources, *draft.notes, *not_carried(vehicle, target), *lacks)
    return ExportedFile(places[0], gates, notes)


def export_draws(
    run: Run, options: ExportOptions, *, today: date, refly: Refly = refly
) -> ExportedFile:
    """Write draws of a run's joint posterior in a format, once the run itself may be exported.

    Parameters
    ----------
    run, options, today, refly
        As of `export`; written into a folder, by default ``export/draws`` in the result folder.

    Raises
    ------
    InputError
        As `export` raises, or the run has no covariance to draw from.
    """
    assert options.draws is not None
    folder = options.out or run.folder / FOLDER / "draws"
    draws = draws_of(run, options.draws)
    target = target_of(options.format).for_simulator(options.simulator)
    name = file_name(run.vehicle.name, target.suffix)
    first = replace(options, out=inside(folder, name))
    done = export(run, first, today=today, refly=refly)
    flying, _ = run_in_simulator(run, target)
    line = f"draw of the posterior; {provenance(run, today, options.accept)}"
    notes = write_draws(draws, flying.vehicle, folder, target, line)
    return replace(done, path=folder, notes=(*done.notes, *notes))


def require_gates(subject: Path, gates: Sequence[Gate], accept: str, remedy: str) -> None:
    """Refuse numbers that fail a gate, unless a reason accepts them.

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


def _output_paths(draft: Draft, path: Path, into: Path | None) -> tuple[Path, dict[Path, Path]]:
    """Return the path of a draft, and further file -> its path.

    A model of several files is overwritten, or written into a folder with its folders.
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


def export_formats_of_job(
    folder: Path, wanted: ExportSettings, *, today: date, refly: Refly = refly
) -> Iterator[tuple[str, Path | InputError]]:
    """Write all formats of a job into its result folder; a refused one is no failure of the run.

    Parameters
    ----------
    wanted
        Formats, and the model for ``sdf``, of which a copy is patched.

    Yields
    ------
    tuple
        Each format with its file, or with the error.
    """
    run = read_run(folder)
    for kind in wanted.formats:
        into = wanted.into if target_of(kind).simulator_of else None
        try:
            options, copies = ExportOptions(kind, into=into), folder / FOLDER
            done = export(run, options, today=today, refly=refly, copies=copies)
            yield kind, done.path
        except InputError as error:
            _record(folder, ExportRecord(format=kind, refused=str(error)))
            yield kind, error


def exported_vehicle(run: Run, today: date) -> tuple[VehicleFile, tuple[str, ...]]:
    """Return the run's best vehicle with source and confidence, and a note on each doubtful number.

    Coefficients that the run held have their initial values, the others those fitted with them.
    """
    notes = tuple(
        f"{name} = {row.best:g} is {judgement_in_words(row.verdict, row.reason)}"
        for name, row in run.result.coefficients.items()
        if row.fitted and (row.identifiable is False or row.reason.bound is not None)
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
    """Return a line on the origin of a run's numbers."""
    fitted = [flight.name for flight in run.result.flights if flight.split == "fit"]
    how = f"fitted to {', '.join(fitted)}" if fitted else "measured, no flight was simulated"
    line = f"{how}; run {run.folder.resolve().name}; {today.isoformat()}"
    return _one_line(line, accepted)


def _one_line(provenance: str, accepted: str) -> str:
    """Return origin and reason of acceptance as one printable line."""
    line = f"{provenance}; exported against a refusal: {accepted}" if accepted else provenance
    return " ".join("".join(c if c.isprintable() else " " for c in line).split())


def provenance_of_file(
    vehicle: VehicleFile, file: Path, today: date, accepted: str = ""
) -> tuple[str, tuple[str, ...]]:
    """Return a line on the origin of a vehicle file's numbers, and one per ``source`` entry."""
    how = vehicle.source.get("method", "as the vehicle file has it")
    line = f"{file.name}: {how}; no flight was compared; {today.isoformat()}"
    values = values_of(vehicle)
    sources = tuple(
        f"{name} {with_unit(values[name], COEFFICIENTS[name])}: {text}"
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


def run_in_simulator(run: Run, target: Target) -> tuple[Run, EffectiveResult | None]:
    """Return a run with effective coefficients for a target's simulator, and their result.

    The run stays as it is if no term is missing, or if the job wants physical coefficients.
    """
    simulator, found = target.simulator, None
    job = run.result.settings.get("job")
    wanted = job.get("target") if isinstance(job, dict) else None
    if not simulator.name or wanted == "physical":
        return run, None
    if simulator is GAZEBO_CLASSIC and run.effective is not None and run.result.effective:
        found = Effective(run.effective, run.result.effective)
    else:
        with suppress(InputError):  # missing recordings fail the gate that flies them
            found = cached_effective(run, simulator)
    if found is None:
        return run, None
    effective = found.result
    for flight in run.result.flights:
        if flight.name not in effective.flights:
            what = f"its effective coefficients were flown along no flight '{flight.name}'"
            raise ExportError(run.folder, what, "was it edited? fit again")
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


def check(run: Run, vehicle: VehicleFile, refly: Refly) -> tuple[Gate, ...]:
    """Check a run and the vehicle as exported against every condition."""
    if not run.result.flights:
        return (*gates_not_run()[:-1], Gate(RUN_CONDITIONS[-1], tuple(_on_bounds(run))))
    try:
        flown = refly(run, vehicle)
        differing = [*_differing(run, flown)]
    except InputError as error:
        flown, differing = {}, [f"the flights cannot be flown again ({error})"]
    objections = (_crashes(flown), differing, _worse_flights(run), _on_bounds(run))
    return tuple(Gate(name, tuple(o)) for name, o in zip(RUN_CONDITIONS, objections, strict=True))


def check_in_simulator(
    run: Run, draft: Draft, refly: Callable[..., Mapping[str, AxesRmse]], title: str
) -> tuple[Gate, str]:
    """Check an export by flying it in its own, installed, simulator.

    Returns the gate, and a sentence on the RMSEs there.
    """
    there = refly(run, draft.vehicle, draft.flier)
    objections = list(_crashes(there))
    for flight in run.result.flights:
        own, other = flight.rmse_best, there[flight.name]
        for signal, slack, unit in (
            ("position", RMSE_SLACK_M, "m"),
            ("attitude", RMSE_SLACK_DEG, "deg"),
        ):
            expected, found = own.norm(signal), other.norm(signal)
            if math.isfinite(found) and found > expected * MAX_RMSE_RATIO + slack:
                objections.append(
                    f"{flight.name} is missed by {found:.3g} {unit}, expected {expected:.3g}"
                )
    missed = "; ".join(
        f"{name} {1000 * rmse.norm('position'):.3g} mm, {rmse.norm('attitude'):.2g}°"
        for name, rmse in there.items()
    )
    return Gate(f"{title} itself flies it so", tuple(objections)), f"flown in {title}: {missed}"


def gates_not_run() -> tuple[Gate, ...]:
    """Return the conditions of a run, for a vehicle without one."""
    return tuple(Gate(name, (), ran=False) for name in RUN_CONDITIONS)


def check_hover(wanted: VehicleFile, there: VehicleFile) -> Gate:
    """Check an export by thrust and hover, which need no flight.

    Parameters
    ----------
    wanted
        The vehicle that the simulator should fly.
    there
        The vehicle that it flies with the written file.
    """
    objections = []
    ratio, expected = laws.thrust_to_weight(there), laws.thrust_to_weight(wanted)
    if not math.isclose(ratio, expected, rel_tol=RELATIVE_TOLERANCE):
        objections.append(f"full thrust is {ratio:.3g} times the weight, should be {expected:.3g}")
    hover, wanted_hover = laws.hover_command(there), laws.hover_command(wanted)
    if hover is None:
        objections.append(f"it cannot hover, its full thrust is {ratio:.3g} times its weight")
    elif wanted_hover is None or abs(hover - wanted_hover) > THROTTLE_TOLERANCE:
        should = "none at all" if wanted_hover is None else f"{wanted_hover:.3f}"
        objections.append(f"it hovers at a throttle of {hover:.3f}, should be {should}")
    return Gate("thrust to weight and hover throttle are the vehicle's", tuple(objections))


def _crashes(flown: Mapping[str, AxesRmse]) -> Iterator[str]:
    return (f"{name} crashes" for name, rmse in flown.items() if rmse.x is None)


def _differing(run: Run, flown: Mapping[str, AxesRmse]) -> Iterator[str]:
    for flight in run.result.flights:
        again = flown.get(flight.name)
        if again is None:
            yield f"{flight.name} was not flown again"
            continue
        for axis in RMSE_UNITS:
            then, now = getattr(flight.rmse_best, axis), getattr(again, axis)
            if then is None or now is None:
                continue
            if not math.isclose(then, now, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE):
                yield f"{flight.name} {axis} gives {now:.4g}, the run {then:.4g}"


def _worse_flights(run: Run) -> Iterator[str]:
    flights = run.result.flights
    for flight in [one for one in flights if one.split == "holdout"] or flights:
        for what, unit in (("position", "m"), ("attitude", "degrees")):
            before, after = (flight.rmse_initial.norm(what), flight.rmse_best.norm(what))
            if math.isinf(after):
                yield f"{flight.name} crashes"
                break
            if after > before * (1 + MAX_RMSE_INCREASE) + ABSOLUTE_TOLERANCE:
                yield f"{flight.name} {what} {after:.4g} {unit}, before {before:.4g}"


def _on_bounds(run: Run) -> Iterator[str]:
    """Yield the coefficients on bounds that flights tell, and that are not zero there.

    The others move no flight: notes of the export name them.
    """
    for name, coefficient in run.result.coefficients.items():
        if coefficient.fitted and coefficient.identifiable is not False:
            best, bounds = coefficient.best, (coefficient.lower, coefficient.upper)
            if side := bound_at(coefficient.initial, best, *bounds):
                yield f"{name} {best:g} is its {side} bound"
