"""Recorded signals made ready to be fed in: read at any time, completed, or set to zero."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import ClassVar

import jax
import numpy as np

from sim_jax.inlet import Inlet
from sim_jax.schedule import Schedule
from tuner.config.job import InletName
from tuner.recordings.flight import SIGNALS, Array, Flight, Series
from tuner.recordings.interpolation import body_rate_from, without_gaps

MISSED = 1.5
"""Periods of a loop between two samples beyond which its output was not recorded in full."""


def sparse(flights: Sequence[Flight], signal: str, update_rate: float) -> bool:
    """Return whether a signal was recorded less often than it was computed, at a rate in Hz."""
    gaps = np.concatenate([np.diff(flight.series[signal].time) for flight in flights])
    return bool(np.median(gaps) * update_rate > MISSED)


def zero_order_hold(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that holds until its next sample, at (m,) times in s."""
    columns = []
    for column in series.values.T:
        known = np.isfinite(column)
        place = np.searchsorted(series.time[known], clock + 1e-9, side="right") - 1
        columns.append(column[known][np.maximum(place, 0)])
    return np.column_stack(columns)


def linear_interpolation(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that moves linearly between its samples, at (m,) times in s."""
    columns = []
    for column in series.values.T:
        known = np.isfinite(column)
        columns.append(np.interp(clock, series.time[known], column[known]))
    return np.column_stack(columns)


def reference_points(flight: Flight, length: int) -> list[Array]:
    """Return position, velocity and acceleration, each (3, length), the last point repeated."""
    parts = []
    for name in ("reference_position", "reference_velocity", "reference_acceleration"):
        values = flight.signals.get(name)
        rows = np.zeros((len(flight.time), 3)) if values is None else np.nan_to_num(values)
        parts.append(np.pad(rows, ((0, length - len(rows)), (0, 0)), mode="edge").T)
    return parts


def with_body_rate(flight: Flight) -> Flight:
    """Return a flight with a body rate: the attitude's change, where no gyro was recorded."""
    if flight.has("body_rate"):
        return flight
    turns = flight.series["attitude"]
    rate = body_rate_from(turns.values, np.gradient(turns.values, turns.time, axis=0))
    return replace(flight, series={**flight.series, "body_rate": Series(turns.time, rate)})


def zeroed(flight: Flight, names: Collection[str]) -> Flight:
    """Return a flight whose signals are zero throughout, its attitude level."""
    rows = {name: np.zeros(SIGNALS[name][0]) for name in names}
    if "attitude" in rows:
        rows["attitude"][0] = 1.0
    ends = np.array([0.0, flight.duration])
    signals = {name: np.tile(row, (len(flight.time), 1)) for name, row in rows.items()}
    series = {name: Series(ends, np.tile(row, (2, 1))) for name, row in rows.items()}
    return replace(
        flight, signals={**flight.signals, **signals}, series={**flight.series, **series}
    )


class RecordedInlet(ABC):
    """How recordings feed an inlet of the simulator."""

    name: ClassVar[InletName]
    feeds: ClassVar[type[Inlet]]
    """The simulator's inlet."""
    needs: ClassVar[tuple[str, ...]]
    """Signals that a recording must hold, the characteristic one first."""
    silences: ClassVar[tuple[str, ...]] = ("acceleration",)
    """Channels that are fed in or left out, so that the simulation says nothing about them."""
    ignores: ClassVar[tuple[str, ...]]
    """Parts of a segment's start (`tuner.objective.initial_conditions.STATES`) that do not act."""
    starts_recorded: ClassVar[bool] = True
    """Whether a recording holds all of the state that a window starts from: no integrator."""
    window: ClassVar[float] = 0.5
    """s, length of a window: open loop, attitude strays within a second whatever it is fed."""
    closed_loop: ClassVar[bool] = False
    """Whether the position controller is simulated: it keeps a whole flight to its path, and the
    recording's clock is the reference's rather than the flight controller's."""
    bypasses: ClassVar[tuple[str, ...]] = ()
    """Coefficients of the stages upstream, of which the simulation then says nothing."""
    frees: ClassVar[tuple[str, ...]] = ()
    """Coefficients that are free besides the usual ones: what no loop takes out by itself."""
    terms: ClassVar[tuple[str, ...]] = ()
    """Groups of terms that are free from the beginning where the job leaves the choice."""
    has_mixer: ClassVar[bool] = False
    """Whether the mixer, which is that of a quad X, is simulated."""
    remedy: ClassVar[str] = "use inlet: auto"
    """What to do where a signal is missing."""

    def fed(self, flight: Flight) -> tuple[str, ...]:
        """Return the signals without which a stretch of a flight cannot be simulated."""
        del flight
        return () if self.closed_loop else self.needs

    def bypassed(self, flight: Flight) -> frozenset[str]:
        """Return the coefficients of which the simulation of a flight says nothing."""
        del flight
        return frozenset(self.bypasses)

    def can_be_fed(self, flight: Flight) -> bool:
        """Return whether a flight holds every column of what the inlet needs."""
        return all(
            flight.has(signal) and bool(np.isfinite(flight.signals[signal]).any(axis=0).all())
            for signal in self.needs
        )

    def is_preferred(self, flight: Flight) -> bool:
        """Return whether ``auto`` takes this inlet, if no inlet upstream of it is preferred."""
        return self.can_be_fed(flight)

    def update_rate(self, schedule: Schedule) -> float | None:
        """Return the Hz at which the flight controller computes the signal; None if measured."""
        del schedule
        return None

    @abstractmethod
    def lay(self, flights: Sequence[Flight], schedule: Schedule) -> Inlet:
        """Lay what was recorded side by side; after its end the last value holds.

        Set-points and commands hold until the loop that computes them runs again. Where they were
        recorded less often than that, they are taken to move steadily from one sample to the next:
        a zero-order hold would make them late.

        Parameters
        ----------
        flights
            F segments.
        schedule
            All but the reference enter at its ``physics_rate``.
        """

    def trimmed(self, inlet: Inlet, trim: Sequence[jax.Array]) -> Inlet:
        """Return the simulator's inlet with a steady difference (F,) of each rotor."""
        del trim
        return inlet

    def _resampled(self, signal: str, flights: Sequence[Flight], schedule: Schedule) -> list[Array]:
        """Return a signal's columns, each (steps, F), at the physics rate."""
        longest = max(flight.duration for flight in flights)
        steps = int(np.ceil(longest * schedule.physics_rate)) + 2
        clock, rate = np.arange(steps) / schedule.physics_rate, self.update_rate(schedule)
        moves = rate is None or sparse(flights, signal, rate)
        read = linear_interpolation if moves else zero_order_hold
        table = np.stack(
            [read(without_gaps(flight.series[signal]), clock) for flight in flights], axis=-1
        )
        return [np.asarray(table[:, column]) for column in range(table.shape[1])]
