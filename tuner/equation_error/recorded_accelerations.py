"""Recorded accelerations of a flight, step by step, with motion and rotor speeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.rigid_body import Motion
from tuner.config import InletName
from tuner.core.numerics import Array, finite_rows
from tuner.objective.inlets import (
    MAX_PERIODS,
    at_ticks,
    linear_interpolation,
    mean_of_hold,
)
from tuner.objective.rotor_response import MotorLags, linearised_speeds
from tuner.recordings.flight import Flight, Series
from tuner.recordings.states import local_parabolas, states_at
from tuner.vehicle.model import Model, with_coefficients

Mask = NDArray[np.bool_]

MAX_RATE_HZ = 100.0
"""Largest rate of steps: gyro and tachometers are averaged over a step, which removes noise and
aliased vibrations. A step is shorter than a rotor's lag, so that the loop responds after it."""
MAX_GAP_PERIODS = 2.5
"""Largest gap of a known signal, in periods."""
MIN_SAMPLES = 100
"""Least number of known steps of a flight."""

Commands = tuple[Series, ...]
"""Commands of each flight."""


@dataclass(frozen=True)
class Steps:
    """N steps of one flight, or of several behind each other.

    Attributes
    ----------
    step
        s.
    time
        (N,) s since the flight's start, at mid-step.
    motion
        At mid-step, leaves (N,); of the rotors' speed the mean over the step.
    rotor_speed, rotor_acceleration
        (N, 4) rad/s and rad/s².
    accelerations
        (N, 6) specific force in m/s² and angular acceleration in rad/s², body axes, over the step;
        NaN where something was not recorded. With an averaged gyro, the change of means about a
        step's ends, each as long as a step.
    weights
        (2, m) of a rotor's samples about mid-step, in its mean and, in 1/s, in its acceleration.
    samples_per_step
        Rotor samples per step.
    """

    step: float
    time: Array
    motion: Motion
    rotor_speed: Array
    rotor_acceleration: Array
    accelerations: Array
    weights: Array
    samples_per_step: int

    @property
    def known(self) -> Mask:
        """Whether all of each step (N,) was recorded."""
        return finite_rows(self.accelerations)


def steps_of(flight: Flight, *, input_late: float = 0.0, averaged: bool = False) -> Steps | None:
    """Return the steps of a flight with rotor speeds; None where too little was recorded.

    Parameters
    ----------
    flight
        A flight with a pose.
    input_late
        s by which rotor speeds are stamped later than the state.
    averaged
        Whether to average a gyro with several samples a step, and tachometers likewise.
    """
    rotors = flight.series.get("rotor_speed")
    if rotors is None:
        return None
    known = finite_rows(rotors.values)
    if known.sum() < MIN_SAMPLES:
        return None
    rotors = Series(rotors.time[known] - input_late, rotors.values[known])
    return steps_with(flight, rotors, averaged=averaged)


def steps_with(flight: Flight, rotors: Series, *, averaged: bool = False) -> Steps | None:
    """Return the same with rotor speeds on the clock of the state."""
    series = flight.series
    if not {"position", "attitude", "body_rate"} <= set(series):
        return None
    gyro = series["body_rate"]
    if not np.isfinite(gyro.values).all():
        return None
    rate = min(MAX_RATE_HZ, gyro.rate, rotors.rate)
    samples_per_step, readings = (max(1, round(series.rate / rate)) for series in (rotors, gyro))
    averaged = averaged and readings > 1
    begin = max(0.0, gyro.time[0], rotors.time[0])
    end = min(flight.duration, gyro.time[-1], rotors.time[-1])
    count = int((end - begin) * rate)
    if count < MIN_SAMPLES:
        return None
    edges = begin + np.arange(count + 1) / rate
    middle = 0.5 * (edges[1:] + edges[:-1])
    weights = np.stack([_mean_weights(samples_per_step), np.zeros(samples_per_step + 1)])
    weights[1, [0, -1]] = -rate, rate
    about = _mean_weights(readings) if averaged else np.ones(1)
    if averaged:
        weights = np.stack([np.convolve(row, _mean_weights(samples_per_step)) for row in weights])
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import, seldom needed)

    state, velocity = states_at(series, middle), _velocity(series, edges)
    turned = Rotation.from_quat(state.attitude, scalar_first=True)
    pull = np.diff(velocity, axis=0) * rate + np.array([0.0, 0.0, GRAVITY])
    rates = _weighed(gyro, edges, about[None], 1.0 / (rate * readings))[0]
    turning = np.diff(rates, axis=0) * rate
    accelerations = np.hstack([turned.inv().apply(pull), turning])
    accelerations[~finite_rows(state.body_rate)] = np.nan
    part = Steps(
        step=1.0 / rate,
        time=middle,
        motion=Motion(
            Vec3.of(state.position.T),
            Vec3.of(state.velocity.T),
            Quaternion.of(state.attitude.T),
            Vec3.of(np.nan_to_num(state.body_rate).T),
        ),
        rotor_speed=np.zeros((count, 4)),
        rotor_acceleration=np.zeros((count, 4)),
        accelerations=accelerations,
        weights=weights,
        samples_per_step=samples_per_step,
    )
    part = with_rotors(part, rotors)
    return part if np.count_nonzero(part.known) >= MIN_SAMPLES else None


def weighed_rotors(part: Steps, rotors: Series) -> Array:
    """Return a signal of the rotors (2, N, k) in the mean of each step and, per s, its change."""
    return _weighed(rotors, part.time, part.weights, part.step / part.samples_per_step)


def with_rotors(part: Steps, rotors: Series) -> Steps:
    """Return the steps with other rotor speeds; where these are unknown, so is the step."""
    mean, change = weighed_rotors(part, rotors)
    there = np.isfinite(mean)
    known, usual = there.all(axis=1, keepdims=True), np.nanmean(mean) if there.any() else 0.0
    return replace(
        part,
        # a usual speed where it is unknown: derivatives at zero are not finite
        rotor_speed=np.where(there, mean, usual),
        rotor_acceleration=np.nan_to_num(change),
        accelerations=np.where(known, part.accelerations, np.nan),
    )


def without_gaps_of(series: Series, part: Steps) -> Steps:
    """Return the steps with those in a signal's gaps unknown."""
    known = np.isfinite(_read(series, part.time)).all(axis=1, keepdims=True)
    return replace(part, accelerations=np.where(known, part.accelerations, np.nan))


def read_commands(
    model: Model, flights: Sequence[tuple[Flight, float]], rate: float
) -> tuple[tuple[Steps, ...], tuple[Commands, Commands]] | None:
    """Return the steps of some flights; their commands, and the same of every second sample.

    None where too little was recorded of a flight.

    Parameters
    ----------
    model
        Gives the motors.
    flights
        Each with the s by which its commands are stamped late.
    rate
        Hz of the loop that computes commands.
    """
    steps, commands, coarser = list[Steps](), list[Series](), list[Series]()
    for flight, late in flights:
        command = flight.series["command"]
        recorded = Series(command.time - late, command.values)
        every, second = (_held(flight, recorded, rate, count) for count in (1, 2))
        response, _ = rotor_response(model, every)
        part = steps_with(flight, response)
        part = None if part is None else without_gaps_of(recorded, part)
        if part is None or np.count_nonzero(part.known) < MIN_SAMPLES:
            return None
        steps.append(part)
        commands.append(every)
        coarser.append(second)
    return tuple(steps), (tuple(commands), tuple(coarser))


def steps_by_inlet(
    inlet: InletName,
    model: Model,
    flights: Sequence[tuple[Flight, float]],
    rate: float,
    *,
    averaged: bool = False,
) -> tuple[tuple[Steps, ...], tuple[Commands, ...]] | None:
    """Return the steps of flights with an inlet, and their commands as of `read_commands`.

    None where neither rotor speeds nor commands are fed in, or too little was recorded. Parameters
    are those of `read_commands` and `steps_of`.
    """
    if inlet == "rotor_speed":
        parts = [steps_of(flight, input_late=late, averaged=averaged) for flight, late in flights]
        known = tuple(part for part in parts if part is not None)
        return (known, ()) if len(known) == len(parts) else None
    return read_commands(model, flights, rate) if inlet == "actuator" else None


def rotor_response(
    model: Model, command: Series, slopes: Model | None = None
) -> tuple[Series, Series]:
    """Return the rotor speeds (n, 4) in response to commands on a clock, and their derivatives.

    These (n, 4·Q) are along Q directions; ``slopes`` hold the change (Q,) of each number of the
    motors. Along one that changes nothing by default.
    """
    motor, late = model.vehicle.motor, float(model.vehicle.setup.actuator_latency)
    lags = MotorLags(float(motor.time_constant_up), float(motor.time_constant_down), late)
    step = float(command.time[1] - command.time[0])
    moved = directions(model, {}, 1) if slopes is None else slopes
    speeds, columns = linearised_speeds(
        command.values,
        step,
        motor,
        lags,
        slopes=moved.vehicle.motor,
        delays=np.asarray(moved.vehicle.setup.actuator_latency),
    )
    return Series(command.time, speeds), Series(command.time, columns.reshape(len(columns), -1))


def directions(model: Model, slopes: Mapping[str, Array], count: int) -> Model:
    """Return the change (count,) of each number of a model along directions of coefficients."""
    return with_coefficients(jax.tree.map(lambda _: np.zeros(count), model), slopes)


def _held(flight: Flight, recorded: Series, rate: float, every: int) -> Series:
    """Return a flight's commands, one of ``every``, on the loop's clock or their own if faster.

    Each is the mean until the next.
    """
    taken, held_at = Series(recorded.time[::every], recorded.values[::every]), rate
    rate = max(rate, recorded.rate)
    edges = np.arange(int(flight.duration * rate) + 1) / rate
    if taken.rate * MAX_PERIODS > held_at:
        return Series(edges[:-1], mean_of_hold(at_ticks(taken, held_at), edges))
    return Series(edges[:-1], linear_interpolation(taken, edges[:-1] + 0.5 / rate))


def rows_of(vector: Vec3) -> Array:
    """Return a vector's components on the host (N, 3)."""
    return np.stack([np.asarray(vector.x), np.asarray(vector.y), np.asarray(vector.z)], axis=1)


def _mean_weights(count: int) -> Array:
    """Return the weights (count + 1,) of samples in the mean over a step of ``count`` periods."""
    weights = np.ones(count + 1) / count
    weights[[0, -1]] *= 0.5
    return weights


def _weighed(series: Series, times: Array, weights: Array, spacing: float) -> Array:
    """Return weighted sums (r, n, k) of a signal about some times; NaN in gaps.

    Samples are ``spacing`` s apart; ``weights`` are (r, m).
    """
    size = weights.shape[1]
    fine = times[:, None] + (np.arange(size) - 0.5 * (size - 1)) * spacing
    values = _read(series, fine.ravel()).reshape(*fine.shape, -1)
    return np.asarray(np.einsum("nik,ri->rnk", values, weights))


def _read(series: Series, times: Array) -> Array:
    """Return a signal (n, k) between its samples; NaN in gaps."""
    after = np.clip(np.searchsorted(series.time, times), 1, len(series.time) - 1)
    before, gap = series.time[after - 1], series.time[after] - series.time[after - 1]
    share = np.clip((times - before) / gap, 0.0, 1.0)[:, None]
    table = (1.0 - share) * series.values[after - 1] + share * series.values[after]
    table[gap > MAX_GAP_PERIODS / series.rate] = np.nan
    return np.asarray(table)


def _velocity(series: Mapping[str, Series], edges: Array) -> Array:
    """Return the velocity (n, 3) m/s at some times, world."""
    if "velocity" in series and np.isfinite(series["velocity"].values).all():
        return local_parabolas(series["velocity"], edges)
    return local_parabolas(series["position"], edges, derivative=1)
