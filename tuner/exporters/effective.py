"""The second answer of a run: with which coefficients a simulator flies most like the vehicle.

Without the terms that it lacks, the coefficients of its own model are fitted once more from their
physical values, so that they stand in for what is missing as well as they can. Terms that it has a
place for stay as they are, and so does what belongs to the set-up and not to the simulator. Those
for Gazebo are found while a run is under way. Those for other simulators are found when an export
asks for them, from the result folder: its flights are flown again with clocks, latencies and air as
the run ended with them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from tuner.config import JobFile, Settings
from tuner.core.disk import make_folder
from tuner.core.errors import ConfigError, InputError
from tuner.core.files import ResultFile
from tuner.core.phrases import listed
from tuner.core.runtime import installed
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.held_out import comparison_of, controller_flown
from tuner.evaluate.records import AxesRmse
from tuner.evaluate.rmse import FlightErrors
from tuner.exporters.simulators import GAZEBO_CLASSIC, Simulator
from tuner.objective.criterion import Point, units_of
from tuner.objective.segments import OFFSETS
from tuner.objective.space import Space
from tuner.result import EffectiveResult, LostTerm, PoseRmse, Run, RunResult
from tuner.search.continuation import grow
from tuner.search.estimation import OnProgress, stages_of
from tuner.search.fitted import Fitted
from tuner.search.job_flights import (
    Recording,
    read_usable,
    with_conditions,
    with_inputs_late,
    with_offsets,
)
from tuner.search.optimiser import Free
from tuner.search.polish import polished
from tuner.search.problem import Job, job_of
from tuner.search.progress import beginning
from tuner.vehicle import (
    COEFFICIENTS,
    ControllerFile,
    NotCarried,
    VehicleFile,
    Written,
    initial_values,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import model_of

STAGES = slice(-3, None)
"""Of the search: whole flights, then the polish in the weights that what is missing leaves."""
LEFT = 1e-4
"""Share of the loss that may be left to gain: half as much of how far off the flights are."""


@dataclass(frozen=True)
class Effective:
    """The vehicle that Gazebo flies, and what it was found by."""

    vehicle: VehicleFile
    result: EffectiveResult


def effective_fit(
    job: Job,
    fitted: Fitted,
    vehicle: VehicleFile,
    physical: Mapping[str, FlightErrors],
    *,
    on_progress: OnProgress,
    on_message: Callable[[str], None],
) -> Effective | None:
    """Return the second answer; None where Gazebo lacks nothing of the first.

    Parameters
    ----------
    job, fitted
        The first answer.
    vehicle
        With its coefficients.
    physical
        Flight -> its errors with them.
    on_progress, on_message
        Called after every iteration, and before the fit.
    """
    lost = lost_terms(vehicle, fitted)
    if not lost:
        return None
    on_message(
        f"Gazebo cannot fly {listed(tuple(lost))}: looking for the coefficients with which it "
        "flies most like the vehicle."
    )
    names = [name for group in lost.values() for name in group]
    bare = GAZEBO_CLASSIC.lacking(vehicle, names)
    end, effective = refitted(job, fitted, bare, names, on_progress)
    comparisons: dict[frozenset[str], Comparison] = {}

    def flown(flying: VehicleFile, missing: Collection[str]) -> dict[str, AxesRmse]:
        conditions = frozenset(missing).intersection(fitted.objective.conditions)
        if conditions not in comparisons:
            still = replace(fitted, point=_without_conditions(fitted, conditions))
            comparisons[conditions] = comparison_of(job, still)
        errors = comparisons[conditions].fly(flying)
        return {name: flight.rmse for name, flight in errors.items()}

    result = _result(
        GAZEBO_CLASSIC,
        vehicle,
        effective,
        bare=bare,
        lost=lost,
        flown=flown,
        target="gazebo",
        physical={name: errors.rmse for name, errors in physical.items()},
        spinning=[flight.name for flight in job.flights if flight.spins_freely],
        carried=carried_terms(effective),
        converged=end.converged,
    )
    return Effective(effective, result)


def _result(
    simulator: Simulator,
    vehicle: VehicleFile,
    effective: VehicleFile,
    *,
    bare: VehicleFile,
    lost: Mapping[str, tuple[str, ...]],
    flown: Callable[[VehicleFile, Collection[str]], dict[str, AxesRmse]],
    target: str,
    physical: Mapping[str, AxesRmse],
    spinning: Collection[str],
    carried: tuple[str, ...],
    converged: bool,
) -> EffectiveResult:
    """Return how a simulator's vehicle flies, beside the physical one and one without a refit.

    Parameters
    ----------
    simulator, vehicle, effective, bare
        The simulator, the physical vehicle, its own, and the physical one without what it lacks.
    lost
        Group -> coefficients that the simulator lacks; none of its laws.
    flown
        A vehicle and what it lacks -> its errors, by flight.
    """

    def over_flights(rmse: Mapping[str, AxesRmse]) -> PoseRmse:
        return pose_rmse(axes for name, axes in rmse.items() if name not in spinning)

    def without(names: tuple[str, ...]) -> PoseRmse:
        flying = simulator.lacking(vehicle, names) if names else simulator.laws(vehicle)
        return over_flights(flown(flying, names))

    names = [name for group in lost.values() for name in group]
    flights = flown(effective, names)
    return EffectiveResult(
        target=target,
        coefficients=values_of(effective),
        lost=tuple(
            LostTerm(group=group, names=members, rmse_without=without(members))
            for group, members in lost.items()
        ),
        carried=carried,
        rmse_physical=over_flights(physical),
        rmse_unfitted=over_flights(flown(bare, names)),
        rmse_effective=over_flights(flights),
        flights=flights,
        converged=converged,
    )


def lost_terms(vehicle: VehicleFile, fitted: Fitted) -> dict[str, tuple[str, ...]]:
    """Return group -> its coefficients that act and that Gazebo flies at another value."""
    rows = np.asarray(fitted.point.offsets)[len(OFFSETS) :]
    conditions = {
        name: float(np.abs(row).max())
        for name, row in zip(fitted.objective.conditions, rows, strict=True)
    }
    return GAZEBO_CLASSIC.lost(values_of(vehicle) | conditions)


def carried_terms(vehicle: VehicleFile) -> tuple[str, ...]:
    """Return the terms beyond the motor model that act and that Gazebo has a place for."""
    entry = GAZEBO_CLASSIC.entry
    return tuple(
        name
        for name, value in vehicle.effects.items()
        if isinstance(entry(COEFFICIENTS[name]), Written) and value != COEFFICIENTS[name].neutral
    )


def refitted(
    job: Job,
    fitted: Fitted,
    bare: VehicleFile,
    lost: Collection[str],
    on_progress: OnProgress,
) -> tuple[Fitted, VehicleFile]:
    """Return the fit of what is left of a vehicle to the job's flights, and that vehicle.

    Parameters
    ----------
    job, fitted
        The first answer: flights, weights, clocks and set-up.
    bare
        Its vehicle without what Gazebo lacks. Of its coefficients those move that the first answer
        fitted, and that Gazebo's own model has.
    lost
        What Gazebo lacks.
    on_progress
        Called after every iteration.
    """
    values = initial_values(bare, job.settings.controller, fitted.objective.space.free)
    parameters = [
        _about(parameter, values[parameter.name])
        for parameter in fitted.objective.space.parameters
        if not set(lost).intersection(parameter.ratios)
        and parameter.name not in fitted.held
        and (row := COEFFICIENTS[parameter.name]).scope == "vehicle"
        and not row.is_effect
    ]
    model = replace(
        model_of(bare, controller_flown(job, fitted)),
        reference_voltage=fitted.objective.model.reference_voltage,
    )
    start = replace(
        fitted,
        objective=replace(fitted.objective, model=model),
        point=_without_conditions(fitted, lost),
    )
    end = _polished(job, start, parameters, on_progress)
    try:
        return end, _vehicle_at(bare, end)
    except ConfigError:  # together the moments are no rigid body's
        others = [p for p in parameters if COEFFICIENTS[p.name].place[0] != "inertia"]
        end = _polished(job, start, others, on_progress)
        return end, _vehicle_at(bare, end)


def _polished(
    job: Job, start: Fitted, parameters: Sequence[Parameter], on_progress: OnProgress
) -> Fitted:
    """Return the fit by some parameters alone, from where they begin."""
    space = Space(tuple(parameters), {}, size=start.objective.space.size)
    start = replace(
        start,
        objective=replace(start.objective, space=space),
        point=Point(np.asarray(space.initial), start.point.offsets),
    )
    if not parameters:
        return start
    return polished(
        job,
        start,
        free=Free(np.ones(len(space), bool), np.zeros(start.point.offsets.shape, bool)),
        title="for Gazebo",
        on_progress=lambda progress: on_progress(job, progress),
        stages=STAGES,
        left=LEFT,
    )


def _vehicle_at(bare: VehicleFile, end: Fitted) -> VehicleFile:
    space = end.objective.space
    moved = {name for parameter in space.parameters for name in parameter.ratios}
    numbers = space.numbers(end.point.coefficients)
    return with_values(bare, {name: numbers[name] for name in numbers if name in moved})


def _about(parameter: Parameter, value: float) -> Parameter:
    """Return a parameter that starts at its physical value, weakly held there.

    What was known of it beforehand is about the vehicle, not about a simulator that lacks terms.
    """
    weak = parameter.prior_sd
    if parameter.prior_given:
        weak = parameter.usual or COEFFICIENTS[parameter.name].prior_sd
    return replace(
        parameter,
        initial=value,
        prior_mean=parameter.scaled(value),
        prior_sd=weak,
        prior_given=False,
    )


def _without_conditions(fitted: Fitted, names: Collection[str]) -> Point:
    """Return a fit's point without some of its per-flight conditions."""
    of_flight = fitted.objective.of_flight
    keep = np.array([name not in names for name in of_flight])
    return Point(fitted.point.coefficients, fitted.point.offsets * keep[:, None])


def pose_rmse(flights: Iterable[AxesRmse]) -> PoseRmse:
    """Return the root mean square over flights of what each misses; a crash leaves none of it.

    That of attitude is over the flights that predict it, and follow it not.
    """
    rows = list(flights)
    crashed = any(row.x is None for row in rows)

    def together(*axes: str) -> float | None:
        of_flights = [[getattr(row, axis) for axis in axes] for row in rows]
        known = [values for values in of_flights if None not in values]
        if crashed or not known:
            return None
        return float(np.sqrt(np.sum(np.square(known)) / len(known)))

    return PoseRmse(position=together("x", "y", "z"), attitude=together("roll", "pitch", "yaw"))


def refly(
    run: Run, vehicle: VehicleFile, flier: Callable[..., Any] | None = None
) -> Mapping[str, AxesRmse]:
    """Return flight name to RMSE of a run's recordings, simulated whole with a vehicle.

    Parameters
    ----------
    run
        Gives the recordings, the controller that flew, and each flight's clock offset.
    vehicle
        What flies now.
    flier
        Flies it in another simulator, as of `tuner.exporters.flier.flier`.

    Raises
    ------
    InputError
        A recording is gone or has changed, or the result folder does not hold what flew.
    """
    if not run.result.flights:  # of ground measurements
        return {}
    settings, recordings = recordings_of(run)
    window = settings.job.search.window
    comparison = Comparison(recordings, settings.controller, window=window)
    flown = comparison.fly(vehicle) if flier is None else comparison.fly(vehicle, flier=flier)
    return {name: errors.rmse for name, errors in flown.items()}


def recordings_of(run: Run) -> tuple[Settings, tuple[Recording, ...]]:
    """Return the settings of a run, and its recordings with clocks and air as it ended with them.

    Raises
    ------
    InputError
        As of `refly`.
    """
    settings = _settings(run)
    wanted = {flight.name: flight for flight in run.result.flights}
    readable, _ = read_usable(settings, fits=False)
    recordings = tuple(r for r in readable if r.flight.name in wanted)
    if gone := sorted(set(wanted) - {r.flight.name for r in recordings}):
        raise InputError(wanted[gone[0]].path, "is not the recording of the run", "fit it again")
    for flight in (recording.flight for recording in recordings):
        if flight.sha256 != wanted[flight.name].sha256:
            raise InputError(flight.path, "is not the recording of the run", "fit it again")
    on_time = with_offsets(recordings, {name: f.time_offset for name, f in wanted.items()})
    on_time = with_conditions(on_time, {name: f.conditions for name, f in wanted.items()})
    on_time = with_inputs_late(on_time, {name: f.input_late for name, f in wanted.items()})
    return settings, tuple(on_time)


def _settings(run: Run) -> Settings:
    """Return how the run read its recordings.

    Inlets, and commands that follow from a commanded wrench, go by the vehicle that it began with.
    """
    settings = run.result.settings
    try:
        vehicle = VehicleFile.model_validate(settings["vehicle"])
        controller = ControllerFile.model_validate(settings["controller"])
        job = JobFile.model_validate(settings["job"])
    except (KeyError, ValidationError):
        raise InputError(
            run.folder / RunResult.FILE, "does not hold what flew", "fit again"
        ) from None
    paths = tuple(dict.fromkeys(Path(flight.path) for flight in run.result.flights))
    for path in paths:
        if not path.exists():
            raise InputError(
                path, "is not there any more", "run from the folder that the fit ran in"
            )
    return Settings(paths, vehicle, controller, job, None, {})


LAWS = "its laws"
"""What of a simulator is lost that no coefficient says."""
FOLDER = "effective"
"""Of a result folder, for the vehicles that simulators fly."""


class EffectiveFile(ResultFile):
    """A simulator's effective coefficients, kept beside the run that they are of.

    Attributes
    ----------
    of
        Hash of what they follow from: the run's vehicle, and this program's version.
    effective
        How they fly; None where the simulator lacks nothing.
    """

    of: str
    effective: EffectiveResult | None


def kept_effective(run: Run, simulator: Simulator) -> tuple[VehicleFile, EffectiveResult] | None:
    """Return what `effective_in` does, from the result folder where it was found before.

    Raises
    ------
    InputError
        As of `effective_in`.
    OutputError
        It cannot be kept.
    """
    vehicle_file = run.folder / FOLDER / f"{simulator.name}.yaml"

    class Kept(EffectiveFile):
        FILE = f"{FOLDER}/{simulator.name}.json"

    known = f"{values_of(run.vehicle)} {run.result.settings.get('job')} {installed()}"
    key = hashlib.sha256(known.encode()).hexdigest()
    with suppress(InputError):  # of another version: it is found again
        kept = Kept.read_if_any(run.folder)
        if kept is not None and kept.of == key:
            return None if kept.effective is None else (read_vehicle(vehicle_file), kept.effective)
    found = effective_in(run, simulator)
    make_folder(vehicle_file.parent)
    if found is not None:
        write_vehicle(found[0], vehicle_file, header=f"Effective in {simulator.title}.")
    Kept(of=key, effective=None if found is None else found[1]).write(run.folder)
    return found


def effective_in(run: Run, simulator: Simulator) -> tuple[VehicleFile, EffectiveResult] | None:
    """Return the vehicle with which a simulator flies most like a run's, and how it flies.

    None where the simulator lacks nothing of what acts.

    Raises
    ------
    InputError
        The run's recordings cannot be read again.
    """
    bare = simulator.flown(run.vehicle)
    if not run.result.flights or same_flight(bare, run.vehicle):
        return None
    settings, recordings = recordings_of(run)
    acting = values_of(run.vehicle)
    for recording in recordings:
        for name, value in recording.conditions.items():
            acting[name] = max(acting.get(name, 0.0), abs(value))
    lost = simulator.lost(acting)
    if not same_flight(simulator.laws(run.vehicle), run.vehicle):
        lost[LAWS] = ()
    names = sorted({name for members in lost.values() for name in members})
    still = tuple(
        replace(r, conditions={n: v for n, v in r.conditions.items() if n not in names})
        for r in recordings
    )
    comparison = Comparison(still, settings.controller, window=settings.job.search.window)

    def flown(vehicle: VehicleFile, _: Collection[str]) -> dict[str, AxesRmse]:
        errors = comparison.fly(vehicle)
        return {name: flight.rmse for name, flight in errors.items()}

    start = bare if simulator.start is None else simulator.flown(simulator.start(run.vehicle))
    vehicle, converged = fitted_in(run, simulator, start, settings, still)
    return vehicle, _result(
        simulator,
        run.vehicle,
        vehicle,
        bare=bare,
        lost=lost,
        flown=flown,
        target=simulator.name,
        physical={f.name: f.rmse_best for f in run.result.flights},
        spinning={r.flight.name for r in recordings if r.flight.spins_freely},
        carried=(),
        converged=converged,
    )


def same_flight(one: VehicleFile, other: VehicleFile) -> bool:
    """Return whether two vehicles fly alike."""
    laws = [
        v.aerodynamics.model_dump(include={"thrust_law", "reaction_torque"}) for v in (one, other)
    ]
    return laws[0] == laws[1] and values_of(one) == values_of(other)


def fitted_in(
    run: Run,
    simulator: Simulator,
    bare: VehicleFile,
    settings: Settings,
    recordings: tuple[Recording, ...],
) -> tuple[VehicleFile, bool]:
    """Return a simulator's vehicle fitted to a run's flights, and whether the fit converged."""
    movable = free_in(run, simulator, bare)
    inertia = [name for name in movable if COEFFICIENTS[name].place[0] == "inertia"]
    for free in (movable, [name for name in movable if name not in inertia]):
        if not free:
            break
        values, converged = _fit(free, simulator, bare, settings, recordings)
        try:
            return simulator.flown(with_values(bare, values)), converged
        except ConfigError:  # together the moments are no rigid body's
            continue
    return bare, True


def free_in(run: Run, simulator: Simulator, bare: VehicleFile) -> list[str]:
    """Return the coefficients that stand in for what a simulator lacks.

    Those that the run fitted and that the simulator has, and the simulator's own.
    """
    values = values_of(bare)
    names = []
    for name, row in COEFFICIENTS.items():
        found = run.result.coefficients.get(name)
        fitted = found is not None and found.fitted and found.verdict != "held"
        has = name not in simulator.fixed and not isinstance(simulator.entry(row), NotCarried)
        moves = name in simulator.free or (fitted and has and not row.is_effect)
        if moves and row.scope == "vehicle" and values.get(name, 0.0) != 0.0:
            names.append(name)
    return names


def _fit(
    free: list[str],
    simulator: Simulator,
    bare: VehicleFile,
    settings: Settings,
    recordings: tuple[Recording, ...],
) -> tuple[dict[str, float], bool]:
    """Return the values of free coefficients that meet the flights best."""
    conditions = tuple(sorted({name for r in recordings for name in r.conditions}))
    old = settings.job
    job = JobFile(
        free=tuple(free),
        ties=tuple(tie for tie in simulator.ties if set(tie) <= set(free)),
        terms=conditions or "none",
        disturbances="none",
        channels=old.channels,
        weights=old.weights,
        flights=old.flights,
        search=old.search.replace(method="gradient", starts=1),
        holdout=tuple(r.flight.name for r in recordings if r.holdout),
    )
    problem = job_of(replace(settings, vehicle=bare, job=job, bench=None), recordings)
    objective = problem.objective
    progress = beginning(objective, problem.space.initial[None])
    units = units_of(objective.conditions)
    offsets = np.array(progress.points.offsets)
    known = {r.flight.name: r.conditions for r in recordings}
    for column, flight in enumerate(problem.fitted):
        for row, name in enumerate(objective.conditions):
            place = len(OFFSETS) + row
            offsets[0, place, column] = known[flight.name].get(name, 0.0) / units[row]
    progress = replace(progress, points=Point(progress.points.coefficients, np.asarray(offsets)))
    progress = grow(
        objective,
        stages_of(problem, objective)[STAGES if simulator.start is None else slice(None)],
        progress,
        free=Free(np.ones(len(problem.space), bool), np.zeros(offsets.shape[1:], bool)),
        undecided=(),
        on_progress=lambda _: None,
    )
    return problem.space.numbers(progress.best_point.coefficients), progress.converged
