"""What a vehicle does after each recorded state, fed with the recorded inputs, against what it did.

A prediction begins at the recorded state (`tuner.recordings.states`) and is simulated open loop
for a stated time. Nothing is fitted to the flight that is predicted: no start, no trim, no offset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from sim_jax.schedule import Schedule
from sim_jax.state import AIRBORNE
from tuner.config.job import InletName
from tuner.findings.sentences import PREDICTED
from tuner.objective.battery import with_reference_voltage
from tuner.objective.flight import MOTION
from tuner.objective.flown import fly
from tuner.objective.inlets import INLETS
from tuner.objective.segments import Segments, window_segments
from tuner.recordings.flight import Array, Flight
from tuner.recordings.states import States, states_at
from tuner.search.job_flights import Recording
from tuner.vehicle import ControllerFile, VehicleFile
from tuner.vehicle.model import Model, model_of, schedule_of

AT_ONCE = 4096
"""Predictions that are simulated side by side."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of one flight: n from one recorded state each, compared at S steps.

    Attributes
    ----------
    begins
        (n,) s since the mission's start at which they begin.
    ahead
        (S,) s after that at which they are compared.
    errors
        Quantity of `PREDICTED` -> (S, n): Euclidean distance from the recorded one, for an attitude
        the angle of the rotation between both; what the inlet follows, and does not predict, is
        left out.
    """

    begins: Array
    ahead: Array
    errors: Mapping[str, Array]

    def mean(self, seconds: float) -> dict[str, float]:
        """Return each quantity's mean error so many s ahead, NaN of what is not predicted."""
        (step,) = np.flatnonzero(np.isclose(self.ahead, seconds, atol=1e-6))
        means = {name: float(np.nanmean(errors[step])) for name, errors in self.errors.items()}
        return dict.fromkeys(PREDICTED, np.nan) | means


def predict(
    vehicle: VehicleFile,
    controller: ControllerFile,
    flight: Flight,
    inlet: InletName,
    *,
    seconds: float = 0.5,
    stride: float | None = None,
    input_late: float = 0.0,
) -> Predictions:
    """Predict a flight open loop from many of its recorded states.

    Parameters
    ----------
    vehicle, controller
        What flies; the controller gives the rates of the simulation.
    flight, inlet
        The recording and what of it is fed in.
    seconds
        s that each prediction lasts.
    stride
        s from one prediction to the next; by default one sample.
    input_late
        s by which what is fed in is stamped later than the recorded state.

    Raises
    ------
    RecordingError
        The flight never holds so many s of pose and input.
    """
    segments, begins = starts_of(
        flight,
        inlet,
        schedule_of(controller),
        seconds=seconds,
        stride=1.0 / flight.rate if stride is None else stride,
        lag=0.5 * (vehicle.motor.time_constant_up + vehicle.motor.time_constant_down),
        input_late=input_late,
    )
    model = model_of(with_reference_voltage(vehicle, [flight]), controller)
    steps = round(seconds * flight.rate)
    ahead = np.arange(1, steps + 1) / flight.rate
    reached = _simulated(model, segments, schedule_of(controller), ahead)
    recorded = states_at(flight.series, (begins + ahead[:, None]).ravel())
    errors = errors_of(reached, recorded, (steps, len(begins)))
    followed = INLETS[inlet].silences
    predicted = {name: distances for name, distances in errors.items() if name not in followed}
    return Predictions(begins, ahead, predicted)


def starts_of(
    flight: Flight,
    inlet: InletName,
    schedule: Schedule,
    *,
    seconds: float,
    stride: float,
    lag: float,
    input_late: float = 0.0,
) -> tuple[Segments, Array]:
    """Return the recorded states of a flight that are so many s from its end, and their times."""
    segments = window_segments(
        [flight],
        inlets=[inlet],
        seconds=seconds,
        schedule=schedule,
        lag=lag,
        noise={},
        stride=stride,
        free_starts=False,
        input_late={flight.name: input_late},
    )
    begins = segments.begins
    whole = np.flatnonzero(begins + seconds <= flight.duration + 1e-9)
    return _taken(segments, whole), begins[whole]


def errors_of(
    reached: Mapping[str, Array], recorded: States, shape: tuple[int, int]
) -> dict[str, Array]:
    """Return quantity -> (S, n) distances of what was reached (S, n, k) from recorded states."""
    errors = {}
    for name in PREDICTED:
        there = getattr(recorded, name).reshape(*shape, -1)
        if name == "attitude":
            along = np.abs(np.sum(reached[name] * there, axis=-1))
            errors[name] = 2.0 * np.arccos(np.clip(along, 0.0, 1.0))
        else:
            errors[name] = np.linalg.norm(reached[name] - there, axis=-1)
    return errors


def _simulated(
    model: Model, segments: Segments, schedule: Schedule, ahead: Array
) -> dict[str, Array]:
    """Return quantity -> (S, n, k) that the simulations reach so many s (S,) ahead."""
    samples = int(np.ceil(ahead[-1] * schedule.log_rate - 1e-6)) + 2
    parts = []
    for first in range(0, segments.count, AT_ONCE):
        chosen = np.arange(first, min(first + AT_ONCE, segments.count))
        parts.append(_reached(model, _taken(segments, chosen), ahead, schedule, samples))
    return {name: np.concatenate([part[name] for part in parts], axis=1) for name in PREDICTED}


def _reached(
    model: Model, segments: Segments, ahead: Array, schedule: Schedule, samples: int
) -> dict[str, Array]:
    channels = ("position", "attitude", MOTION)
    flown = fly(
        model, segments, schedule, samples=samples, limits=AIRBORNE, channels=channels
    ).channels
    place = ahead * schedule.log_rate
    below = np.floor(place + 1e-6).astype(int)
    share = (place - below)[:, None, None]

    def at(logged: Array) -> Array:
        before, after = np.moveaxis(logged[:, below], 0, 1), np.moveaxis(logged[:, below + 1], 0, 1)
        return np.asarray(before + share * (after - before))

    turned = at(flown["attitude"])
    return {
        "position": at(flown["position"]),
        "velocity": at(flown[MOTION][..., 3:6]),
        "attitude": turned / np.linalg.norm(turned, axis=-1, keepdims=True),
        "body_rate": at(flown[MOTION][..., 6:9]),
    }


def _taken(segments: Segments, chosen: NDArray[np.intp]) -> Segments:
    """Return some of the segments, which lie along the last axis."""
    taken: Segments = jax.tree.map(lambda leaf: leaf[..., chosen], segments)
    return taken


def hold(flight: Flight, begins: Array, ahead: Array) -> Predictions:
    """Predict that the state stays as it was recorded: the naive predictor."""
    start = states_at(flight.series, begins)
    shape = (len(ahead), len(begins))
    reached = {
        name: np.broadcast_to(getattr(start, name), (*shape, getattr(start, name).shape[-1]))
        for name in PREDICTED
    }
    recorded = states_at(flight.series, (begins + ahead[:, None]).ravel())
    return Predictions(begins, ahead, errors_of(reached, recorded, shape))


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
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import, seldom needed)

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
