"""Simulated minus recorded, in standard deviations, at the recorded stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lanes import Argument, Program, joined
from sim_jax.geometry import Quaternion
from sim_jax.numeric import Array as JaxArray
from tuner.core.numerics import Array, huber_weights
from tuner.objective.criterion import OFFSET_UNIT
from tuner.objective.segments import CLOCK_OF, CLOCKS, Segments
from tuner.objective.simulation import CODE, SimulatedChannels

RAMP_SHARE = 0.25
"""Share of the time between two jumps of a zero-order hold that the ramp to the next takes."""


STAMPS_AT_ONCE = 1024
"""Stamps of segments that are compared at a time: their results fit the processor's cache."""


class Block(NamedTuple):
    """Simulated minus recorded of some stamps of some segments, in standard deviations.

    Attributes
    ----------
    segments
        Which of the F segments: G of them.
    stamps
        (G, m) numbers of the stamps; where a segment has fewer, errors and columns of the rest are
        zero.
    counts
        (G, m, k) whether something was measured.
    errors
        (G, m, k).
    columns
        (G, m, k, Q) derivatives, those by coefficients first, then those by the flights' offsets,
        then all others; Q is zero where nothing moved.
    """

    segments: slice
    stamps: NDArray[np.intp]
    counts: NDArray[np.bool_]
    errors: Array
    columns: Array


@dataclass(frozen=True)
class Reading:
    """Clock offsets, gyro biases and range by which a simulation is read at recorded stamps.

    Attributes
    ----------
    offsets
        (offsets, F) s by which each clock's stamps are late: a sample stamped t was taken at
        t - offset; then rad/s by which the gyro reads too much about each axis.
    reference_offset
        (clocks, F) s of clock offset at which signals that jump between samples are read exactly;
        from there to ``offsets`` they move smoothly, for a loss that jumps cannot be minimised.
    rate
        Hz of the log.
    horizon
        Samples that are compared.
    columns
        How many columns the simulation's derivatives have.
    coefficients
        How many of them stand before those by the offsets, in units of `OFFSET_UNIT`; None for no
        columns of offsets.
    """

    offsets: Array
    reference_offset: Array
    rate: float
    horizon: int
    columns: int = 0
    coefficients: int | None = None

    @property
    def total(self) -> int:
        """How many columns residuals have."""
        return self.columns + (0 if self.coefficients is None else len(self.offsets))


def residuals(
    flown: SimulatedChannels, segments: Segments, name: str, reading: Reading
) -> Iterator[Callable[[], Block]]:
    """Yield functions that return one channel's residuals up to the horizon, of some stamps each.

    They may be called side by side. What a clock that is late by a sample of the log or more stamps
    before the simulation begins is not compared.
    """
    measured = segments.measured[name]
    time, values, weight = map(np.asarray, (measured.time, measured.values, measured.weight))
    # column by column: `any` along an axis in the middle takes four times as long
    known = np.logical_or.reduce([*np.moveaxis(weight != 0.0, 1, 0)])
    place, late = time * reading.rate, reading.reference_offset[CLOCK_OF[name]] * reading.rate
    begun = place >= np.where(late < 1.0, 0.0, late)
    used = np.ascontiguousarray(((place < reading.horizon - 1) & begun & known).T)
    most = int(used.sum(axis=1).max(initial=0))
    order = np.argsort(~used, axis=1, kind="stable")[:, :most]
    log, moved_log = _Series(flown.channels[name]), flown.columns[name]
    columns = None if moved_log is None else _Series(moved_log, moved=True)
    together = max(STAMPS_AT_ONCE // max(most, 1), 1)

    def block(first: int, begin: int) -> Block:
        some = slice(first, first + together)
        stamps = order[some, begin : begin + STAMPS_AT_ONCE]
        owners = np.arange(first, first + len(stamps))

        def at(rows: NDArray[Any]) -> NDArray[Any]:
            return rows[stamps, ..., owners[:, None]]

        weights = at(weight) * at(used.T)[..., None]
        place = _Place(owners, at(time), name, reading)
        errors, moved = _compared(name, log, columns, place, at(values))
        errors = errors * weights
        moved *= weights[..., None]
        return Block(some, stamps, weights != 0.0, errors, moved)

    for first in range(0, len(used), together):
        for begin in range(0, most, STAMPS_AT_ONCE):
            yield partial(block, first, begin)


def _compared(
    name: str, log: _Series, columns: _Series | None, place: _Place, recorded: Array
) -> tuple[Array, Array]:
    """Return errors (G, m, k) of a channel in its unit, and their columns (G, m, k, Q)."""
    reading = place.reading
    values = place.read(log)
    by_column = np.empty((*values.shape, reading.total))
    before = reading.columns if reading.coefficients is None else reading.coefficients
    after = before + reading.total - reading.columns
    if columns is not None:
        moved = joined(place.read(columns))
        by_column[..., :before] = moved[..., :before]
        by_column[..., after:] = moved[..., before:]
    if reading.coefficients is not None:
        by_column[..., before:after] = place.by_offset(log) * OFFSET_UNIT
    values = values + place.bias
    if name != "attitude":
        return values - recorded, by_column
    errors, turns = _attitude_error(recorded, values)
    return errors, np.matmul(turns, by_column)


class _Place:
    """Stamps of a channel as fractional sample numbers of a simulation's log."""

    def __init__(
        self, segments: NDArray[np.intp], time: Array, name: str, reading: Reading
    ) -> None:
        self.reading, self.name, self.segments = reading, name, segments[:, None]
        self.clock = CLOCK_OF[name]
        rate = reading.rate
        self.place = (time - reading.offsets[self.clock, segments][:, None]) * rate
        self.before = (time - reading.reference_offset[self.clock, segments][:, None]) * rate
        self.bias: Array | float = 0.0
        if name == "body_rate":
            self.bias = reading.offsets[len(CLOCKS) :, segments].T[:, None]

    def read(self, series: _Series) -> Array:
        """Return the values of a simulation's log at the stamps, (G, m, *rest)."""
        if self.name != "command":
            return series.mixed(self.segments, self.place, lambda share: share)
        # A zero-order hold with a ramp before each jump. A stamp well between two jumps does not
        # move with the clock's offset: only stamps near a jump have information on it.
        held = series.at(self.segments, series.below(self.before))
        if not np.array_equal(self.place, self.before):
            held += series.mixed(self.segments, self.place, _ramp)
            held -= series.mixed(self.segments, self.before, _ramp)
        return held

    def by_offset(self, series: _Series) -> Array:
        """Return the derivatives (G, m, c, offsets) by the offsets, in s and rad/s."""
        below = series.below(self.place)
        slope = series.at(self.segments, below + 1) - series.at(self.segments, below)
        if self.name == "command":
            risen = 1.0 - (1.0 - (self.place - below)) / RAMP_SHARE
            slope = slope * (((risen > 0.0) & (risen < 1.0)) / RAMP_SHARE)[..., None]
        moved = np.zeros((*slope.shape, len(self.reading.offsets)))
        moved[..., self.clock] = -self.reading.rate * slope
        if self.name == "body_rate":
            axes = np.arange(slope.shape[-1])
            moved[..., axes, len(CLOCKS) + axes] = 1.0
        return moved


def _ramp(share: Array) -> Array:
    return np.clip(1.0 - (1.0 - share) / RAMP_SHARE, 0.0, 1.0)


class _Series:
    """A log (F, samples, *rest), or (F, Q, samples, *rest), read at fractional sample numbers.

    These are (G, m), and the values (G, m, *rest), or (G, Q, m, *rest).
    """

    def __init__(self, rows: Array, *, moved: bool = False) -> None:
        self.columns = rows.shape[1] if moved else None
        self.samples, *self.rest = rows.shape[2 if moved else 1 :]
        self.flat = rows.reshape(-1, int(np.prod(self.rest)))

    def below(self, place: Array) -> NDArray[np.intp]:
        return np.clip(np.floor(place + 1e-6).astype(np.intp), 0, self.samples - 2)

    def at(self, segments: NDArray[np.intp], number: NDArray[np.intp]) -> Array:
        if self.columns is not None:
            segments = segments[:, None] * self.columns + np.arange(self.columns)[:, None]
            number = number[:, None]
        row = segments * self.samples + number
        rows: Array = np.take(self.flat, row.ravel(), axis=0)
        return rows.reshape(*row.shape, *self.rest)

    def mixed(
        self, segments: NDArray[np.intp], place: Array, share_of: Callable[[Array], Array]
    ) -> Array:
        """Return values between the samples before and after places."""
        below = self.below(place)
        first, second = self.at(segments, below), self.at(segments, below + 1)
        share = share_of(place - below)
        if self.columns is not None:
            share = share[:, None]
        second -= first
        second *= share.reshape(*share.shape, *[1] * (second.ndim - share.ndim))
        second += first
        return second


def at_stamps(channel: Array, name: str, time: Array, reading: Reading) -> Array:
    """Return the values of a simulated channel (F, samples, c) at recorded stamps (F, n)."""
    place = _Place(np.arange(len(time)), time, name, reading)
    return place.read(_Series(channel)) + place.bias


def _attitude_error(recorded: Array, flown: Array) -> tuple[Array, Array]:
    """Return the rotation vectors (F, n, 3) from recorded to flown, and (F, n, 3, 4) slopes."""
    shape, lanes = flown.shape[:-1], int(np.prod(flown.shape[:-1]))
    given = (recorded.reshape(lanes, 4).T, flown.reshape(lanes, 4).T)
    run = _rotation_program()(given, [np.eye(4)], lanes=lanes)
    return run.values.reshape(*shape, 3), run.columns.reshape(*shape, 3, 4)


@cache
def _rotation_program() -> Program:
    def error(given: tuple[JaxArray, JaxArray], _: Mapping[str, int]) -> JaxArray:
        recorded, flown = map(Quaternion.of, given)
        return recorded.rotation_vector_to(flown).stacked()

    either = Argument((4,), float, lanes=True)
    return Program(
        error,
        (either, replace(either, moves=True)),
        name="attitude error",
        made_of=(),
        packages=CODE,
    )


MAX_DERIVATIVE = 1e6
"""Largest root mean square derivative of a channel by a step of the search, in (scaled) standard
deviations. A tumbling vehicle has a millionfold of it, and linearity ends before any step."""
ROWS_AT_ONCE = 1024
"""Residuals in one call of BLAS: few enough for one thread, so that sums do not depend on their
number."""


def huber_loss(error: Array, limit: float) -> Array:
    """Return Huber's loss of an error: its square, growing linearly beyond a limit."""
    size = np.abs(error)
    beyond = size > limit
    if not beyond.any():
        return error * error
    return np.where(beyond, 2.0 * limit * size - limit * limit, error * error)


@np.errstate(over="ignore", invalid="ignore")  # of chaotic derivatives, which are zeroed as such
def gauss_newton(columns: Array, scaled: Array, scale: Array, huber: float) -> tuple[Array, Array]:
    """Return gradient (F, Q) and Gauss-Newton Hessian (F, Q, Q) of one channel's robust loss.

    Zero where the derivatives exceed `MAX_DERIVATIVE`.

    Parameters
    ----------
    columns
        (F, n, k, Q) derivatives of the unscaled residuals.
    scaled, scale
        (F, n, k) residuals, and the (F,) by which they were divided.
    huber
        As for `huber_loss`.
    """
    segments, size = columns.shape[0], columns.shape[-1]
    root = np.sqrt(huber_weights(scaled, huber))
    rows = columns.reshape(segments, -1, size) * (
        root.reshape(segments, -1, 1) / scale[:, None, None]
    )
    error = (scaled * root).reshape(segments, -1)
    gradient, hessian = np.zeros((segments, size)), np.zeros((segments, size, size))
    for first in range(0, rows.shape[1], ROWS_AT_ONCE):
        some = rows[:, first : first + ROWS_AT_ONCE]
        gradient += np.einsum("fr,frq->fq", error[:, first : first + ROWS_AT_ONCE], some)
        hessian += np.swapaxes(some, 1, 2) @ some
    chaotic = ~is_informative(hessian, rows.shape[1])
    if chaotic.any():
        gradient[chaotic], hessian[chaotic] = 0.0, 0.0
    return gradient, hessian


def is_informative(hessian: Array, rows: int) -> NDArray[np.bool_]:
    """Return whether derivatives are within `MAX_DERIVATIVE`, by Hessians (..., Q, Q) of rows."""
    largest = np.diagonal(hessian, axis1=-2, axis2=-1).max(axis=-1, initial=0.0)
    return np.asarray(largest <= MAX_DERIVATIVE**2 * max(rows, 1))
