"""Effective coefficients of a simulator that lacks terms, and flights of a run simulated again.

The coefficients of the simulator's own model are refitted without those terms, from their physical
values, to compensate for them. Other terms, the set-up, and the run's clocks and conditions stay.
Effective coefficients for Gazebo are part of a run. Those for other simulators are found by an
export, and cached in the result folder.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from tuner.config import CoefficientSettings, JobFile, Settings
from tuner.core.errors import ConfigError, InputError
from tuner.core.files import ResultFile
from tuner.core.numerics import Array
from tuner.core.phrases import listed
from tuner.core.runtime import installed
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.records import AxesRmse
from tuner.exporters.simulators import GAZEBO_CLASSIC, Simulator
from tuner.objective.criterion import Point, units_of
from tuner.objective.space import Space
from tuner.result import EFFECTIVE, EffectiveResult, LostTerm, PoseRmse, Run, RunResult
from tuner.search.estimation import BOTH_POLISHES, polished
from tuner.search.job_flights import (
    JobFlight,
    read_recordings,
    with_known,
)
from tuner.search.problem import Job, job_of
from tuner.search.progress import Fit, Progress, plain_criterion
from tuner.vehicle import (
    COEFFICIENTS,
    REGISTRY,
    Coefficient,
    ControllerFile,
    ExportTag,
    NoExportTag,
    VehicleFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)

ALL_STAGES, LAST_STAGES = slice(None), slice(-3, None)
"""Stages of the fit: the last are whole flights, then polishes with weights for missing terms."""
MOMENTS = frozenset(name for name, row in COEFFICIENTS.items() if row.place[0] == "inertia")
BOUND_TOLERANCE = 1e-4
"""Share of the distance between bounds within which a coefficient is on one."""
MIN_TOLERANCE = 1e-4
"""Relative reduction of the loss at which a stage ends. With a hundredth a moment constant ends a
quarter off: a model without a term has a long valley, in which each step gains half of that."""
OTHER_LAWS = "other laws"
"""The group of differences that have no coefficient."""

RunInputs = tuple[Settings, Sequence[JobFlight]]
"""A run's settings, with the fitted controller, and its recordings. Clocks and conditions of each
flight are in its result."""


@dataclass(frozen=True)
class Effective:
    """A simulator's vehicle with effective coefficients, and its errors."""

    vehicle: VehicleFile
    result: EffectiveResult


def find_effective(
    run: Run,
    simulator: Simulator,
    read: Callable[[Run], RunInputs],
    *,
    on_message: Callable[[str], None] = lambda _: None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Effective | None:
    """Return a simulator's vehicle with effective coefficients; None if it lacks no acting term.

    Parameters
    ----------
    run, simulator
        The physical result, and the simulator.
    read
        Returns the run's recordings; only called if a term is missing.
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
    vehicle, converged = fit_effective(run, simulator, recorded, names, on_progress)
    spinning = {r.flight.name for r in recorded[1] if r.flight.spins_freely}

    conditions = {name for flight in run.result.flights for name in flight.conditions}

    @cache
    def comparison(missing: frozenset[str]) -> Comparison:
        return _comparison(run, recorded, missing)

    def flown(flying: VehicleFile, missing: Collection[str]) -> dict[str, AxesRmse]:
        errors = comparison(frozenset(conditions.intersection(missing))).fly(flying)
        return {name: flight.rmse for name, flight in errors.items()}

    def over_flights(rmse: Mapping[str, AxesRmse]) -> PoseRmse:
        return pose_rmse(axes for name, axes in rmse.items() if name not in spinning)

    def without(members: tuple[str, ...]) -> PoseRmse:
        lacking = simulator.with_built_in(run.vehicle, members)
        return over_flights(flown(lacking if members else lawful, members))

    lawful, flights = simulator.lawful(run.vehicle), flown(vehicle, names)
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
    """Return group -> its acting coefficients that have another value in a simulator.

    Conditions of flights count as well. A run without flights has none.
    """
    if not run.result.flights:
        return {}
    acting = values_of(run.vehicle)
    for flight in run.result.flights:
        for name, value in flight.conditions.items():
            acting[name] = max(acting.get(name, 0.0), abs(value))
    lost = simulator.lost(acting)
    there = simulator.lawful(run.vehicle)
    if there.aerodynamics != run.vehicle.aerodynamics or values_of(there) != values_of(run.vehicle):
        lost[OTHER_LAWS] = ()
    return lost


def carried_terms(simulator: Simulator, vehicle: VehicleFile) -> tuple[str, ...]:
    """Return the acting terms beyond the motor model that a simulator has."""
    return tuple(
        name
        for name, value in vehicle.effects.items()
        if isinstance(simulator.entry(COEFFICIENTS[name]), ExportTag)
        and value != COEFFICIENTS[name].neutral
    )


def fit_effective(
    run: Run,
    simulator: Simulator,
    recorded: RunInputs,
    lost: Collection[str],
    on_progress: Callable[[Progress], None],
) -> tuple[VehicleFile, bool]:
    """Return a simulator's vehicle fitted to a run's flights, and whether the fit converged.

    Prior knowledge is about the vehicle, not about a simulator without some terms: each coefficient
    has a weak prior at its start. Those that end on a bound are fixed at their start, as are the
    moments of inertia if they end as impossible, and the others are fitted again.
    """
    settings, recordings = recorded
    begins = run.vehicle if simulator.start is None else simulator.start(run.vehicle)
    start = simulator.flown(begins)
    free = free_coefficients(run, simulator, start)
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
    space, begun = problem.space, _start_of_fit(run, problem, lost)
    fit = partial(
        polished,
        problem,
        title=f"for {simulator.title}",
        on_progress=on_progress,
        left=MIN_TOLERANCE,
    )

    def vehicle(fitted: Fit) -> VehicleFile:
        values = space.numbers(fitted.point.coefficients)
        return simulator.flown(with_values(start, values))

    moves, fixed = np.ones(len(space), bool), np.zeros(begun.point.offsets.shape, bool)
    stages = LAST_STAGES if simulator.start is None else ALL_STAGES
    fitted = fit(begun, free=Point(moves, fixed), stages=stages)
    while True:
        held = moves & _on_bounds(space, fitted.point.coefficients)
        if not held.any():
            with suppress(ConfigError):  # together the moments are no rigid body's
                return vehicle(fitted), fitted.converged
            held = np.array([not MOMENTS.isdisjoint(p.ratios) for p in space.parameters])
        moves = moves & ~held
        if not moves.any():
            return start, fitted.converged
        at_start = np.where(moves, fitted.point.coefficients, space.initial)
        begun = replace(begun, point=Point(at_start, fitted.point.offsets), scales=fitted.scales)
        fitted = fit(begun, free=Point(moves, fixed), stages=BOTH_POLISHES)


def _on_bounds(space: Space, vector: Array) -> NDArray[np.bool_]:
    """Return whether each parameter is on a bound at a search vector, shape (K,)."""
    rows = zip(space.parameters, space.at(vector), strict=True)
    return np.array([bound_at(p.initial, at, p.lower, p.upper) is not None for p, at in rows])


def bound_at(initial: float, value: float, lower: float | None, upper: float | None) -> str | None:
    """Return the bound, ``lower`` or ``upper``, on which a coefficient ends; None without.

    None, too, where it began there: a set-up without a delay has a latency of zero.
    """
    span = upper - lower if lower is not None and upper is not None else None
    for side, bound in (("lower", lower), ("upper", upper)):
        near = BOUND_TOLERANCE * (abs(bound or 0.0) if span is None else span)
        if bound and abs(value - bound) <= near < abs(initial - bound):
            return side
    return None


def _bounds(run: Run, start: VehicleFile, free: Sequence[str]) -> dict[str, CoefficientSettings]:
    """Return the run's bounds of those coefficients whose start is inside."""
    values, rows = values_of(start), run.result.coefficients
    return {
        name: CoefficientSettings(lower=lower, upper=upper)
        for name in free
        if name in rows
        if (lower := rows[name].lower) is not None and (upper := rows[name].upper) is not None
        if lower < values[name] < upper
    }


def _start_of_fit(run: Run, problem: Job, lost: Collection[str]) -> Fit:
    """Return where a fit begins, with clocks, air and weights as the run ended with them."""
    objective = problem.objective
    offsets: Any = run.result.settings.get("offsets", {})
    weighed: Any = run.result.settings.get("scales", {})
    conditions = {flight.name: flight.conditions for flight in run.result.flights}
    names = [flight.name for flight in problem.fitted]
    known = [{**offsets.get(flight, {}), **conditions[flight]} for flight in names]
    rows = [
        [0.0 if name in lost else of_flight.get(name, 0.0) for of_flight in known]
        for name in objective.of_flight
    ]
    return Fit(
        objective=objective,
        point=Point(problem.space.initial, np.array(rows) / units_of(objective.of_flight)[:, None]),
        criterion=plain_criterion(objective, objective.samples),
        noise=problem.noise,
        scales={
            flight: {c: weighed.get(flight, {}).get(c, 1.0) for c in objective.segments.measured}
            for flight in names
        },
        iterations=(),
        outcomes=(),
        method="gradient",
        evaluations=0,
        wall_time=0.0,
        loss_best=np.inf,
        converged=False,
    )


def free_coefficients(run: Run, simulator: Simulator, bare: VehicleFile) -> list[str]:
    """Return the coefficients to fit: those of the run that the simulator has, and its own."""
    values = values_of(bare)
    names = []
    for name, row in COEFFICIENTS.items():
        found = run.result.coefficients.get(name)
        fitted = found is not None and found.fitted and found.verdict != "held"
        has = name not in simulator.fixed and not isinstance(simulator.entry(row), NoExportTag)
        moves = name in simulator.free or (fitted and has and not row.is_effect)
        if moves and row.scope == "vehicle" and values.get(name, 0.0) != 0.0:
            names.append(name)
    return names


def pose_rmse(flights: Iterable[AxesRmse]) -> PoseRmse:
    """Return the root mean square of RMSEs over flights; None with a crash.

    That of attitude is over the flights that have no attitude as input.
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
    """Return flight name -> RMSE of a run's recordings, simulated with a vehicle.

    Parameters
    ----------
    run
        The run, with recordings, controller and each flight's clock offset.
    flier
        Flies it in another simulator, as of `tuner.exporters.external_simulator.flier_of`.

    Raises
    ------
    InputError
        A recording is missing or has changed, or the result folder lacks its settings.
    """
    if not run.result.flights:  # of ground measurements
        return {}
    comparison = _comparison(run, recordings_of(run))
    flown = comparison.fly(vehicle) if flier is None else comparison.fly(vehicle, flier=flier)
    return {name: errors.rmse for name, errors in flown.items()}


def _comparison(run: Run, recorded: RunInputs, missing: Collection[str] = ()) -> Comparison:
    """Return the comparison of a run's recordings, without some conditions."""
    settings, recordings = recorded
    ended = {flight.name: flight for flight in run.result.flights}
    acted = {
        name: {n: value for n, value in flight.conditions.items() if n not in missing}
        for name, flight in ended.items()
    }
    offsets = {name: f.time_offset for name, f in ended.items()}
    recordings = with_known(recordings, time_offset=offsets, conditions=acted)
    return Comparison(recordings, settings.controller, window=settings.job.search.window)


def recordings_of(run: Run) -> RunInputs:
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
    read = {r.flight.name: r.flight.sha256 for r in recordings}
    for name, flight in wanted.items():
        if read.get(name) != flight.sha256:
            raise InputError(flight.path, "is not the recording of the run", "fit it again")
    late = {name: flight.input_late for name, flight in wanted.items()}
    return settings, with_known(recordings, input_late=late)


def _settings(run: Run) -> Settings:
    """Return the run's settings of reading its recordings.

    Inlets, and commands from a commanded wrench, follow from the initial vehicle.
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
    """A simulator's effective coefficients, cached in the result folder.

    Attributes
    ----------
    of
        Hash of the run's vehicle and this program's version.
    effective
        Their result; None if the simulator lacks no term.
    """

    of: str
    effective: EffectiveResult | None


def cached_effective(run: Run, simulator: Simulator) -> Effective | None:
    """Return the result of `find_effective`, cached in the result folder.

    Raises
    ------
    InputError
        As of `refly`.
    OutputError
        It cannot be cached.
    """
    vehicle_file = run.folder / EFFECTIVE / f"{simulator.name}.yaml"

    class Kept(EffectiveFile):
        FILE = f"{EFFECTIVE}/{simulator.name}.json"

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
    found = find_effective(run, simulator, recordings_of)
    if found is not None:
        write_vehicle(found.vehicle, vehicle_file, header=f"Effective in {simulator.title}.")
    Kept(of=key, effective=None if found is None else found.result).write(run.folder)
    return found


MARK = "effective coefficients, not physical ones"
"""The mark of an export whose numbers make up for what its simulator lacks."""


def exported_numbers(effective: EffectiveResult, simulator: str) -> str:
    """Return a clause on the effective coefficients of an export."""
    lost = listed([term.group for term in effective.lost])
    return (
        f"{MARK}: {simulator} lacks {lost}, and misses the "
        f"flights by {effective.rmse_effective.words} where all terms miss them by "
        f"{effective.rmse_physical.words}"
    )


def lost_groups(
    effective: EffectiveResult,
    entry: Callable[[Coefficient], ExportTag | NoExportTag | None],
    deviations: Sequence[str],
) -> tuple[str, ...]:
    """Return a clause on each missing group: the reason, and the RMSE without it.

    ``deviations`` are the simulator's differences that have no coefficient.
    """
    clauses = []
    for term in effective.lost:
        rmse = term.rmse_without.words
        if not term.names:
            clauses.append(
                f"the simulator computes otherwise: {'; '.join(deviations)}; that alone misses the "
                f"flights by {rmse}"
            )
        elif isinstance(held := entry(REGISTRY[term.names[0]]), NoExportTag):
            clauses.append(
                f"{term.group} is not exported: {held.reason}; without it alone the flights are "
                f"missed by {rmse}"
            )
    return tuple(clauses)
