"""By how much what is fed in of a flight is stamped later than its state, before any fit.

Rotor speeds or commands may be stamped by another clock than the state, or reach the logger later,
by another number of samples in every file. Angular acceleration and thrust are, at every frequency,
what rotors make of them with an unknown gain: per axis, with T the rotor's thrust up to a factor,

    dω/dt = g Σ ± r T(t - δ) + damping,     specific force along the thrust = g Σ T(t - δ) + drag.

At each lateness δ the gains follow by least squares in the frequency domain, where a lateness of
any fraction of a sample is a turn of the phase; the likeliest δ is where least is left of the
accelerations (Ljung, System Identification, 7.7). Between `BAND` Hz, since below it tachometers
drift and the loop takes out what it can, and above it there is noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_jax.numeric import GRAVITY
from tuner.objective.inlets import INLETS
from tuner.recordings.flight import Array, Flight
from tuner.recordings.states import states_at
from tuner.search.job_flights import Recording
from tuner.vehicle import VehicleFile

BAND = (0.7, 8.0)
"""Hz between which accelerations are compared."""
GRID = np.arange(-24, 25) * 0.0025
"""s of lateness that are tried: five samples at 100 Hz, and as much again for a rotor's lag."""
KNOWN = 0.003
"""s of standard deviation up to which a lateness is believed."""
ENDS = 10
"""Ticks at either end of a flight, where its derivatives are worse."""
INDEPENDENT = 3.0
"""Neighbouring frequencies that say the same, on average: the taper and the filter join them."""

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class Lag:
    """A lateness and its standard deviation, in s."""

    seconds: float
    sd: float


def with_inputs_on_time(
    recordings: Sequence[Recording], vehicle: VehicleFile
) -> tuple[Recording, ...]:
    """Return recordings with the lateness of what is fed in, where it can be told.

    Rotor speeds are late by themselves; commands are by what their flight's lateness differs from
    the flights' mean, which is the vehicle's own lag. A flight of which it cannot be told has the
    mean of the others, and so have flights that are held out: nothing is fitted to them.
    """
    late: dict[str, float] = {}
    for inlet in {recording.inlet for recording in recordings}:
        same = [recording for recording in recordings if recording.inlet == inlet]
        if not INLETS[inlet].starts_recorded:
            continue
        lags = {
            recording.flight.name: input_lag(recording.flight, INLETS[inlet].needs[0], vehicle)
            for recording in same
            if not recording.holdout and recording.time_offset is None
        }
        known = {name: lag.seconds for name, lag in lags.items() if lag is not None}
        if not known:
            continue
        mean = float(np.mean(list(known.values())))
        own_lag = mean if "actuator_latency" not in INLETS[inlet].bypasses else 0.0
        late |= {r.flight.name: known.get(r.flight.name, mean) - own_lag for r in same}
    return tuple(
        replace(r, input_late=late.get(r.flight.name, r.input_late)) if r.time_offset is None else r
        for r in recordings
    )


def input_lag(flight: Flight, signal: str, vehicle: VehicleFile) -> Lag | None:
    """Return by how much a flight's rotor speeds or commands are stamped later than its state.

    Parameters
    ----------
    flight
        With a pose; the lateness counts from the stamps of its body rate.
    signal
        ``rotor_speed`` or ``command``.
    vehicle
        Gives the rotors' places, and thrust up to a factor.

    Returns
    -------
    Lag or None
        None where the flight does not tell.
    """
    clock = flight.time[ENDS:-ENDS]
    rows = flight.series[signal]
    if len(clock) < 200 or not np.isfinite(rows.values).any(axis=0).all():
        return None
    state = states_at(flight.series, clock)
    body = Rotation.from_quat(state.attitude, scalar_first=True).inv()
    moving = body.apply(state.velocity)
    faster = np.gradient(state.velocity, clock, axis=0)
    force = body.apply(faster + np.array([0.0, 0.0, GRAVITY]))
    turning = np.gradient(state.body_rate, clock, axis=0)
    if not (np.isfinite(force).all() and np.isfinite(turning).all()):
        return None
    inputs = np.column_stack(
        [
            np.interp(clock, rows.time[np.isfinite(column)], column[np.isfinite(column)])
            for column in rows.values.T
        ]
    )
    thrust = _thrust_like(inputs, signal, vehicle)
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
    return _peak(of_axes / INDEPENDENT)


def _thrust_like(inputs: Array, signal: str, vehicle: VehicleFile) -> Array:
    """Return what goes with the rotors' thrust (n, 4)."""
    if signal == "command":
        motor = vehicle.motor
        inputs = motor.zero_position_armed + motor.input_scaling * inputs
    return inputs**2


def _likelihoods(answer: Array, driven: Array, damping: Array, rate: float) -> Array:
    """Return the log-likelihood of every lateness of `GRID` for one axis."""
    frequency = np.fft.rfftfreq(len(answer), 1.0 / rate)
    inside = (frequency > BAND[0]) & (frequency < BAND[1])
    taper = np.hanning(len(answer))[:, None]

    def spectrum(columns: Array) -> Spectrum:
        centred = (columns - columns.mean(axis=0)) * taper
        found: Spectrum = np.fft.rfft(centred, axis=0)[inside]
        return found

    there, moved = _real(spectrum(answer[:, None]))[:, 0], spectrum(driven[:, None])
    others, turn = _real(spectrum(damping)), 2j * np.pi * frequency[inside][:, None]
    left, _ = _left(others, there)
    gains = []
    for late in GRID:
        remains, weight = _left(np.hstack([others, _real(moved * np.exp(turn * late))]), there)
        gains.append(inside.sum() * np.log(left / remains) if weight > 0 else 0.0)
    return np.array(gains)


def _left(matrix: Array, there: Array) -> tuple[float, float]:
    """Return the sum of squares that is left of a column, and the last regressor's weight."""
    weights = np.linalg.lstsq(matrix, there, rcond=None)[0]
    return float(np.sum((there - matrix @ weights) ** 2)), float(weights[-1])


def _real(columns: Spectrum) -> Array:
    return np.concatenate([columns.real, columns.imag])


def _peak(of_axes: Array) -> Lag | None:
    """Return the likeliest lateness of all axes, by the parabola through the peak of their sum.

    None for no sharp one. Where the axes contradict each other by more than chance, its standard
    deviation grows by Birge's ratio.

    Parameters
    ----------
    of_axes
        (axes, latenesses) log-likelihoods.
    """
    likelihood = of_axes.sum(axis=0)
    at = int(np.argmax(likelihood))
    if at in (0, len(GRID) - 1):
        return None
    before, top, after = likelihood[at - 1 : at + 2]
    bend, step = before - 2.0 * top + after, float(GRID[1] - GRID[0])
    if bend >= 0.0:
        return None
    fallen = 2.0 * np.sum(of_axes.max(axis=1) - of_axes[:, at])
    birge = np.sqrt(max(fallen / (len(of_axes) - 1), 1.0))
    sd = birge * step / np.sqrt(-bend)
    place = float(GRID[at] + 0.5 * (before - after) / bend * step)
    return Lag(place, float(sd)) if sd < KNOWN else None
