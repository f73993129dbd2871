"""Recorded signals that are fed into the simulated loop.

Each inlet of the simulator (`sim_jax.inlet`) has one class here, a `RecordedInlet`: the signals it
needs, the channels that are then not compared, and the layout of its input. An inlet is added by
one more class; `INLETS` lists them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from sim_jax.control.geometric import ReferencePoint
from sim_jax.control.mixer import ROTORS
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import (
    ActuatorInlet,
    AttitudeInlet,
    BodyRateInlet,
    Inlet,
    MixedInlet,
    ReferenceInlet,
    RotorSpeedInlet,
)
from sim_jax.schedule import Schedule
from tuner.config import InletName
from tuner.core.numerics import Array
from tuner.recordings.flight import SIGNALS, Flight, Series
from tuner.recordings.interpolation import body_rate_from, with_gaps_filled
from tuner.vehicle import COEFFICIENTS, term_groups
from tuner.vehicle.coefficient import LoopPart

MAX_PERIODS = 1.5
"""Largest median gap, in periods of a loop, of an output that was recorded in full."""
MIN_SHARE_SEEN = 0.95
"""Least share of a loop's runs that a log sees, and of changes that agree with its period."""
TICKS_S, MAX_PHASES = 0.25, 64
"""s for which the clocks of a log and a loop keep their phase, and the phases that are tried."""


def is_sparse(flights: Sequence[Flight], signal: str, update_rate: float) -> bool:
    """Return whether a signal was recorded less often than it was computed, at a rate in Hz."""
    gaps = np.concatenate([np.diff(flight.series[signal].time) for flight in flights])
    return bool(np.median(gaps) * update_rate > MAX_PERIODS)


def at_ticks(series: Series, update_rate: float) -> Series:
    """Return a held signal (n, k), computed at a rate in Hz, with its changes when the loop ran.

    A log on another clock sees a change up to a sample late, which is noise in what is fed in. The
    loop ran between two samples, and once a period: that tells when. In step, it ran at the sample.
    A log that does not see every run, or contradicts the period, keeps its stamps.
    """
    period, time = 1.0 / update_rate, series.time
    if len(time) < 2 or series.rate < MIN_SHARE_SEEN * update_rate:
        return series
    rows = np.append(0, 1 + np.flatnonzero(np.any(np.diff(series.values, axis=0) != 0.0, axis=1)))
    ticks, gaps = time[rows], np.diff(time, prepend=time[0] - period)[rows]
    for part in np.array_split(np.arange(len(rows)), 1 + int((time[-1] - time[0]) / TICKS_S)):
        phases = np.unique(np.round(ticks[part] % period, 7))
        phases = phases[:: 1 + len(phases) // MAX_PHASES]
        ages = np.maximum((ticks[part] - phases[:, None] + 1e-7) % period - 1e-7, 0.0)
        seen = ages < gaps[part] - 1e-7
        best = int(np.argmax(seen.mean(axis=1))) if len(part) else 0
        if len(part) and seen[best].mean() > MIN_SHARE_SEEN:
            ticks[part] -= np.where(seen[best], ages[best], 0.0)
    return Series(ticks, series.values[rows])


def _by_column(series: Series, read: Callable[[Array, Array], Array]) -> Array:
    """Return what ``read`` makes of the times and values of each column's known samples, (m, k)."""
    known = np.isfinite(series.values.T)
    columns = zip(series.values.T, known, strict=True)
    return np.column_stack([read(series.time[there], column[there]) for column, there in columns])


def zero_order_hold(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that holds until its next sample, at (m,) times in s."""

    def read(time: Array, values: Array) -> Array:
        place = np.searchsorted(time, clock + 1e-9, side="right") - 1
        return values[np.maximum(place, 0)]

    return _by_column(series, read)


def linear_interpolation(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that moves linearly between its samples, at (m,) times in s."""
    return _by_column(series, lambda time, values: np.interp(clock, time, values))


def mean_of_hold(series: Series, clock: Array) -> Array:
    """Return the mean (m, k) of a held signal (n, k) from each of (m + 1,) times in s to the next.

    The integral of a signal that holds until its next sample is linear between samples.
    """

    def read(time: Array, values: Array) -> Array:
        ends = np.array([min(time[0], clock[0]), *time[1:], max(time[-1], clock[-1])])
        total = np.concatenate([[0.0], np.cumsum((values - values[0]) * np.diff(ends))])
        return np.asarray(values[0] + np.diff(np.interp(clock, ends, total)) / np.diff(clock))

    return _by_column(series, read)


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
    rows = {name: np.zeros(SIGNALS[name].columns) for name in names}
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
    needs: ClassVar[tuple[str, ...]]
    """Signals that a recording must hold, the characteristic one first."""
    not_compared: ClassVar[tuple[str, ...]] = ("acceleration",)
    """Channels that are fed in or left out, so that the simulation says nothing about them."""
    ignores: ClassVar[tuple[str, ...]]
    """Parts of a segment's start (`tuner.objective.initial_conditions.STATES`) without effect."""
    starts_recorded: ClassVar[bool] = True
    """Whether a recording has the whole initial state of a window: it has no integrator."""
    window: ClassVar[float] = 0.5
    """s, length of a window: in open loop attitude diverges within a second."""
    closed_loop: ClassVar[bool] = False
    """Whether the position controller is simulated: it keeps a whole flight to its path, and the
    recording's clock is the reference's rather than the flight controller's."""
    replaces: ClassVar[tuple[LoopPart, ...]] = ()
    """Parts of the loop that the input replaces."""
    frees: ClassVar[tuple[str, ...]] = ()
    """Coefficients that are free besides the usual ones: no loop compensates them here."""
    terms: ClassVar[tuple[str, ...]] = ()
    """Groups of terms that are free from the start, if the job leaves the choice."""
    computed_at: ClassVar[str | None] = None
    """The rate of a `Schedule` at which the flight controller computes the signal."""
    remedy: ClassVar[str] = "use inlet: auto"
    """What to do where a signal is missing."""

    def fed(self, flight: Flight) -> tuple[str, ...]:
        """Return the signals without which a stretch of a flight cannot be simulated."""
        del flight
        return () if self.closed_loop else self.needs

    @property
    def bypasses(self) -> frozenset[str]:
        """The coefficients of the replaced parts, which then have no effect."""
        return frozenset(n for n, row in COEFFICIENTS.items() if row.part in self.replaces)

    def bypassed(self, flight: Flight) -> frozenset[str]:
        """Return the coefficients without effect on the simulation of a flight."""
        del flight
        return self.bypasses

    def can_be_fed(self, flight: Flight) -> bool:
        """Return whether a flight has every column of the signals that the inlet needs."""
        return all(
            flight.has(signal) and bool(np.isfinite(flight.signals[signal]).any(axis=0).all())
            for signal in self.needs
        )

    def is_preferred(self, flight: Flight) -> bool:
        """Return whether ``auto`` takes this inlet, if no inlet upstream of it is preferred."""
        return self.can_be_fed(flight)

    def update_rate(self, schedule: Schedule) -> float | None:
        """Return the Hz at which the flight controller computes the signal; None if measured."""
        return None if self.computed_at is None else float(getattr(schedule, self.computed_at))

    @abstractmethod
    def lay_out(self, flights: Sequence[Flight], schedule: Schedule) -> Inlet:
        """Return the recorded input of several flights; after its end the last value holds.

        Set-points and commands hold until the loop that computes them runs again. Where they were
        recorded less often than that, they are interpolated linearly: a zero-order hold would delay
        them.

        Parameters
        ----------
        flights
            F segments.
        schedule
            All but the reference enter at its ``physics_rate``.
        """

    def _resampled(
        self, signal: str, flights: Sequence[Flight], schedule: Schedule, *, mean: bool = False
    ) -> list[Array]:
        """Return a signal's columns, each (steps, F), at the physics steps or its mean over them.

        A signal that acts all through a step has to be fed by its mean: it changes within steps,
        and what is read where a step begins acts late, by half a step on average. Set-points are
        published after the tick that computes them: they change at the nearest step, not a step
        later.
        """
        longest = max(flight.duration for flight in flights)
        steps = int(np.ceil(longest * schedule.physics_rate)) + 2
        clock, rate = np.arange(steps) / schedule.physics_rate, self.update_rate(schedule)
        recorded = [with_gaps_filled(flight.series[signal]) for flight in flights]
        if rate is None or is_sparse(flights, signal, rate):
            clock = clock + mean * 0.5 * schedule.step
            tables = [linear_interpolation(series, clock) for series in recorded]
        else:
            read, half = mean_of_hold if mean else zero_order_hold, 0.5 * schedule.step
            clock = np.append(clock, steps / schedule.physics_rate) if mean else clock + half
            tables = [read(at_ticks(series, rate), clock) for series in recorded]
        table = np.stack(tables, axis=-1)
        return [np.asarray(table[:, column]) for column in range(table.shape[1])]


STEADY_TORQUE = ("torque_trim_x", "torque_trim_y", "torque_trim_z")
"""Trims of recorded inputs: as rotors differ and the mass is off centre, these hold a steady torque
that turns nothing."""
DAMPING_TERMS = ("linear_drag", "angular_drag", "flapping_moment", "thrust_inflow")
"""Groups of terms of aerodynamic damping, free from the start in open loop: without them the torque
of the recorded inputs would be biased to make up for it."""


class RecordedReference(RecordedInlet):
    """The reference trajectory: the whole loop is simulated."""

    name = "reference"
    needs = ("reference_position",)
    ignores = ("trim",)
    starts_recorded = False
    window = 1.0
    closed_loop = True
    remedy = "name its trajectory in the job file"

    def is_preferred(self, flight: Flight) -> bool:
        """Return whether the reference has velocities, and the controller commands no torques.

        Set-points without velocities belong to another controller, and one that commands torques is
        not PX4's: they are used on request only.
        """
        foreign = flight.has("commanded_torque")
        return self.can_be_fed(flight) and flight.has("reference_velocity") and not foreign

    def lay_out(self, flights: Sequence[Flight], schedule: Schedule) -> ReferenceInlet:
        """Lay the reference out tick by tick, its last point repeated."""
        del schedule
        length = max(len(flight.time) for flight in flights)
        columns = [reference_points(flight, length) for flight in flights]
        position, velocity, acceleration = (
            Vec3.of(np.stack([c[part] for c in columns], axis=-1)) for part in range(3)
        )
        spins = [flight.yaw_rate_setpoint for flight in flights]
        return ReferenceInlet(
            ReferencePoint(position, velocity, acceleration),
            spins=np.asarray([spin is not None for spin in spins]),
            yaw_rate=np.asarray([spin or 0.0 for spin in spins]),
            level_held=np.asarray([flight.level_held for flight in flights]),
        )


class RecordedBodyRate(RecordedInlet):
    """Rate and thrust set-points, from the rate controller on."""

    name = "body_rate"
    needs = ("rate_setpoint", "thrust_setpoint")
    replaces = ("estimate",)
    ignores = ("trim",)
    starts_recorded = False
    window = 1.0
    computed_at = "position_control_rate"

    def lay_out(self, flights: Sequence[Flight], schedule: Schedule) -> BodyRateInlet:
        """Lay both set-points out step by step."""
        (thrust,) = self._resampled("thrust_setpoint", flights, schedule)
        return BodyRateInlet(Vec3(*self._resampled("rate_setpoint", flights, schedule)), thrust)


class RecordedCommand(RecordedInlet):
    """Motor commands, from the motors on."""

    name = "actuator"
    needs = ("command",)
    not_compared = ("command", "acceleration")
    replaces = ("estimate", "rate control")
    frees = STEADY_TORQUE
    terms = DAMPING_TERMS
    ignores = ("rate_integral",)
    computed_at = "rate_control_rate"

    def lay_out(self, flights: Sequence[Flight], schedule: Schedule) -> ActuatorInlet:
        """Lay the commands out step by step."""
        return ActuatorInlet(tuple(self._resampled("command", flights, schedule, mean=True)))


class RecordedRotorSpeed(RecordedInlet):
    """Measured rotor speeds, into the aerodynamics."""

    name = "rotor_speed"
    needs = ("rotor_speed",)
    not_compared = ("command", "rotor_speed", "acceleration")
    replaces = ("estimate", "rate control", "motors", "tachometer")
    frees = STEADY_TORQUE
    terms = DAMPING_TERMS
    ignores = ("rotor_speed", "rate_integral")

    def lay_out(self, flights: Sequence[Flight], schedule: Schedule) -> RotorSpeedInlet:
        """Lay the speeds out step by step."""
        return RotorSpeedInlet(tuple(self._resampled("rotor_speed", flights, schedule)))


class _RecordedThrust(RecordedInlet):
    """Thrust set-points as commands that are the same for all rotors: a drive, no inlet."""

    name = "attitude"
    needs = ("thrust_setpoint",)
    ignores = ()
    computed_at = "position_control_rate"

    def lay_out(self, flights: Sequence[Flight], schedule: Schedule) -> ActuatorInlet:
        """Lay the set-points out step by step, for each of four rotors."""
        (thrust,) = self._resampled("thrust_setpoint", flights, schedule, mean=True)
        return ActuatorInlet((thrust,) * ROTORS)


class RecordedAttitude(RecordedInlet):
    """Recorded attitude and body rate, with rotor signals for the thrust alone.

    For recordings whose commands do not explain the turning: logged too seldom, by another mixer,
    or not at all. The accelerometer, where recorded, is a channel.
    """

    name = "attitude"
    needs = ("attitude",)
    not_compared = ("attitude", "body_rate", "command", "rotor_speed")
    replaces = ("estimate", "rate control", "turning", "tachometer")
    ignores = ("attitude", "body_rate", "rate_integral", "trim")
    starts_recorded = False
    window = 1.0
    remedy = "record motor commands, rotor speeds or thrust set-points beside the pose"

    #: Signals that drive the rotors, the most direct first.
    DRIVES: ClassVar[tuple[RecordedInlet, ...]] = (
        RecordedRotorSpeed(),
        RecordedCommand(),
        _RecordedThrust(),
    )

    def can_be_fed(self, flight: Flight) -> bool:
        """Return whether a flight has its attitude and a signal that drives the rotors."""
        return super().can_be_fed(flight) and any(d.can_be_fed(flight) for d in self.DRIVES)

    def drive(self, flight: Flight) -> RecordedInlet:
        """Return the recorded inlet that drives the rotors of a flight."""
        return next(drive for drive in self.DRIVES if drive.can_be_fed(flight))

    def fed(self, flight: Flight) -> tuple[str, ...]:
        """Return the attitude and the signals that drive the rotors."""
        return (*self.needs, *self.drive(flight).needs)

    def bypassed(self, flight: Flight) -> frozenset[str]:
        """Return the coefficients of turning, and of the motors where rotor speeds are fed in."""
        return self.bypasses | self.drive(flight).bypassed(flight)

    def lay_out(self, flights: Sequence[Flight], schedule: Schedule) -> AttitudeInlet:
        """Lay attitudes, body rates and rotor signals out step by step."""
        with_rate = [with_body_rate(flight) for flight in flights]
        attitude = np.stack(self._resampled("attitude", flights, schedule))
        return AttitudeInlet(
            Quaternion.of(attitude).normalized(),
            Vec3(*self._resampled("body_rate", with_rate, schedule)),
            inlet_of([self.drive(flight) for flight in flights], flights, schedule),
        )


#: Every inlet, the upstream ones first.
INLETS: Mapping[InletName, RecordedInlet] = {
    inlet.name: inlet
    for inlet in (
        RecordedReference(),
        RecordedBodyRate(),
        RecordedCommand(),
        RecordedRotorSpeed(),
        RecordedAttitude(),
    )
}


def bypassed_by(names: Sequence[InletName], flights: Sequence[Flight]) -> frozenset[str]:
    """Return the coefficients without effect on any flight, each with its own inlet."""
    pairs = zip(names, flights, strict=True)
    return frozenset.intersection(*(INLETS[name].bypassed(flight) for name, flight in pairs))


def also_free_by(names: Collection[InletName], *, terms: bool) -> frozenset[str]:
    """Return the coefficients that all of some inlets free besides the usual ones.

    Parameters
    ----------
    names
        Of the inlets.
    terms
        Whether those of terms beyond the motor model are among them.
    """
    groups = term_groups()
    of_inlet = [
        {
            *INLETS[name].frees,
            *(member for g in INLETS[name].terms if terms for member in groups[g]),
        }
        for name in names
    ]
    return frozenset(set.intersection(*of_inlet))


def window_seconds(names: Collection[InletName], given: float | None) -> float:
    """Return the s of the windows of some inlets: those given, or the longest of their own."""
    return max(INLETS[name].window for name in names) if given is None else given


def inlet_of(
    recorded: Sequence[RecordedInlet], flights: Sequence[Flight], schedule: Schedule
) -> Inlet:
    """Return the input of all segments, each by its own of F recorded inlets.

    Flights and schedule are as of `RecordedInlet.lay_out`.
    """
    used = list(dict.fromkeys(recorded))
    if len(used) == 1:
        return used[0].lay_out(flights, schedule)
    parts = []
    for inlet in used:
        example = flights[recorded.index(inlet)]
        feeding = [
            flight if own is inlet else zeroed(flight, {*inlet.needs, *inlet.fed(example)})
            for own, flight in zip(recorded, flights, strict=True)
        ]
        parts.append(inlet.lay_out(feeding, schedule))
    return MixedInlet(tuple(parts), np.asarray([used.index(inlet) for inlet in recorded]))
