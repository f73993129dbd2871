"""With which coefficients a simulator flies most like the vehicle, and a run's flights flown again.

Without the terms that a simulator lacks, the coefficients of its own model are fitted once more
from their physical values, so that they stand in for what is missing as well as they can. Terms
that it has a place for stay as they are, and so do the set-up, the clocks and the air as the run
ended with them. Those for Gazebo are found while a run is under way. Those for other simulators are
found when an export asks for them, and kept in the result folder.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from tuner.config import JobFile, Settings
from tuner.config.job import CoefficientSettings
from tuner.core.errors import ConfigError, InputError
from tuner.core.files import ResultFile
from tuner.core.phrases import listed
from tuner.core.runtime import installed
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.records import AxesRmse
from tuner.exporters.simulators import GAZEBO_CLASSIC, Simulator
from tuner.objective.criterion import Point, units_of
from tuner.result import EffectiveResult, LostTerm, PoseRmse, Run, RunResult
from tuner.search.continuation import run_stages
from tuner.search.estimation import stages_of
from tuner.search.job_flights import (
    Recording,
    read_recordings,
    with_known,
)
from tuner.search.problem import Job, job_of
from tuner.search.progress import Free, Progress, initial_progress
from tuner.vehicle import (
    COEFFICIENTS,
    ControllerFile,
    NotCarried,
    VehicleFile,
    Written,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)

STAGES = slice(-3, None)
"""Of the search: whole flights, then the polish in the weights that what is missing leaves."""
POLISH = -2
"""Of the search: the stage from which it goes on where moments of inertia have to stay."""
MOMENTS = frozenset(name for name, row in COEFFICIENTS.items() if row.place[0] == "inertia")
LEFT = 1e-4
"""Share of the loss that may be left to gain: half as much of how far off the flights are. With a
hundredth a moment constant ends a quarter off: steps in the long valley that a lacking model leaves
gain half of that each."""
LAWS = "other laws"
"""What a simulator lacks that no coefficient says."""
FOLDER = "effective"
"""Of a result folder, for the vehicles that simulators fly."""

Recorded = tuple[Settings, Sequence[Recording]]
"""A run's settings, with the controller as it ended, and its recordings. What the run found of each
flight, clocks and air, is in its result."""


@dataclass(frozen=True)
class Effective:
    """The vehicle that a simulator flies most like a run's, and how it flies."""

    vehicle: VehicleFile
    result: EffectiveResult


def effective_in(
    run: Run,
    simulator: Simulator,
    read: Callable[[Run], Recorded],
    *,
    on_message: Callable[[str], None] = lambda _: None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Effective | None:
    """Return the vehicle with which a simulator flies most like a run's.

    None where the simulator lacks nothing of what acts.

    Parameters
    ----------
    run, simulator
        The physical answer, and who is to fly it.
    read
        Returns the run's recordings; not called where nothing is lacking.
    on_message, on_progress
        Called before the fit, and after every iteration.

    Raises
    ------
    InputError
        As of ``read``.
    """
    lost = lost_terms(run, simulator)
    if not lost:
        return None
    on_message(
        f"{simulator.title} cannot fly {listed(tuple(lost))}: looking for the coefficients with "
        "which it flies most like the vehicle."
    )
    recorded = read(run)
    names = frozenset(name for members in lost.values() for name in members)
    vehicle, converged = fitted_in(run, simulator, recorded, names, on_progress)
    spinning = {r.flight.name for r in recorded[1] if r.flight.spins_freely}

    def flown(flying: VehicleFile, missing: Collection[str]) -> dict[str, AxesRmse]:
        errors = _comparison(run, recorded, missing).fly(flying)
        return {name: flight.rmse for name, flight in errors.items()}

    def over_flights(rmse: Mapping[str, AxesRmse]) -> PoseRmse:
        return pose_rmse(axes for name, axes in rmse.items() if name not in spinning)

    def without(members: tuple[str, ...]) -> PoseRmse:
        lacking = simulator.lacking(run.vehicle, members)
        return over_flights(flown(lacking if members else lawful, members))

    lawful, flights = simulator.laws(run.vehicle), flown(vehicle, names)
    return Effective(
        vehicle,
        EffectiveResult(
            target="gazebo" if simulator is GAZEBO_CLASSIC else simulator.name,
            coefficients=values_of(vehicle),
            lost=tuple(
                LostTerm(group=group, names=members, rmse_without=without(members))
                for group, members in lost.items()
            ),
            carried=carried_terms(simulator, vehicle),
            rmse_physical=over_flights({f.name: f.rmse_best for f in run.result.flights}),
            rmse_unfitted=over_flights(flown(simulator.flown(run.vehicle), names)),
            rmse_effective=over_flights(flights),
            flights=flights,
            converged=converged,
        ),
    )


def lost_terms(run: Run, simulator: Simulator) -> dict[str, tuple[str, ...]]:
    """Return group -> its coefficients that act and that a simulator flies at another value.

    What acted on a flight counts as well. Where nothing was flown there are none.
    """
    if not run.result.flights:
        return {}
    acting = values_of(run.vehicle)
    for flight in run.result.flights:
        for name, value in flight.conditions.items():
            acting[name] = max(acting.get(name, 0.0), abs(value))
    lost = simulator.lost(acting)
    there = simulator.laws(run.vehicle)
    if there.aerodynamics != run.vehicle.aerodynamics or values_of(there) != values_of(run.vehicle):
        lost[LAWS] = ()
    return lost


def carried_terms(simulator: Simulator, vehicle: VehicleFile) -> tuple[str, ...]:
    """Return the terms beyond the motor model that act and that a simulator has a place for."""
    return tuple(
        name
        for name, value in vehicle.effects.items()
        if isinstance(simulator.entry(COEFFICIENTS[name]), Written)
        and value != COEFFICIENTS[name].neutral
    )


def fitted_in(
    run: Run,
    simulator: Simulator,
    recorded: Recorded,
    lost: Collection[str],
    on_progress: Callable[[Progress], None],
) -> tuple[VehicleFile, bool]:
    """Return a simulator's vehicle fitted to a run's flights, and whether the fit converged.

    What was known of its coefficients beforehand is about the vehicle, not about a simulator that
    lacks terms: each is held weakly at its start. Where the moments of inertia end as no rigid
    body's, they stay as they began, and the others go on from where they ended.
    """
    settings, recordings = recorded
    begins = run.vehicle if simulator.start is None else simulator.start(run.vehicle)
    start = simulator.flown(begins)
    free = free_in(run, simulator, start)
    if not free:
        return start, True
    conditions = {n for flight in run.result.flights for n in flight.conditions if n not in lost}
    ties = tuple(t for t in simulator.ties or settings.job.ties if set(t) <= set(free))
    tied = {name for group in ties for name in group[1:]}
    job = JobFile(
        free=tuple(free),
        ties=ties,
        terms=tuple(sorted(conditions)) or "none",
        disturbances="none",
        coefficients=_bounds(run, start, [name for name in free if name not in tied]),
        channels=settings.job.channels,
        weights=settings.job.weights,
        flights=settings.job.flights,
        search=settings.job.search.replace(method="gradient", starts=1),
        holdout=tuple(r.flight.name for r in recordings if r.holdout),
    )
    problem = job_of(replace(settings, vehicle=start, job=job, bench=None), recordings)
    stages = stages_of(problem, problem.objective)
    stages = tuple(
        replace(
            stage,
            name=f"for {simulator.title}, {stage.name}",
            tolerance=max(stage.tolerance, LEFT),
            rough=True,
        )
        for stage in (stages[STAGES] if simulator.start is None else stages)
    )
    space, begun = problem.space, _as_it_ended(run, problem, lost)

    def ended(progress: Progress, moves: NDArray[np.bool_]) -> Progress:
        none = np.zeros(begun.points.offsets.shape[1:], bool)
        return run_stages(
            problem.objective,
            stages,
            progress,
            free=Free(moves, none),
            undecided={},
            on_progress=on_progress,
        )

    def vehicle(progress: Progress) -> VehicleFile:
        values = space.numbers(progress.best_point.coefficients)
        return simulator.flown(with_values(start, values))

    progress = ended(begun, np.ones(len(space), bool))
    with suppress(ConfigError):  # together the moments are no rigid body's
        return vehicle(progress), progress.converged
    moves = np.array([not MOMENTS.intersection(p.ratios) for p in space.parameters])
    at_start = np.where(moves, progress.points.coefficients, space.initial)
    again = replace(
        begun,
        stage=len(stages) + POLISH,
        points=replace(progress.points, coefficients=at_start),
        scales=progress.scales,
        iterations=progress.iterations,
        evaluations=progress.evaluations,
    )
    progress = ended(again, moves)
    return vehicle(progress), progress.converged


def _bounds(run: Run, start: VehicleFile, free: Sequence[str]) -> dict[str, CoefficientSettings]:
    """Return the bounds that a run searched between, where a simulator's vehicle begins inside."""
    values, rows = values_of(start), run.result.coefficients
    return {
        name: CoefficientSettings(lower=lower, upper=upper)
        for name in free
        if name in rows
        if (lower := rows[name].lower) is not None and (upper := rows[name].upper) is not None
        if lower < values[name] < upper
    }


def _as_it_ended(run: Run, problem: Job, lost: Collection[str]) -> Progress:
    """Return where a fit begins, with clocks, air and weights as the run ended with them."""
    objective, begun = (
        problem.objective,
        initial_progress(problem.objective, problem.space.initial[None]),
    )
    offsets: Any = run.result.settings.get("offsets", {})
    weighed: Any = run.result.settings.get("scales", {})
    conditions = {flight.name: flight.conditions for flight in run.result.flights}
    names = [flight.name for flight in problem.fitted]
    known = [{**offsets.get(flight, {}), **conditions[flight]} for flight in names]
    rows = [
        [0.0 if name in lost else of_flight.get(name, 0.0) for of_flight in known]
        for name in objective.of_flight
    ]
    at = np.array(rows) / units_of(objective.of_flight)[:, None]
    scales = {
        channel: np.array([weighed.get(flight, {}).get(channel, 1.0) for flight in names])
        for channel in objective.segments.measured
    }
    return replace(begun, points=Point(begun.points.coefficients, at[None]), scales=scales)


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
    flier
        Flies it in another simulator, as of `tuner.exporters.flier.flier`.

    Raises
    ------
    InputError
        A recording is gone or has changed, or the result folder does not hold what flew.
    """
    if not run.result.flights:  # of ground measurements
        return {}
    comparison = _comparison(run, recordings_of(run))
    flown = comparison.fly(vehicle) if flier is None else comparison.fly(vehicle, flier=flier)
    return {name: errors.rmse for name, errors in flown.items()}


def _comparison(run: Run, recorded: Recorded, missing: Collection[str] = ()) -> Comparison:
    """Return a run's recordings laid out as it ended, without some of what acted on a flight."""
    settings, recordings = recorded
    ended = {flight.name: flight for flight in run.result.flights}
    acted = {
        name: {n: value for n, value in flight.conditions.items() if n not in missing}
        for name, flight in ended.items()
    }
    offsets = {name: f.time_offset for name, f in ended.items()}
    recordings = with_known(recordings, time_offset=offsets, conditions=acted)
    return Comparison(recordings, settings.controller, window=settings.job.search.window)


def recordings_of(run: Run) -> Recorded:
    """Return the settings of a run, and its recordings.

    Raises
    ------
    InputError
        As of `refly`.
    """
    settings = _settings(run)
    wanted = {flight.name: flight for flight in run.result.flights}
    readable, _ = read_recordings(settings, fits=False)
    recordings = tuple(r for r in readable if r.flight.name in wanted)
    if gone := sorted(set(wanted) - {r.flight.name for r in recordings}):
        raise InputError(wanted[gone[0]].path, "is not the recording of the run", "fit it again")
    for flight in (recording.flight for recording in recordings):
        if flight.sha256 != wanted[flight.name].sha256:
            raise InputError(flight.path, "is not the recording of the run", "fit it again")
    late = {name: flight.input_late for name, flight in wanted.items()}
    return settings, with_known(recordings, input_late=late)


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


def kept_effective(run: Run, simulator: Simulator) -> Effective | None:
    """Return what `effective_in` does, from the result folder where it was found before.

    Raises
    ------
    InputError
        As of `refly`.
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
            return (
                None
                if kept.effective is None
                else Effective(read_vehicle(vehicle_file), kept.effective)
            )
    found = effective_in(run, simulator, recordings_of)
    if found is not None:
        write_vehicle(found.vehicle, vehicle_file, header=f"Effective in {simulator.title}.")
    Kept(of=key, effective=None if found is None else found.result).write(run.folder)
    return found
