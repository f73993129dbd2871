"""Compare recordings with simulations of any number of vehicles at the recorded stamps.

Simulation, interpolation at the stamps (`tuner.objective.residuals`) and segments are those of the
fit: whole flights if the reference is the input, windows otherwise. A simulation fed with motor
commands, rotor speeds or rate set-points drifts away within seconds whatever its coefficients; over
a window its error measures them. A window starts from the recorded state, so that its end is a
prediction. The error from the most likely start and trim of a vehicle is reported separately.

Errors are simulated minus recorded.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim_jax.state import AIRBORNE
from tuner.config import InletName
from tuner.core.numerics import Array
from tuner.evaluate.closed_loop import Forces, forces_of_terms
from tuner.evaluate.records import RMSE_UNITS, AxesRmse, RmseRow, RmseTable
from tuner.evaluate.simulation_files import roll_pitch_yaw
from tuner.objective.battery import ROTOR_LAG_S, with_reference_voltage
from tuner.objective.criterion import Point, units_of
from tuner.objective.inlets import INLETS, window_seconds
from tuner.objective.normal_equations import Objective
from tuner.objective.residuals import Reading, at_stamps
from tuner.objective.segments import (
    CLOCKS,
    OFFSETS,
    Segments,
    commanded_before,
    cut_windows,
    noise_of,
    segments_of,
    window_segments,
)
from tuner.objective.simulation import (
    BODY_ATTITUDE,
    MOTION,
    TRUE_ROTOR_SPEED,
    SimulatedChannels,
    fly,
)
from tuner.objective.space import Space
from tuner.objective.windows import Window
from tuner.recordings.flight import Flight
from tuner.search.job_flights import JobFlight
from tuner.search.optimisers import MAX_STATE_SD
from tuner.search.problem import limits_of
from tuner.search.progress import plain_criterion
from tuner.vehicle import ControllerFile, VehicleFile, check_rotors
from tuner.vehicle.model import Model, model_of, schedule_of

Pose = Literal["position", "attitude"]


@dataclass(frozen=True)
class SignalErrors:
    """One recorded signal and the error of its simulation.

    Attributes
    ----------
    time
        (n,) s since the mission's start.
    recorded
        (n, 3) m, world, or degrees of roll, pitch, yaw.
    error
        (n, 3) simulated minus recorded in the same unit; angles within ±180 degrees.
    """

    time: Array
    recorded: Array
    error: Array

    def between(self, start: float, end: float) -> SignalErrors:
        """Return the samples from ``start`` in s to before ``end``."""
        inside = (self.time >= start) & (self.time < end)
        return SignalErrors(self.time[inside], self.recorded[inside], self.error[inside])

    @property
    def simulated(self) -> Array:
        """(n, 3) simulated values; angles are near the recorded ones rather than within ±180."""
        return self.recorded + self.error


@dataclass(frozen=True)
class FlightErrors:
    """The errors of one flight with one vehicle.

    Attributes
    ----------
    position
        In m.
    attitude
        In degrees of roll, pitch, yaw.
    laps
        (k,) s at which laps were completed.
    crash_time
        s; None for a flight that did not crash.
    forces
        Force and moment of each term along the simulation, until a crash.
    """

    position: SignalErrors
    attitude: SignalErrors
    laps: Array
    crash_time: float | None
    forces: Forces | None = None

    def between(self, start: float, end: float) -> FlightErrors:
        """Return the errors from ``start`` in s to before ``end``."""
        position, attitude = self.position.between(start, end), self.attitude.between(start, end)
        return FlightErrors(position, attitude, self.laps, self.crash_time)

    @property
    def rmse(self) -> AxesRmse:
        """The RMSE of all six axes; None for a crash."""
        return rmse_of([self])


def rmse_of(flights: Sequence[FlightErrors]) -> AxesRmse:
    """Return the RMSE over all samples of some flights; None if one crashed."""
    if any(flight.crash_time is not None for flight in flights):
        return AxesRmse(**dict.fromkeys(RMSE_UNITS))
    values = [
        *_root_mean_square(np.concatenate([flight.position.error for flight in flights])),
        *_root_mean_square(np.concatenate([flight.attitude.error for flight in flights])),
    ]
    return AxesRmse(**dict(zip(RMSE_UNITS, values, strict=True)))


def _root_mean_square(errors: Array) -> list[float | None]:
    columns = [column[np.isfinite(column)] for column in errors.T]
    return [float(np.sqrt(np.mean(c**2))) if len(c) else None for c in columns]


def concatenate(parts: Sequence[SignalErrors]) -> SignalErrors:
    """Return the errors of successive stretches of one signal as one."""
    return SignalErrors(
        *(
            np.concatenate([getattr(part, field) for part in parts])
            for field in ("time", "recorded", "error")
        )
    )


def wrap_degrees(degrees: Array) -> Array:
    """Return angles in degrees, wrapped to ±180."""
    return (degrees + 180.0) % 360.0 - 180.0


def laps_of(flight: Flight) -> Array:
    """Return the (k,) times in s at which the lap counter rose within the mission."""
    series = flight.series.get("lap")
    if series is None:
        return np.zeros(0)
    count = series.values[:, 0]
    rises: NDArray[np.bool_] = np.diff(count, prepend=0.0) > 0
    inside = rises & (series.time > 0) & (series.time <= flight.duration)
    return series.time[inside]


POSE = ("position", "attitude")
WINDOW_MARGIN_S = 0.02
"""Windows are simulated so much longer, for late stamps."""
MISFIT_SCALE = 10.0
"""Residuals are divided by so many times the noise when starts are estimated, so that the model's
errors hardly move them."""
FORCES_RATE_HZ = 50.0
"""Forces are only plotted, so that a lower rate than the log's will do."""
GAUSS_NEWTON_STEPS = 3


class Comparison:
    """Recordings as segments, for comparison with any number of vehicles.

    Parameters
    ----------
    recordings
        At least one. Their clock offsets are taken as known (`with_known` of
        `tuner.search.job_flights`); unknown ones are zero.
    window
        s, length of the windows of flights that are not simulated in a closed loop; None takes
        that of their inlet.

    Raises
    ------
    RecordingError
        A flight lacks a signal that its inlet needs.
    """

    def __init__(
        self,
        recordings: Sequence[JobFlight],
        controller: ControllerFile,
        *,
        window: float | None = None,
    ) -> None:
        self._names = [recording.flight.name for recording in recordings]
        by_inlet: dict[InletName, list[JobFlight]] = {}
        for recording in recordings:
            by_inlet.setdefault(recording.inlet, []).append(recording)
        self._groups = [
            _Group(members, controller, inlet, window_seconds([inlet], window))
            for inlet, members in by_inlet.items()
        ]

    def fly(
        self,
        vehicle: VehicleFile,
        *,
        fitted_starts: bool = False,
        forces: bool = False,
        flier: Callable[..., SimulatedChannels] = fly,
    ) -> dict[str, FlightErrors]:
        """Return flight name to its errors with a vehicle, in the recordings' order.

        Parameters
        ----------
        fitted_starts
            Whether to return flights in windows only, from the most likely starts and trims,
            fitted to each window: the error of a fit, not of a prediction.
        forces
            Whether to return what each term does.
        flier
            Function that flies segments, for another simulator.

        Raises
        ------
        ConfigError
            The vehicle has rotors that the mixer above an inlet cannot fly.
        """
        errors: dict[str, FlightErrors] = {}
        for group in self._groups:
            if group.windowed or not fitted_starts:
                errors |= group.fly(
                    vehicle, fitted_starts=fitted_starts, forces=forces, flier=flier
                )
        return {name: errors[name] for name in self._names if name in errors}


class _Group:
    """The recordings with one inlet, flown side by side."""

    def __init__(
        self,
        recordings: Sequence[JobFlight],
        controller: ControllerFile,
        inlet: InletName,
        seconds: float,
    ) -> None:
        self._recordings, self._controller = tuple(recordings), controller
        self._schedule = schedule_of(controller)
        self._inlet, self._seconds = inlet, seconds
        self.windowed = not INLETS[inlet].closed_loop
        self._stride = max(1, round(self._schedule.log_rate / FORCES_RATE_HZ))
        rate, flights = self._schedule.log_rate, [recording.flight for recording in recordings]
        if self.windowed:
            self._segments, pieces = self._window_segments(free_starts=False)
            self._windows = [
                tuple(piece for piece in pieces if piece.number == number)
                for number in range(len(flights))
            ]
            self._samples, self._limits = math.ceil((seconds + WINDOW_MARGIN_S) * rate), AIRBORNE
        else:
            self._windows = [(Window(flight, 0.0),) for flight in flights]
            self._segments = segments_of(
                flights, noise=dict.fromkeys(POSE, 1.0), schedule=self._schedule
            )
            longest = max(flight.duration for flight in flights)
            self._samples, self._limits = math.ceil(longest * rate) + 2, limits_of(flights)
        late = np.array([recording.time_offset or 0.0 for recording in recordings])
        self._stamp_delays = late[np.asarray(self._segments.flight)]
        names = sorted({name for recording in recordings for name in recording.conditions})
        self._conditions = {
            name: np.array([recording.conditions.get(name, 0.0) for recording in recordings])
            for name in names
        }

    def _window_segments(self, *, free_starts: bool) -> tuple[Segments, list[Window]]:
        """Return the windows, with starts as recorded or, if free, near them."""
        flights = [recording.flight for recording in self._recordings]
        inlets = [self._inlet] * len(flights)
        pieces = cut_windows(
            flights,
            inlets=inlets,
            seconds=self._seconds,
            free_starts=free_starts,
            input_late={r.flight.name: r.input_late for r in self._recordings},
        )
        segments = window_segments(
            flights,
            pieces,
            inlets=inlets,
            schedule=self._schedule,
            lag=ROTOR_LAG_S,
            noise=noise_of(flights),
            free_starts=free_starts,
        )
        return segments, pieces

    def fly(
        self,
        vehicle: VehicleFile,
        *,
        fitted_starts: bool = False,
        forces: bool = False,
        flier: Callable[..., SimulatedChannels] = fly,
    ) -> dict[str, FlightErrors]:
        """Return flight name -> its errors, concatenated over windows."""
        check_rotors(vehicle)
        flights = [recording.flight for recording in self._recordings]
        model = model_of(with_reference_voltage(vehicle, flights), self._controller)
        segments, states = self._segments, None
        if fitted_starts:
            segments, _ = self._window_segments(free_starts=True)
            states = self._likeliest_starts(model, segments)
        elif self.windowed:
            segments = self._with_rotor_speeds(vehicle)
        simulated, acted, crash_times = self._simulated(model, segments, states, forces, flier)
        errors, first = {}, 0
        for recording, windows in zip(self._recordings, self._windows, strict=True):
            flight, crash = recording.flight, float(crash_times[first])
            position, attitude = (
                concatenate(
                    [
                        self._errors(signal, simulated[signal], first + number, window)
                        for number, window in enumerate(windows)
                    ]
                )
                for signal in POSE
            )
            crashed = not self.windowed and crash <= flight.duration
            errors[flight.name] = FlightErrors(
                position,
                attitude,
                laps_of(flight),
                crash if crashed else None,
                None
                if acted is None
                else self._forces(acted, first, windows, min(crash, flight.duration)),
            )
            first += len(windows)
        return errors

    def _simulated(
        self,
        model: Model,
        segments: Segments,
        states: Array | None,
        forces: bool,
        flier: Callable[..., SimulatedChannels],
    ) -> tuple[dict[str, Array], dict[str, Array] | None, Array]:
        """Return simulated signals, forces if asked for, and crash times (F,) in s.

        Signal -> (F, n, c) at the recorded stamps, and term -> (F, m, 6) force and moment at every
        ``stride``-th sample. A stamp before the simulation's start, or after its end, is compared
        with its first or last sample.
        """
        owner = np.asarray(self._segments.flight)
        conditions = {name: values[owner] for name, values in self._conditions.items()}
        flown = flier(
            model,
            segments,
            self._schedule,
            samples=self._samples,
            limits=self._limits,
            states=states,
            conditions=conditions,
            channels=(*POSE, TRUE_ROTOR_SPEED, MOTION, BODY_ATTITUDE),
        )
        rate, calm = float(self._schedule.log_rate), np.zeros(segments.count)
        acted = None
        if forces:
            acted = forces_of_terms(
                model.vehicle,
                flown.channels[MOTION],
                flown.channels[BODY_ATTITUDE],
                flown.channels[TRUE_ROTOR_SPEED],
                rate=rate,
                wind=(conditions.get("wind_x", calm), conditions.get("wind_y", calm)),
                stride=self._stride,
            )
        no_offsets = np.zeros((len(OFFSETS), segments.count))
        reading = Reading(no_offsets, no_offsets[: len(CLOCKS)], rate, self._samples)
        simulated = {}
        for signal in POSE:
            time = np.asarray(segments.measured[signal].time)
            taken = np.clip(time - self._stamp_delays, 0.0, (self._samples - 1) / rate).T
            simulated[signal] = at_stamps(flown.channels[signal], signal, taken, reading)
        return simulated, acted, flown.crash_time

    def _errors(self, signal: str, simulated: Array, segment: int, window: Window) -> SignalErrors:
        """Return the errors at the complete samples of a segment."""
        measured = self._segments.measured[signal]
        time = np.asarray(measured.time)[:, segment]
        used = (np.asarray(measured.weight)[..., segment] > 0).all(axis=1)
        if self.windowed:  # the next one begins where this one ends
            used &= time < window.flight.duration
        recorded = np.asarray(measured.values)[used, :, segment]
        flown = simulated[segment, used]
        if signal == "attitude":
            recorded, flown = roll_pitch_yaw(recorded), roll_pitch_yaw(flown)
            return SignalErrors(time[used] + window.begin, recorded, wrap_degrees(flown - recorded))
        return SignalErrors(time[used] + window.begin, recorded, flown - recorded)

    def _forces(
        self, acted: Mapping[str, Array], first: int, windows: Sequence[Window], end: float
    ) -> Forces:
        """Return the forces along a flight's segments up to a time in s, without overlaps."""
        count = next(iter(acted.values())).shape[1]
        time = np.arange(count) * self._stride / self._schedule.log_rate
        shown = time < (self._seconds if self.windowed else end)
        segments = range(first, first + len(windows))
        whole = Forces(
            np.concatenate([time[shown] + window.begin for window in windows]),
            {
                name: np.concatenate([values[segment, shown] for segment in segments])
                for name, values in acted.items()
            },
        )
        return whole.before(windows[0].flight.duration) if self.windowed else whole

    def _with_rotor_speeds(self, vehicle: VehicleFile) -> Segments:
        """Return the windows with starting speeds from commands for rotors without tachometer."""
        motor = vehicle.motor
        lag = 0.5 * (motor.time_constant_up + motor.time_constant_down)
        pieces = [window for windows in self._windows for window in windows]
        return replace(self._segments, turning=commanded_before(pieces, lag))

    def _likeliest_starts(self, model: Model, segments: Segments) -> Array:
        """Return the most likely starts (L, F), in the segments' standard deviations.

        They follow from Gauss-Newton steps from the recorded starts, halved where they overshoot.
        """
        assert segments.start_sd is not None
        names, flights = tuple(self._conditions), len(self._recordings)
        objective = Objective(
            model,
            segments,
            Space([], {}),
            self._schedule,
            self._samples,
            self._limits,
            conditions=names,
        )
        rows = [
            values / unit
            for values, unit in zip(self._conditions.values(), units_of(names), strict=True)
        ]
        none = np.zeros((len(OFFSETS), flights))
        point = Point(np.zeros(0), np.asarray(np.stack([*none, *rows])))
        loose = {name: np.full(flights, MISFIT_SCALE) for name in segments.measured}
        criterion = plain_criterion(objective, self._samples, loose)
        trial = best = np.zeros(segments.start_sd.shape)
        least = np.full(trial.shape[1], np.inf)
        for _ in range(GAUSS_NEWTON_STEPS + 1):  # the last one judges the step before it
            there = replace(criterion, states=np.asarray(trial))
            sums = objective.sums(point, there, derivatives=False)
            squares = np.sum([np.asarray(each) for each in sums.squares.values()], axis=0)
            misfit = np.nan_to_num(squares / MISFIT_SCALE**2 + (trial**2).sum(axis=0), nan=np.inf)
            better = misfit <= least
            best, least = np.where(better, trial, best), np.where(better, misfit, least)
            estimated = np.asarray(sums.states)
            estimated = np.clip(
                np.where(np.isfinite(estimated), estimated, 0.0), -MAX_STATE_SD, MAX_STATE_SD
            )
            trial = np.where(better, estimated, 0.5 * (best + trial))
        return best


OVERALL = "all"
#: A lap with fewer poses is left out.
MIN_POSES = 10


def table_of(flown: Mapping[str, Mapping[str, FlightErrors]]) -> RmseTable:
    """Return the table of vehicle -> flight -> errors."""
    rows = [
        row
        for stretch in zip(
            *(_rows(vehicle, errors) for vehicle, errors in flown.items()), strict=True
        )
        for row in stretch
    ]
    return RmseTable(vehicles=tuple(flown), best=_best_vehicle(rows), rows=tuple(rows))


def _rows(vehicle: str, flights: Mapping[str, FlightErrors]) -> list[RmseRow]:
    def row(flight: str, lap: int | None, rmse: AxesRmse, crash_time: float | None) -> RmseRow:
        return RmseRow(flight=flight, lap=lap, vehicle=vehicle, rmse=rmse, crash_time=crash_time)

    rows = []
    for name, errors in flights.items():
        rows.append(row(name, None, errors.rmse, errors.crash_time))
        edges = [0.0, *errors.laps.tolist(), math.inf]
        if len(edges) > 2:
            laps = [errors.between(start, end) for start, end in itertools.pairwise(edges)]
            rows += [
                row(name, number, lap.rmse, errors.crash_time)
                for number, lap in enumerate(laps, start=1)
                if len(lap.position.time) >= MIN_POSES
            ]
    crashes = [e.crash_time for e in flights.values() if e.crash_time is not None]
    overall = rmse_of(list(flights.values()))
    rows.append(row(OVERALL, None, overall, min(crashes, default=None)))
    return rows


def _best_vehicle(rows: Sequence[RmseRow]) -> str | None:
    """Return the vehicle whose overall RMSE has the smallest product over the axes."""
    scores = {}
    for row in rows:
        if row.flight == OVERALL:
            values = [getattr(row.rmse, axis) for axis in RMSE_UNITS]
            known = [max(value, 1e-12) for value in values if value is not None]
            if known and row.crash_time is None:
                scores[row.vehicle] = sum(math.log(value) for value in known) / len(known)
    return min(scores, key=scores.__getitem__) if scores else None
