"""Flights and windows as arrays of one shape: inputs, measurements, and weights by their noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike, NDArray

from sim_jax.environment import Disturbance
from sim_jax.inlet import Inlet, ReferenceInlet
from sim_jax.numeric import Array
from sim_jax.schedule import Schedule
from sim_jax.state import Start
from tuner.config import CHANNELS, InletName
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array as Numbers
from tuner.core.numerics import robust_sd
from tuner.objective.battery import ROTOR_LAG_S, log_voltage_of
from tuner.objective.initial_conditions import (
    FORGOTTEN_S,
    SPIN_ROWS,
    is_at_rest,
    recent_command,
    start_of,
    start_sd_of,
    start_sd_of_spin,
)
from tuner.objective.inlets import INLETS, inlet_of
from tuner.objective.windows import Window, windows_of
from tuner.recordings.flight import Flight, Series
from tuner.recordings.states import initial_position_error
from tuner.vehicle import recording_offsets

#: Smallest believable standard deviation, in the channel's unit (attitude: rad).
MIN_NOISE = {
    "position": 1e-4,
    "attitude": 1e-4,
    "body_rate": 1e-3,
    "rotor_speed": 0.3,
    "command": 2e-4,
    "acceleration": 0.02,
}


def white_noise(series: Series) -> Numbers:
    """Return each column's standard deviation of the noise between neighbouring samples.

    Every sample is compared with the parabola through its neighbours at their own times, so that
    jitter of stamps does not matter; the median is robust to jumps.

    Parameters
    ----------
    series
        (n, k) samples.

    Returns
    -------
    array
        (k,), NaN where a column was not measured.
    """
    spread = np.full(series.values.shape[1], np.nan)
    for column in range(series.values.shape[1]):
        measured = np.isfinite(series.values[:, column])
        time, values = series.time[measured], series.values[measured, column]
        if len(values) > 8:
            error = _third_difference(time, values)
            spread[column] = robust_sd(error)
    return spread


def _third_difference(time: Numbers, values: Numbers) -> Numbers:
    """Return divided third differences, scaled so that white noise keeps its variance."""
    stamps = np.stack([time[i : len(time) - 3 + i] for i in range(4)])
    samples = np.stack([values[i : len(values) - 3 + i] for i in range(4)])
    gaps = stamps[:, None] - stamps[None]
    gaps[np.arange(4), np.arange(4)] = 1.0
    weights = 1.0 / gaps.prod(axis=1)
    scaled = (weights * samples).sum(axis=0) / np.sqrt((weights**2).sum(axis=0))
    return np.asarray(scaled)


def noise_of(flights: Sequence[Flight], channels: Sequence[str] = CHANNELS) -> dict[str, float]:
    """Return the measurement noise of every channel that some flight recorded."""
    recorded = [c for c in channels if any(flight.has(c) for flight in flights)]
    return {channel: channel_noise(flights, channel) for channel in recorded}


def channel_noise(flights: Sequence[Flight], channel: str) -> float:
    """Return one standard deviation for a channel over all flights, in its unit (attitude: rad).

    Commands come in steps and are smooth between them, so that only rounding counts: their noise
    is the step's share.
    """
    per_flight = []
    for flight in flights:
        series = flight.series.get(channel)
        if series is None or not np.isfinite(series.values).any():
            continue
        if channel == "command":
            gaps = np.diff(np.unique(series.values[np.isfinite(series.values)]))
            steps = gaps[gaps > 1e-9]  # between different values of a quantised signal
            per_flight.append(float(np.min(steps)) / np.sqrt(12.0) if len(steps) else 0.0)
        elif channel == "attitude":
            per_flight.append(2.0 * float(np.nanmedian(white_noise(series)[1:])))
        else:
            per_flight.append(float(np.nanmedian(white_noise(series))))
    known = [value for value in per_flight if np.isfinite(value)]
    return max(float(np.median(known)) if known else 0.0, MIN_NOISE[channel])


def repeat_counts(values: Numbers) -> Numbers:
    """Return the length of the run of equal samples that each of (n, k) belongs to.

    A run of equal rounded values has one rounding error: it is one reading. Counted as many, those
    of a steady yaw spin had biased the moment constant.
    """
    counts = np.ones(values.shape)
    for column, samples in enumerate(values.T):
        begins = np.flatnonzero(np.append(True, samples[1:] != samples[:-1]))
        lengths = np.diff(np.append(begins, len(samples)))
        counts[:, column] = np.repeat(lengths, lengths)
    return counts


#: Clocks of a recording: motion capture stamps poses, the flight controller everything else.
CLOCKS = tuple(name for name, row in recording_offsets().items() if row.unit == "s")
CLOCK_OF = {
    "position": 0,
    "attitude": 0,
    "body_rate": 1,
    "rotor_speed": 1,
    "command": 1,
    "acceleration": 1,
}

#: Channels that are compared even where they are fed in.
POSE = ("position", "attitude")

#: Constant errors of a recording: offsets of its clocks, s, and biases of its gyro, rad/s.
OFFSETS = tuple(recording_offsets())


class MeasuredChannel(eqx.Module):
    """One channel of every segment, padded to one length.

    Attributes
    ----------
    time
        (n, F) s since the segment's start.
    values
        (n, c, F); attitude has four columns.
    weight
        (n, c, F) one over the standard deviation, zero where nothing was measured; attitude has
        three columns, in 1/rad.
    """

    time: Float[Array, "n F"]
    values: Float[Array, "n c F"]
    weight: Float[Array, "n k F"]


class Segments(eqx.Module):
    """Everything of the data that a fit needs; segments lie along the last axis.

    A segment is a flight, or a window of one.
    """

    inlet: Inlet
    start: Start
    measured: dict[str, MeasuredChannel]
    flight: Int[Array, " F"]
    """Number of the flight that a segment belongs to."""
    turning: Float[Array, "4 F"] | None = None
    """Recent commands 0..1 of rotors whose speed at the start was not measured, else NaN."""
    begin: Float[Array, " F"] | None = None
    """s since the mission's start at which each segment begins; None where all begin there."""
    resting: Bool[Array, " F"] | None = None
    """Which segments start at rest, level; None where none does."""
    log_voltage: Float[Array, "ticks F"] | None = None
    """Logarithm of the battery's voltage in V, one a control tick; NaN where it is unknown."""
    disturbance: Disturbance | None = None
    """Known forces and moments of disturbances."""
    start_sd: Float[Array, "L F"] | None = None
    """Prior standard deviations of rows of a start; None where starts are as recorded."""
    free_rows: tuple[int, ...] = eqx.field(static=True, default=())
    """The L rows of a start (`tuner.objective.initial_conditions`) that may be free."""

    @property
    def windowed(self) -> bool:
        """Whether they are windows of flights rather than whole ones."""
        return self.begin is not None

    @property
    def begins(self) -> NDArray[np.float64]:
        """The s (F,) since the missions' starts at which the segments begin."""
        return np.zeros(self.count) if self.begin is None else np.asarray(self.begin)

    @property
    def count(self) -> int:
        """Number of segments."""
        return self.flight.shape[0]


def segments_of(
    flights: Sequence[Flight],
    *,
    noise: Mapping[str, float],
    schedule: Schedule,
    weights: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> Segments:
    """Lay whole flights side by side for the ``reference`` inlet.

    A spin has a free initial state: see `start_sd_of_spin`. So has a flight whose recording begins
    in motion: what its controllers had in memory then is not recorded, and their position control
    forgets it over seconds. Its samples count from `FORGOTTEN_S` on.

    Parameters
    ----------
    flights
        F flights with a recorded or named reference.
    noise
        Channel -> standard deviation in its unit (attitude: rad). Channels not named are left out.
    schedule
        Rates of the control ticks, at which the battery's voltage is laid out.
    weights
        Flight name -> channel -> factor on the residuals.

    Raises
    ------
    RecordingError
        A flight holds no reference.
    """
    silent = INLETS["reference"].not_compared
    noise = {channel: sigma for channel, sigma in noise.items() if channel not in silent}
    for flight in flights:
        if not flight.has("reference_position"):
            raise RecordingError(
                flight.path,
                "holds no reference and none is named",
                "name its trajectory in the job file, or fit through another inlet",
            )
    inlet = INLETS["reference"].lay_out(flights, schedule)
    assert isinstance(inlet, ReferenceInlet)
    start_sd: dict[int, Numbers] = {}
    if bool(np.any(inlet.spins)):
        rate = np.where(inlet.spins, inlet.yaw_rate, 0.0)
        known = noise.get("position", 0.0)  # where no position is compared, none is corrected
        begun = [initial_position_error(flight.series, known) for flight in flights]
        start_sd = start_sd_of_spin(np.asarray(rate), schedule.rate_control_rate, np.array(begun))
    whole = [Window(flight, 0.0) for flight in flights]
    resting = np.array([is_at_rest(flight.initial) for flight in flights])
    free_rows: tuple[int, ...] = SPIN_ROWS
    turning: Numbers | None = None
    if not resting.all():
        sds = start_sd_of(INLETS["reference"].ignores)
        free_rows = tuple(np.flatnonzero(sds).tolist())
        start_sd = {
            row: np.maximum(~resting * sds[row], start_sd.get(row, 0.0)) for row in free_rows
        }
        turning = np.where(resting, np.nan, commanded_before(whole, ROTOR_LAG_S))
    begins = FORGOTTEN_S * ~resting
    return Segments(
        inlet=inlet,
        start=start_of([flight.initial for flight in flights]),
        measured={
            name: _measured(flights, name, sd, weights, begins) for name, sd in noise.items()
        },
        flight=np.arange(len(flights)),
        turning=turning,
        resting=resting,
        log_voltage=log_voltage_of(flights, whole, schedule),
        start_sd=np.stack(list(start_sd.values())) if start_sd else None,
        free_rows=free_rows,
    )


def cut_windows(
    flights: Sequence[Flight],
    *,
    inlets: Sequence[InletName],
    seconds: float,
    stride: float | None = None,
    free_starts: bool = True,
    input_late: Mapping[str, float] = MappingProxyType({}),
) -> list[Window]:
    """Cut flights into the windows that `window_segments` lays out.

    Their inputs are on the clock of the compared channels.

    Parameters
    ----------
    flights, inlets
        N flights, and the inlet of each.
    seconds
        s, length of a window.
    stride
        s from the beginning of a window to that of the next; by default its length.
    free_starts
        Whether starts are free, about the widely smoothed state; else they are the recorded states
        (`tuner.recordings.states`).
    input_late
        Flight name -> s by which inputs are stamped later than the compared channels.
    """
    pieces = []
    for number, (flight, name) in enumerate(zip(flights, inlets, strict=True)):
        fed, late = INLETS[name].fed(flight), input_late.get(flight.name, 0.0)
        for window in windows_of(
            flight, seconds, fed=fed, stride=stride, smoothed_widely=free_starts
        ):
            own = stamped_earlier(window.flight, INLETS[name].fed(window.flight), late)
            pieces.append(Window(own, window.begin, number))
    return pieces


def window_segments(
    flights: Sequence[Flight],
    pieces: Sequence[Window],
    *,
    inlets: Sequence[InletName],
    schedule: Schedule,
    lag: float,
    noise: Mapping[str, float],
    weights: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    free_starts: bool = True,
) -> Segments:
    """Lay the windows of all flights side by side.

    Parameters
    ----------
    flights, pieces
        N flights, and their windows, as of `cut_windows`.
    inlets, schedule
        Inlet of each flight, and the rates of the loop.
    lag
        Time constant of rotors, s: gives the initial speed of those without tachometer.
    noise, weights
        As of `segments_of`.
    free_starts
        Whether starts are free, as of `cut_windows`.
    """
    cut = [piece.flight for piece in pieces]
    start = start_of([flight.initial for flight in cut], resting=False)
    recorded = [INLETS[inlets[piece.number]] for piece in pieces]
    of_all = np.stack([start_sd_of(inlet.ignores) for inlet in recorded], axis=-1)
    free_rows = np.flatnonzero(of_all.any(axis=1))
    compared = {
        channel: sigma
        for channel, sigma in noise.items()
        if channel in POSE or any(channel not in INLETS[name].not_compared for name in inlets)
    }
    weights = {
        flight.name: dict(weights.get(flight.name, {}))
        | dict.fromkeys(INLETS[name].not_compared, 0.0)
        for flight, name in zip(flights, inlets, strict=True)
    }
    return Segments(
        inlet=inlet_of(recorded, cut, schedule),
        start=start,
        measured={name: _measured(cut, name, sd, weights) for name, sd in compared.items()},
        flight=np.asarray([piece.number for piece in pieces]),
        turning=commanded_before(pieces, lag),
        begin=np.asarray([piece.begin for piece in pieces]),
        log_voltage=log_voltage_of([flights[piece.number] for piece in pieces], pieces, schedule),
        start_sd=of_all[free_rows] if free_starts else None,
        free_rows=tuple(free_rows.tolist()),
    )


def commanded_before(pieces: Sequence[Window], lag: float) -> Numbers:
    """Return the commands (4, F) that the rotors of windows have followed, as `recent_command`."""
    return np.stack([recent_command(piece.flight, lag) for piece in pieces], axis=-1)


def stamped_earlier(flight: Flight, signals: Sequence[str], late: float) -> Flight:
    """Return a flight with the stamps of some signals moved to earlier by ``late`` s."""
    if late == 0.0:
        return flight
    moved = {
        name: Series(flight.series[name].time - late, flight.series[name].values)
        for name in signals
    }
    return replace(flight, series={**flight.series, **moved})


def _measured(
    flights: Sequence[Flight],
    channel: str,
    sigma: float,
    weights: Mapping[str, Mapping[str, float]],
    begins: ArrayLike = 0.0,
) -> MeasuredChannel:
    """Return a channel of all flights from ``begins`` s on, padded with zeros or a level attitude.

    ``begins`` is one for all flights, or each one's own.
    """
    width = 4 if channel in ("attitude", "rotor_speed", "command") else 3
    first = 1 if channel == "attitude" else 0
    nothing = Series(np.zeros(0), np.zeros((0, width)))
    recorded = [
        flight.series.get(channel, nothing).between(begin, flight.time[-1])
        for flight, begin in zip(flights, np.broadcast_to(begins, len(flights)), strict=True)
    ]
    shape = max(len(series.time) for series in recorded), len(flights)
    time, values = np.zeros(shape), np.zeros((shape[0], width, shape[1]))
    weight = np.zeros((shape[0], width - first, shape[1]))
    values[:, :first] = 1.0
    for number, (flight, series) in enumerate(zip(flights, recorded, strict=True)):
        finite, length = np.isfinite(series.values), len(series.time)
        scale = finite * (weights.get(flight.name, {}).get(channel, 1.0) / sigma)
        if channel == "command":
            scale = scale / np.sqrt(repeat_counts(series.values))
        time[:length, number] = series.time
        values[:length, :, number] = np.where(finite, series.values, 0.0)
        weight[:length, :, number] = scale[:, first:]
    return MeasuredChannel(time, values, weight)
