"""Lag of recorded rotor speeds or commands behind the accelerations that they cause.

The loop responds to a disturbance with the rotors: their speeds correlate with the turning that
they oppose, later. In spectra that looks like a lag, the larger the slower. So a lag found from
spectra is accepted only if the innovations of the same regression confirm it: the part of each
acceleration that earlier ones do not predict, which holds no response
(`tuner.equation_error.regression`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from tuner.core.numerics import Array
from tuner.equation_error.recorded_accelerations import Mask, steps_with, with_rotors
from tuner.equation_error.regression import convolved, whitening_filter
from tuner.objective.inlets import INLETS, linear_interpolation
from tuner.recordings.flight import Flight, Series
from tuner.recordings.states import states_at
from tuner.search.inlet_choice import regressors
from tuner.search.job_flights import Recording
from tuner.vehicle import VehicleFile

BAND_HZ = (0.7, 8.0)
"""Frequencies at which accelerations are compared."""
MEMORY_S = 0.1
"""Errors from which the next one is predicted."""
LAGS_S = np.arange(-24, 25) * 0.0025
"""Lags that are tried: five samples at 100 Hz, and as much again for a rotor's lag."""
MAX_LAG_SD_S = 0.003
"""Largest standard deviation of a lag that is used."""
SIGNIFICANT_SD = 2.81
"""Standard deviations from zero of a significant lag: one flight of 200 has that by chance."""
TRIMMED_SAMPLES = 10
"""Samples at either end of a flight that are left out: their derivatives are worse."""
WHITENING_ROUNDS = 3
"""Rounds of regression and whitening filter (Cochrane and Orcutt)."""
CORRELATED_FREQUENCIES = 3.0
"""Mean number of correlated neighbouring frequencies, by the taper and the filter."""

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class Lag:
    """A lag and its standard deviation, in s."""

    seconds: float
    sd: float


def with_input_lags(recordings: Sequence[Recording], vehicle: VehicleFile) -> tuple[Recording, ...]:
    """Return recordings with the lags of their inputs, where they can be estimated.

    Rotor speeds have the lag itself, if it is significant and no response of the loop. Commands
    have their flight's lag less the flights' mean, which is the vehicle's own. Flights without an
    estimate, and held-out ones, have the mean of the others.
    """
    late: dict[str, float] = {}
    for inlet in {recording.inlet for recording in recordings}:
        same = [recording for recording in recordings if recording.inlet == inlet]
        if not INLETS[inlet].starts_recorded:
            continue
        signal, is_measured = INLETS[inlet].needs[0], "actuator_latency" in INLETS[inlet].bypasses
        lags = [
            (recording.flight, lag)
            for recording in same
            if not recording.holdout
            and recording.time_offset is None
            and (lag := input_lag(recording.flight, signal, vehicle)) is not None
        ]
        if not lags:
            continue
        accepted = {
            flight.name: lag.seconds if not is_measured or _is_late(flight, vehicle, lag) else 0.0
            for flight, lag in lags
        }
        mean = float(np.mean(list(accepted.values())))
        own = 0.0 if is_measured else mean
        late |= {r.flight.name: accepted.get(r.flight.name, mean) - own for r in same}
    return tuple(
        replace(r, input_late=late.get(r.flight.name, r.input_late)) if r.time_offset is None else r
        for r in recordings
    )


def _is_late(flight: Flight, vehicle: VehicleFile, lag: Lag) -> bool:
    """Return whether a lag of rotor speeds is significant, and confirmed by innovations.

    Rotors respond within a step, too: a lag is not confirmed where none or half of it is as likely.
    """
    if abs(lag.seconds) <= SIGNIFICANT_SD * lag.sd:
        return False
    late, *others = _turning_likelihoods(flight, vehicle, (lag.seconds, 0.5 * lag.seconds, 0.0))
    return late - max(others) > 0.5 * SIGNIFICANT_SD**2


def _turning_likelihoods(flight: Flight, vehicle: VehicleFile, at: Sequence[float]) -> list[float]:
    """Return the log-likelihood of the innovations of angular accelerations at some lags in s.

    Forces are left out: the velocity that they come from is filtered.
    """
    rotors = flight.series["rotor_speed"]
    there = np.isfinite(rotors.values).all(axis=1)
    rotors = Series(rotors.time[there], rotors.values[there])
    steps = steps_with(flight, rotors)
    if steps is None:
        return [0.0] * len(at)
    parts = [with_rotors(steps, Series(rotors.time - late, rotors.values)) for late in at]
    known = np.all([part.known for part in parts], axis=0)
    order = max(1, round(MEMORY_S / steps.step))
    new = [
        [
            _innovation_variance(steps.accelerations[:, 3 + axis], columns, known, order)
            for axis, columns in enumerate(regressors(part, vehicle))
        ]
        for part in parts
    ]
    return [-0.5 * float(known.sum() * np.log(of_axes).sum()) for of_axes in new]


def _innovation_variance(answer: Array, columns: Array, known: Mask, order: int) -> float:
    """Return the mean square of the innovations of a regression's errors."""
    rows = np.column_stack([answer, columns])
    filtered = rows[known]
    for _ in range(WHITENING_ROUNDS):
        weights = np.linalg.lstsq(filtered[:, 1:], filtered[:, 0], rcond=None)[0]
        kernel = whitening_filter(answer - columns @ weights, known, order)
        filtered = convolved(rows, known, kernel)
        if not len(filtered):  # gaps everywhere
            return 1.0
    left, _ = _residual(filtered[:, 1:], filtered[:, 0])
    return left / len(filtered)


def input_lag(flight: Flight, signal: str, vehicle: VehicleFile) -> Lag | None:
    """Return the lag of a flight's rotor speeds or commands behind its state.

    Parameters
    ----------
    flight
        A flight with a pose; the lag counts from the stamps of its body rate.
    signal
        ``rotor_speed`` or ``command``.
    vehicle
        Gives the rotors' places, and thrust up to a factor.

    Returns
    -------
    Lag or None
        None where it cannot be estimated.
    """
    clock = flight.time[TRIMMED_SAMPLES:-TRIMMED_SAMPLES]
    rows = flight.series[signal]
    if len(clock) < 200 or not np.isfinite(rows.values).any(axis=0).all():
        return None
    state = states_at(flight.series, clock)
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import, seldom needed)

    body = Rotation.from_quat(state.attitude, scalar_first=True).inv()
    moving = body.apply(state.velocity)
    faster = np.gradient(state.velocity, clock, axis=0)
    force = body.apply(faster + np.array([0.0, 0.0, GRAVITY]))
    turning = np.gradient(state.body_rate, clock, axis=0)
    if not (np.isfinite(force).all() and np.isfinite(turning).all()):
        return None
    thrust = _thrust_like(linear_interpolation(rows, clock), signal, vehicle)
    place = np.array([rotor.position for rotor in vehicle.rotors])
    spin = np.array([1.0 if rotor.spin == "ccw" else -1.0 for rotor in vehicle.rotors])
    driven = np.column_stack(
        [thrust @ place[:, 1], -thrust @ place[:, 0], -thrust @ spin, thrust.sum(axis=1)]
    )
    rate, along = state.body_rate, np.abs(moving[:, 2:])
    across = (moving[:, :2] ** 2).sum(axis=1, keepdims=True)
    damping = [
        np.column_stack([rate[:, 0], moving[:, 1]]),
        np.column_stack([rate[:, 1], moving[:, 0]]),
        rate[:, 2:],
        np.column_stack([moving[:, 2:], along, across]),
    ]
    answers = np.column_stack([turning, force[:, 2]])
    of_axes = np.stack(
        [
            _likelihoods(answers[:, axis], driven[:, axis], damping[axis], flight.rate)
            for axis in range(4)
        ]
    )
    return _likeliest_lag(of_axes / CORRELATED_FREQUENCIES)


def _thrust_like(inputs: Array, signal: str, vehicle: VehicleFile) -> Array:
    """Return the rotors' thrust (n, 4) up to a factor."""
    if signal == "command":
        motor = vehicle.motor
        inputs = motor.zero_position_armed + motor.input_scaling * inputs
    return inputs**2


def _likelihoods(answer: Array, driven: Array, damping: Array, rate: float) -> Array:
    """Return the log-likelihood of every lag of `LAGS_S` for one axis."""
    frequency = np.fft.rfftfreq(len(answer), 1.0 / rate)
    inside = (frequency > BAND_HZ[0]) & (frequency < BAND_HZ[1])
    taper = np.hanning(len(answer))[:, None]

    def spectrum(columns: Array) -> Spectrum:
        centred = (columns - columns.mean(axis=0)) * taper
        found: Spectrum = np.fft.rfft(centred, axis=0)[inside]
        return found

    there, moved = _real(spectrum(answer[:, None]))[:, 0], spectrum(driven[:, None])
    others, turn = _real(spectrum(damping)), 2j * np.pi * frequency[inside][:, None]
    left, _ = _residual(others, there)
    gains = []
    for late in LAGS_S:
        remains, weight = _residual(np.hstack([others, _real(moved * np.exp(turn * late))]), there)
        gains.append(inside.sum() * np.log(left / remains) if weight > 0 else 0.0)
    return np.array(gains)


def _residual(matrix: Array, there: Array) -> tuple[float, float]:
    """Return the residual sum of squares of a column, and the last regressor's weight."""
    weights = np.linalg.lstsq(matrix, there, rcond=None)[0]
    return float(np.sum((there - matrix @ weights) ** 2)), float(weights[-1])


def _real(columns: Spectrum) -> Array:
    return np.concatenate([columns.real, columns.imag])


def _likeliest_lag(of_axes: Array) -> Lag | None:
    """Return the likeliest lag of all axes, by the parabola through the peak of their sum.

    None for no sharp peak. Where the axes contradict each other by more than chance, the standard
    deviation grows by Birge's ratio. ``of_axes`` (axes, lags) are log-likelihoods.
    """
    likelihood = of_axes.sum(axis=0)
    at = int(np.argmax(likelihood))
    if at in (0, len(LAGS_S) - 1):
        return None
    before, top, after = likelihood[at - 1 : at + 2]
    bend, step = before - 2.0 * top + after, float(LAGS_S[1] - LAGS_S[0])
    if bend >= 0.0:
        return None
    fallen = 2.0 * np.sum(of_axes.max(axis=1) - of_axes[:, at])
    birge = np.sqrt(max(fallen / (len(of_axes) - 1), 1.0))
    sd = birge * step / np.sqrt(-bend)
    place = float(LAGS_S[at] + 0.5 * (before - after) / bend * step)
    return Lag(place, float(sd)) if sd < MAX_LAG_SD_S else None
