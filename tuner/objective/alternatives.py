"""The same problem simulated differently, and what its residuals then would be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_jax.inlet import ReferenceInlet
from tuner.objective.battery import log_voltage_of, read_again
from tuner.objective.criterion import Point
from tuner.objective.normal import Objective
from tuner.objective.windows import Window
from tuner.recordings.flight import Flight

STEP = "step"
"""Half the physics step, controllers and log at their own rates."""
READINGS = "readings"
"""The battery's voltmeter read again, a few times."""
LACK = "lack"
"""With what pushes the flights along and is none of the model."""
DRAWS = 6
"""How many times: an error that is told by so many is told to a third."""


def alternatives_of(
    objective: Objective, point: Point, flights: Sequence[Flight] = ()
) -> dict[str, Objective]:
    """Return what might be simulated differently -> the problem so simulated.

    Physics runs in the same steps where a recording is fed in step by step: it is laid out for
    those.

    Parameters
    ----------
    objective, point
        The fit.
    flights
        Those that are flown whole in it, to have their voltmeters read again where the fit has a
        battery; none for a fit in which that is not asked.
    """
    if not isinstance(objective.segments.inlet, ReferenceInlet):
        return {}
    schedule = objective.schedule
    finer = replace(schedule, physics_rate=2 * schedule.physics_rate)
    return {STEP: replace(objective, schedule=finer), **_read_again(objective, point, flights)}


def _read_again(
    objective: Objective, point: Point, flights: Sequence[Flight]
) -> dict[str, Objective]:
    """Return the problem with other readings of the voltmeters, if they matter to a fit."""
    segments = objective.segments
    vehicle = objective.tunable.at(np.asarray(point.coefficients)).vehicle
    matters = bool(float(vehicle.effects.get("battery_exponent", 0.0)))
    if not flights or segments.log_voltage is None or not matters:
        return {}
    windows = [Window(flight, 0.0) for flight in flights]
    as_read = log_voltage_of(flights, windows, objective.schedule)
    assert as_read is not None, "the segments hold what was read"
    random, others = np.random.default_rng(0), {}
    for number in range(DRAWS):
        again = log_voltage_of(read_again(flights, random), windows, objective.schedule)
        assert again is not None, "there is a voltmeter"
        volts = segments.log_voltage + (again - as_read)
        others[f"{READINGS} {number}"] = replace(
            objective, segments=replace(segments, log_voltage=volts)
        )
    return others
