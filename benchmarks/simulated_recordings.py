"""Recordings that a fit's own simulator makes: the flights of a problem, flown at a known truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.air import air
from sim_jax.environment import Disturbance
from sim_jax.numeric import Array as JaxArray
from sim_jax.rollout import rollout
from sim_jax.state import Setpoints
from tuner.core.numerics import Array
from tuner.disturbances.ticks import SETPOINTS
from tuner.objective.normal_equations import Objective
from tuner.objective.residuals import Reading, at_stamps
from tuner.objective.segments import CLOCKS, OFFSETS, Measured
from tuner.objective.simulation import beginning_of, recorded_of
from tuner.recordings.flight import Flight, Series
from tuner.vehicle.model import Model


@dataclass(frozen=True)
class SimulatedFlights:
    """Flights of a problem.

    Attributes
    ----------
    setpoints
        What asked for their body rates (3, samples, F) and thrust.
    """

    objective: Objective
    setpoints: Setpoints

    def with_setpoints(self, flights: Sequence[Flight]) -> list[Flight]:
        """Return flights, in the order of the segments, whose recorded set-points are these."""
        schedule = self.objective.schedule
        every = schedule.log_rate // schedule.position_control_rate
        stamps = np.arange(0, self.objective.samples, every) / schedule.log_rate
        table = np.asarray(
            jnp.concatenate([self.setpoints.rate.stacked(), self.setpoints.thrust[None]])
        )
        again = []
        for number, flight in enumerate(flights):
            rows = table[:, ::every, number].T
            parts = zip(SETPOINTS, (rows[:, :3], rows[:, 3:]), strict=True)
            series = {name: Series(stamps, values) for name, values in parts}
            again.append(replace(flight, series={**flight.series, **series}))
        return again


def simulate_like(
    objective: Objective,
    vector: Array,
    random: np.random.Generator,
    *,
    gusts: bool,
    log_voltage: Array | None = None,
) -> SimulatedFlights | None:
    """Return a problem with recordings of its flights at a truth, stamped and noisy as its own.

    Parameters
    ----------
    objective
        Whole flights: their plan, stamps and noise.
    vector
        (K,) search vector of the truth.
    log_voltage
        (ticks, F) logarithm of the battery's voltage in V, where it is not as the problem has it.

    Returns
    -------
    Flown or None
        None where a flight crashed.
    """
    model = objective.model_at(vector)
    pushing = _air(objective, model, random) if gusts else None
    flown = objective
    if log_voltage is not None:
        segments = replace(objective.segments, log_voltage=jnp.asarray(log_voltage))
        flown = replace(objective, segments=segments)
    channels, crash_time, setpoints = _flown(model, flown, pushing)
    if bool(jnp.isfinite(crash_time).any()):
        return None
    still = np.zeros((len(OFFSETS), objective.segments.count))
    rate, measured = float(objective.schedule.log_rate), {}
    reading = Reading(still, still[: len(CLOCKS)], rate, objective.samples)
    for channel, old in objective.segments.measured.items():
        logged = np.moveaxis(np.asarray(channels[channel]), -1, 0)
        read = at_stamps(logged, channel, np.asarray(old.time).T, reading)
        clean = np.moveaxis(read, 0, -1)
        known = np.asarray(old.weight)
        noise = random.normal(size=known.shape) / np.where(known > 0.0, known, np.inf)
        noisy = _rotate(clean, noise) if channel == "attitude" else clean + noise
        measured[channel] = Measured(old.time, jnp.asarray(noisy), old.weight)
    segments = replace(objective.segments, measured=measured)
    return SimulatedFlights(replace(objective, segments=segments), setpoints)


def _air(objective: Objective, model: Model, random: np.random.Generator) -> Disturbance:
    vehicle = model.vehicle
    rate = float(objective.schedule.physics_rate)
    ticks = int(np.ceil(objective.samples * rate / objective.schedule.log_rate)) + 2
    return air(
        random,
        shape=(ticks, objective.segments.count),
        rate=rate,
        mass=float(vehicle.body.mass),
        places=[[float(x) for x in rotor.position.stacked()] for rotor in vehicle.rotors],
        spins=[rotor.spin for rotor in vehicle.rotors],
        moment_constant=float(vehicle.aerodynamics.moment_constant),
    )


@eqx.filter_jit
def _flown(
    model: Model, objective: Objective, pushing: Disturbance | None
) -> tuple[dict[str, JaxArray], JaxArray, Setpoints]:
    """Return channel -> (samples, columns, F), the times (F,) of crashes, and the set-points."""
    segments = objective.segments
    start, inlet, around = beginning_of(model, segments, objective.schedule)
    flown = rollout(
        model.vehicle,
        model.controller,
        objective.schedule,
        inlet,
        start,
        samples=objective.samples,
        environment=replace(around, disturbance=pushing),
        limits=objective.limits,
    )
    channels = recorded_of(flown.log, model, around, {}, segments.measured)
    return channels, flown.crash_time, flown.log.setpoints


def _rotate(attitude: Array, by: Array) -> Array:
    """Turn attitudes (n, 4, F), w first, by rotation vectors (n, 3, F)."""
    true, noise = (np.moveaxis(part, 1, 2).reshape(-1, part.shape[1]) for part in (attitude, by))
    turned = Rotation.from_quat(true, scalar_first=True) * Rotation.from_rotvec(noise)
    shape = attitude.shape[0], attitude.shape[2], 4
    return np.moveaxis(turned.as_quat(scalar_first=True).reshape(shape), 2, 1)
