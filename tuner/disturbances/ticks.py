"""Recorded set-points and samples on the ticks of the simulation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from sim_jax.geometry import Vec3
from sim_jax.inlet import BodyRateInlet
from sim_jax.schedule import Schedule
from tuner.core.numerics import Array
from tuner.objective.criterion import AnyArray
from tuner.objective.segments import CLOCK_OF, CLOCKS, MeasuredChannel, repeat_counts
from tuner.recordings.flight import Flight

SETPOINTS = ("rate_setpoint", "thrust_setpoint")
MAX_MISSING_SHARE = 0.1
"""Largest share of missing set-points, which are interpolated."""
MAX_TICK_OFFSET = 0.25
"""Largest median distance of set-points' stamps from ticks of position control, in periods."""
FLIGHT_CONTROLLER = CLOCKS.index("flight_controller")


class TickSamples(eqx.Module):
    """One channel on T ticks: the sample between a tick and the one before, if there is one.

    Attributes
    ----------
    values
        (T, c, F).
    weight
        (T, k, F) one over the standard deviation; zero where nothing was measured.
    place
        (T, F) its place between both ticks, 0..1, without clock offset.
    """

    values: Float[AnyArray, "T c F"]
    weight: Float[AnyArray, "T k F"]
    place: Float[AnyArray, "T F"]


def sampled(
    channel: str, measured: MeasuredChannel, late: Array, ticks: int, rate: float
) -> tuple[TickSamples, NDArray[np.intp]]:
    """Assign a channel's samples to ticks.

    Parameters
    ----------
    channel
        A command belongs to the tick before its stamp, others lie between two ticks.
    measured
        The n samples of F segments.
    late
        (clocks, F) s by which stamps are late.
    ticks, rate
        Number of ticks, and ticks per second.

    Returns
    -------
    tuple
        The channel, and each sample's tick (n, F), or -1: of several between two ticks the last is
        used.
    """
    time, weight = np.asarray(measured.time), np.asarray(measured.weight)
    values = np.asarray(measured.values)
    at = (time - late[CLOCK_OF[channel]]) * rate
    tick = (np.floor(at + 1e-6) if channel == "command" else np.ceil(at - 1e-6)).astype(int)
    counts = (weight > 0).any(axis=1) & (tick >= 0) & (tick < ticks)
    laid = np.zeros((ticks, *values.shape[1:])), np.zeros((ticks, *weight.shape[1:]))
    if channel == "attitude":
        laid[0][:, 0] = 1.0
    place, rows = np.ones((ticks, time.shape[1])), np.full(time.shape, -1)
    for segment in range(time.shape[1]):
        taken = np.full(ticks, -1)
        known = np.flatnonzero(counts[:, segment])
        taken[tick[known, segment]] = known
        filled = np.flatnonzero(taken >= 0)
        sample = taken[filled]
        laid[0][filled, :, segment] = values[sample, :, segment]
        laid[1][filled, :, segment] = weight[sample, :, segment]
        place[filled, segment] = 1.0 - filled + time[sample, segment] * rate
        rows[sample, segment] = filled
    return TickSamples(*laid, place), rows


def with_equal_weights(commands: MeasuredChannel) -> MeasuredChannel:
    """Return commands with equal weights, without the reduction for repeated values.

    Least squares takes equal values in a row for one reading (`repeat_counts`). A run's length
    depends on later values, and innovations with such weights would not be white: a filter weights
    all equally, and estimates their noise. Commands of which one is at its limit have no weight:
    what they answer is cut off, and a filter that is linear would take the rest for the whole.
    """
    values = np.asarray(commands.values)
    rests = np.stack([repeat_counts(table) for table in np.moveaxis(values, -1, 0)], axis=-1)
    inside = ~((values <= 0.0) | (values >= 1.0)).any(axis=1, keepdims=True)
    return replace(commands, weight=np.asarray(commands.weight) * np.sqrt(rests) * inside)


def setpoints_on_ticks(
    flights: Sequence[Flight], schedule: Schedule, samples: int
) -> BodyRateInlet | None:
    """Return rate and thrust set-points at the ticks of position control.

    None where not all were recorded, or stamps are too far from ticks. They are published after
    their computation: each belongs to the nearest tick, where a zero-order hold would delay it by
    a step.

    Parameters
    ----------
    flights
        F flights.
    schedule
        Gives the ticks.
    samples
        Number of samples of the simulation's log.
    """
    rate = float(schedule.position_control_rate)
    ticks = np.arange(int(np.ceil(samples / schedule.log_rate * rate)) + 2)
    laid = []
    for flight in flights:
        rows = []
        for name in SETPOINTS:
            series = flight.series.get(name)
            if series is None or not np.isfinite(series.values).all():
                return None
            at = series.time * rate
            tick = np.round(at)
            flown = (tick >= 0) & (tick <= flight.duration * rate)
            expected = flight.duration * rate
            if (
                np.count_nonzero(flown) < (1.0 - MAX_MISSING_SHARE) * expected
                or np.median(np.abs(at - tick)[flown]) > MAX_TICK_OFFSET
            ):
                return None
            rows += [np.interp(ticks, tick, column) for column in series.values.T]
        laid.append(np.stack(rows))
    table = np.stack(laid, axis=-1)
    steps = np.arange(int(np.ceil(samples / schedule.log_rate * schedule.physics_rate)) + 2)
    tick_of = steps * schedule.position_control_rate // schedule.physics_rate
    x, y, z, thrust = table[:, tick_of]
    return BodyRateInlet(Vec3(x, y, z), thrust)


def samples_of_ticks(
    table: Array, widths: Mapping[str, int], rows: Mapping[str, NDArray[np.intp]]
) -> dict[str, Array]:
    """Return channel -> (\\*leading, n, k, F) of a table (\\*leading, T, m, F) on ticks.

    Parameters
    ----------
    table
        The channels' columns, one channel after the other.
    widths
        Channel -> number of columns.
    rows
        Channel -> (n, F) each sample's tick; samples without one are zero.
    """
    channels, first = {}, 0
    for name, width in widths.items():
        tick = rows[name]
        columns = table[..., first : first + width, :]
        taken = np.take_along_axis(
            columns, np.maximum(tick, 0).reshape((1,) * (table.ndim - 3) + (len(tick), 1, -1)), -3
        )
        channels[name] = np.where((tick >= 0)[:, None], taken, 0.0)
        first += width
    return channels


def derivatives_of_samples(
    laid: NDArray[np.float32], widths: Mapping[str, int], rows: Mapping[str, NDArray[np.intp]]
) -> Iterator[tuple[str, int, NDArray[np.float32]]]:
    """Return channel, segment and the samples' (Q, n, k) of derivatives on ticks.

    Parameters
    ----------
    laid
        (F, Q, T, m), the channels' rows one channel after the other.
    widths, rows
        As of `samples_of_ticks`.
    """
    first = 0
    for name, width in widths.items():
        for segment, tick in enumerate(rows[name].T):
            part = laid[segment][:, np.maximum(tick, 0), first : first + width]
            part[:, tick < 0] = 0.0
            yield name, segment, part
        first += width
