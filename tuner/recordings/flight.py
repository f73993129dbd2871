"""A recorded flight: its signals on their own clocks, and on one uniform clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array, finite_rows
from tuner.recordings.notes import Damage, Note


class Signal(NamedTuple):
    """A signal that a flight can hold.

    Attributes
    ----------
    columns
        Their number.
    interpolation
        ``linear``, along an ``arc``, or ``hold`` until the next sample.
    range
        A value beyond it is a corrupt sample.
    axes
        Of its columns: ``world`` (ENU), ``body`` (FLU), ``attitude`` for a quaternion
        (w, x, y, z) from body to world, or none.
    """

    columns: int
    unit: str
    interpolation: Literal["linear", "arc", "hold"]
    range: tuple[float, float]
    axes: Literal["world", "body", "attitude", ""] = ""


SIGNALS: Mapping[str, Signal] = {
    "position": Signal(3, "m", "linear", (-1e5, 1e5), "world"),
    "velocity": Signal(3, "m/s", "linear", (-1e3, 1e3), "world"),
    "attitude": Signal(4, "", "arc", (-1e3, 1e3), "attitude"),
    "body_rate": Signal(3, "rad/s", "linear", (-1e4, 1e4), "body"),
    "acceleration": Signal(3, "m/s^2", "linear", (-1e4, 1e4), "body"),
    # in revolutions a minute, if nothing says the unit
    "rotor_speed": Signal(4, "rad/s", "linear", (0.0, 100_000.0)),
    # an ESC that is off gets less than its first step
    "command": Signal(4, "", "hold", (-0.025, 1.02)),
    "attitude_setpoint": Signal(4, "", "hold", (-1e3, 1e3), "attitude"),
    "rate_setpoint": Signal(3, "rad/s", "hold", (-1e4, 1e4), "body"),
    "thrust_setpoint": Signal(1, "", "hold", (-0.02, 1.02)),
    "commanded_thrust": Signal(1, "N", "hold", (-1e4, 1e4)),
    "commanded_torque": Signal(3, "N m", "hold", (-1e4, 1e4), "body"),
    "reference_position": Signal(3, "m", "hold", (-1e5, 1e5), "world"),
    "reference_velocity": Signal(3, "m/s", "hold", (-1e3, 1e3), "world"),
    "reference_acceleration": Signal(3, "m/s^2", "hold", (-1e4, 1e4), "world"),
    "lap": Signal(1, "", "hold", (-1e6, 1e6)),
    # nothing flies on less: a meter that was not read
    "battery_voltage": Signal(1, "V", "linear", (1.0, 100.0)),
}


@dataclass(frozen=True)
class RawSeries:
    """One signal as recorded, its samples in any order.

    Attributes
    ----------
    time
        (n,) s.
    values
        (n, k) in any unit; NaN where a column was not measured (a rotor without tachometer).
    """

    time: Array
    values: Array

    def where(self, kept: NDArray[np.bool_]) -> Self:
        """Return the samples with true flags (n,)."""
        return replace(self, time=self.time[kept], values=self.values[kept])

    def complete(self) -> Self:
        """Return the samples of which all columns were measured."""
        return self.where(finite_rows(self.values))

    def column(self, number: int) -> tuple[Array, Array]:
        """Return times and values, (m,) each, of the measured samples of a column."""
        measured = np.isfinite(self.values[:, number])
        return self.time[measured], self.values[measured, number]


@dataclass(frozen=True)
class Series(RawSeries):
    """One recorded signal, cleaned, on its own clock.

    Its time is in s since the start of the mission, negative before it, and strictly increasing;
    its values are in the unit of `SIGNALS`.
    """

    def __post_init__(self) -> None:
        if self.time.ndim != 1 or self.values.ndim != 2 or len(self.time) != len(self.values):
            raise ValueError(f"time {self.time.shape} and values {self.values.shape} do not match")
        if len(self.time) > 1 and not (self.time[1:] > self.time[:-1]).all():
            raise ValueError("time is not strictly increasing")

    @property
    def rate(self) -> float:
        """Hz, the median; 0 of a single sample."""
        return 1.0 / float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    def between(self, start: float, end: float, *, origin: float = 0.0) -> Series:
        """Return the samples from one time to another, in s, both included, since an origin."""
        inside = slice(self.time.searchsorted(start), self.time.searchsorted(end, "right"))
        return Series(self.time[inside] - origin, self.values[inside].copy())


@dataclass(frozen=True)
class InitialState:
    """The vehicle at the start of the mission, smoothed from the recording there.

    Attributes
    ----------
    position, velocity
        (3,) m and m/s, world ENU.
    attitude
        (4,) unit quaternion (w, x, y, z), body to world.
    body_rate
        (3,) rad/s, body FLU.
    rotor_speed
        (4,) rad/s; NaN where it was not measured.
    command
        (4,) motor command 0..1; NaN where it was not recorded.
    """

    position: Array
    velocity: Array
    attitude: Array
    body_rate: Array
    rotor_speed: Array
    command: Array


@dataclass(frozen=True)
class Flight:
    """One mission of one recording.

    Attributes
    ----------
    name
        File name without its suffix.
    path, sha256
        The recording's file, and the digest of its content.
    rate
        Hz of the uniform clock.
    time
        (N,) seconds since the start of the mission, uniform, from 0.
    signals
        Signal name -> (N, k) on the uniform clock, NaN where nothing was recorded. Vectors are
        interpolated linearly, quaternions along the shortest arc, set-points hold.
    series
        Signal name -> the cleaned samples on their own stamps, from up to two seconds before the
        mission to its end.
    initial
        The vehicle at time 0.
    yaw_rate_setpoint
        rad/s of a yaw spin, recognised by its rate set-points; None for a position mission.
    level_held
        Whether roll, pitch and position were controlled during a yaw spin.
    trajectory
        Name and parameters of the trajectory from a side-car, where no reference was recorded.
    notes
        Samples that were dropped or repaired, and signals that are doubted.
    damage
        What a broken file has lost; the flight holds the rest.
    """

    name: str
    path: str
    sha256: str
    rate: float
    time: Array
    signals: Mapping[str, Array]
    series: Mapping[str, Series]
    initial: InitialState
    yaw_rate_setpoint: float | None = None
    level_held: bool = False
    trajectory: Mapping[str, object] | None = None
    notes: tuple[Note, ...] = ()
    damage: tuple[Damage, ...] = ()

    @property
    def duration(self) -> float:
        """Seconds from the start of the mission to the last sample of the uniform clock."""
        return float(self.time[-1])

    @property
    def spins_freely(self) -> bool:
        """Whether it is a yaw spin in which nothing holds position, roll and pitch."""
        return self.yaw_rate_setpoint is not None and not self.level_held

    @property
    def has_tachometers(self) -> bool:
        """Whether every rotor has a tachometer."""
        speeds = self.series.get("rotor_speed")
        return speeds is not None and bool(np.isfinite(speeds.values).any(axis=0).all())

    def until(self, seconds: float) -> Flight:
        """Return the flight up to a time in s since its start."""
        inside = self.time <= seconds
        return replace(
            self,
            time=self.time[inside],
            signals={name: rows[inside] for name, rows in self.signals.items()},
            series={name: rows.between(-np.inf, seconds) for name, rows in self.series.items()},
        )

    def has(self, signal: str) -> bool:
        """Return whether any sample of a signal was recorded."""
        return signal in self.signals and bool(np.isfinite(self.signals[signal]).any())
