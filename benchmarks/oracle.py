"""Errors of an oracle that knows the truth and the law of the disturbances, and flies these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.air import air
from sim_jax.environment import Disturbance
from sim_jax.numeric import Array as JaxArray
from sim_jax.rollout import rollout
from tuner.core.numerics import Array, Inverse
from tuner.objective.information import information_at
from tuner.objective.normal_equations import Objective
from tuner.objective.residuals import Reading, at_stamps
from tuner.objective.segments import CLOCKS, OFFSETS, MeasuredChannel
from tuner.objective.simulation import beginning_of, recorded_of
from tuner.search.progress import Fit
from tuner.vehicle.model import Model

DRAWS = 8
"""Of noise and gusts: their spread is then known to a quarter."""


def oracle_error(
    fitted: Fit,
    truth: Array,
    *,
    gusts: bool,
    random: np.random.Generator,
    log_voltage: Callable[[np.random.Generator], Array | None] = lambda _: None,
) -> dict[str, float]:
    """Return parameter -> standard error of a fit's estimate, in the scaled coordinate.

    The flights are flown again at the truth, each time in other noise and other gusts, and one
    linear step in the fit's weights leads from the truth to what would have been estimated. What is
    held is known.

    Parameters
    ----------
    truth
        (K,) its search vector.
    log_voltage
        What the voltage (ticks, F) may have been that the fit takes for what it read, by chance;
        None where it knows.
    """
    names = fitted.objective.space.names
    held = set(fitted.held.values())
    free = np.flatnonzero([name not in held for name in names])
    moved = np.asarray(fitted.point.offsets) != 0.0
    still = jnp.zeros_like(fitted.criterion.reference_offset)
    criterion = replace(fitted.criterion, reference_offset=still)
    steps: list[Array] = []
    while len(steps) < DRAWS:
        volts = log_voltage(random)
        flown = simulate_like(fitted.objective, truth, random, gusts=gusts, log_voltage=volts)
        if flown is None:
            continue
        at_truth = flown.start(truth)
        information = information_at(flown, at_truth, criterion, offsets_fitted=moved).about(free)
        score = information.score.sum(axis=(0, 1, 2))
        steps.append(Inverse.of(information.total, information.given).matrix @ score)
    errors = np.sqrt(np.mean(np.square(steps), axis=0))
    return {names[index]: float(error) for index, error in zip(free, errors, strict=True)}


def simulate_like(
    objective: Objective,
    vector: Array,
    random: np.random.Generator,
    *,
    gusts: bool,
    log_voltage: Array | None = None,
) -> Objective | None:
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
    Objective or None
        None where a flight crashed.
    """
    model = objective.model_at(vector)
    pushing = _air(objective, model, random if gusts else np.random.default_rng(0))
    if not gusts:  # one program flies both
        pushing = jax.tree.map(jnp.zeros_like, pushing)
    flown = objective
    if log_voltage is not None:
        segments = replace(objective.segments, log_voltage=jnp.asarray(log_voltage))
        flown = replace(objective, segments=segments)
    channels, crash_time = _flown(model, flown, pushing)
    if bool(jnp.isfinite(crash_time).any()):
        return None
    still = np.zeros((len(OFFSETS), objective.segments.count))
    rate, measured = float(objective.schedule.log_rate), {}
    reading = Reading(still, still[: len(CLOCKS)], rate, objective.samples)
    for channel, old in objective.segments.measured.items():
        logged = np.moveaxis(np.asarray(channels[channel]), -1, 0)
        read = at_stamps(logged, channel, np.asarray(old.time).T, reading)
        clean = np.moveaxis(read, 0, -1)
        weight = np.asarray(old.weight)
        noise = random.normal(size=weight.shape) / np.where(weight > 0.0, weight, np.inf)
        noisy = _rotate(clean, noise) if channel == "attitude" else clean + noise
        measured[channel] = MeasuredChannel(old.time, jnp.asarray(noisy), old.weight)
    segments = replace(objective.segments, measured=measured)
    return replace(objective, segments=segments)


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
) -> tuple[dict[str, JaxArray], JaxArray]:
    """Return channel -> (samples, columns, F) and the times (F,) of crashes."""
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
    return channels, flown.crash_time


def _rotate(attitude: Array, by: Array) -> Array:
    """Turn attitudes (n, 4, F), w first, by rotation vectors (n, 3, F)."""
    true, noise = (np.moveaxis(part, 1, 2).reshape(-1, part.shape[1]) for part in (attitude, by))
    turned = Rotation.from_quat(true, scalar_first=True) * Rotation.from_rotvec(noise)
    shape = attitude.shape[0], attitude.shape[2], 4
    return np.moveaxis(turned.as_quat(scalar_first=True).reshape(shape), 2, 1)
