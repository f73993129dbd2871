"""The second answer of a run: with which coefficients Gazebo flies most like the vehicle.

Without the terms that Gazebo lacks, the coefficients of its own model are fitted once more from
their physical values, so that they stand in for what is missing as well as they can. Terms that it
has a place for stay as they are, and so does what belongs to the set-up and not to the simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuner.core.errors import ConfigError
from tuner.core.phrases import listed
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.held_out import comparison_of, controller_flown
from tuner.evaluate.records import AxesRmse
from tuner.evaluate.rmse import FlightErrors
from tuner.exporters.simulators import GAZEBO_CLASSIC
from tuner.objective.criterion import Point
from tuner.objective.segments import OFFSETS
from tuner.objective.space import Space
from tuner.result import EffectiveResult, LostTerm, PoseRmse
from tuner.search.estimation import OnProgress
from tuner.search.fitted import Fitted
from tuner.search.optimiser import Free
from tuner.search.polish import polished
from tuner.search.problem import Job
from tuner.vehicle import (
    COEFFICIENTS,
    VehicleFile,
    Written,
    initial_values,
    values_of,
    with_values,
)
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import model_of

STAGES = 3
"""Of the search: whole flights, then the polish in the weights that what is missing leaves."""


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
    spinning = [flight.name for flight in job.flights if flight.spins_freely]
    comparisons: dict[frozenset[str], Comparison] = {}

    def flown(flying: VehicleFile, missing: Collection[str]) -> dict[str, AxesRmse]:
        conditions = frozenset(missing).intersection(fitted.objective.conditions)
        if conditions not in comparisons:
            still = replace(fitted, point=_without_conditions(fitted, conditions))
            comparisons[conditions] = comparison_of(job, still)
        errors = comparisons[conditions].fly(flying, computed=_effects(names))
        return {name: flight.rmse for name, flight in errors.items()}

    def over_flights(rmse: Mapping[str, AxesRmse]) -> PoseRmse:
        return pose_rmse(axes for name, axes in rmse.items() if name not in spinning)

    flights = flown(effective, names)
    result = EffectiveResult(
        target="gazebo",
        coefficients=values_of(effective),
        lost=tuple(
            LostTerm(
                group=group,
                names=members,
                rmse_without=over_flights(flown(GAZEBO_CLASSIC.lacking(vehicle, members), members)),
            )
            for group, members in lost.items()
        ),
        carried=carried_terms(effective),
        rmse_physical=over_flights({name: errors.rmse for name, errors in physical.items()}),
        rmse_unfitted=over_flights(flown(bare, names)),
        rmse_effective=over_flights(flights),
        flights=flights,
        converged=end.converged,
    )
    return Effective(effective, result)


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
    parameters = tuple(
        _about(parameter, values[parameter.name])
        for parameter in fitted.objective.space.parameters
        if not set(lost).intersection(parameter.ratios)
    )
    space = Space(parameters, {}, size=fitted.objective.space.size)
    model = replace(
        model_of(bare, controller_flown(job, fitted)),
        reference_voltage=fitted.objective.model.reference_voltage,
    )
    start = replace(
        fitted,
        objective=replace(fitted.objective, model=model, space=space),
        point=Point(np.asarray(space.initial), _without_conditions(fitted, lost).offsets),
    )
    movable = np.array([_moves(p) and p.name not in fitted.held for p in parameters], bool)
    end = _polished(job, start, movable, on_progress)
    try:
        return end, _vehicle_at(bare, end, movable)
    except ConfigError:  # together the moments are no rigid body's
        movable &= np.array([COEFFICIENTS[p.name].place[0] != "inertia" for p in parameters], bool)
        end = _polished(job, start, movable, on_progress)
        return end, _vehicle_at(bare, end, movable)


def _polished(
    job: Job, start: Fitted, movable: NDArray[np.bool_], on_progress: OnProgress
) -> Fitted:
    if not movable.any():
        return start
    return polished(
        job,
        start,
        free=Free(movable, np.zeros(start.point.offsets.shape, bool)),
        title="for Gazebo",
        on_progress=lambda progress: on_progress(job, progress),
        stages=STAGES,
    )


def _moves(parameter: Parameter) -> bool:
    row = COEFFICIENTS[parameter.name]
    return row.scope == "vehicle" and not row.is_effect


def _vehicle_at(bare: VehicleFile, end: Fitted, movable: NDArray[np.bool_]) -> VehicleFile:
    space = end.objective.space
    moved = {
        name
        for parameter, moves in zip(space.parameters, movable, strict=True)
        if moves
        for name in parameter.ratios
    }
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


def _effects(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name in COEFFICIENTS and COEFFICIENTS[name].is_effect)


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
