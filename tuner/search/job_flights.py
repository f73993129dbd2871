"""The flights of a job with their inlets, clock offsets and holdout, for all commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tuner.config import FlightSettings, InletName, Settings, TrajectorySettings
from tuner.core.disk import exists
from tuner.core.errors import InputError, RecordingError, did_you_mean
from tuner.core.numerics import Array
from tuner.core.yaml_section import build
from tuner.equation_error.recorded_accelerations import Steps, rows_of, steps_of
from tuner.equation_error.regression import convolved, summing
from tuner.findings.findings import Code, Finding, Level
from tuner.objective.inlets import INLETS, window_seconds
from tuner.objective.rotor_signals import (
    Source,
    TorqueCorrelation,
    columns_of_rotors,
    flight_in_rotor_order,
    in_rotor_order,
    levers,
    motor_order,
    torque_correlation,
    with_commands,
    with_speeds_in_si,
)
from tuner.objective.setpoints import match_setpoints, setpoint_findings
from tuner.objective.trajectory import with_named_reference
from tuner.objective.windows import require_windows
from tuner.recordings.consistency import contradiction_in
from tuner.recordings.defects import has_stale_attitude
from tuner.recordings.flight import Flight
from tuner.recordings.loader import InertialFlight, load_flights, read_inertial
from tuner.recordings.notes import NoteCode, note_in_words
from tuner.recordings.ulog import parameters_in_flight
from tuner.vehicle import ControllerFile, VehicleFile
from tuner.vehicle.controller import PARAMETER_OF, with_parameters


@dataclass(frozen=True)
class JobFlight:
    """A flight with its settings in a job.

    Attributes
    ----------
    flight
        The mission.
    inlet
        Where it enters the simulated loop.
    time_offset
        s by which its stamps are late; None where the fit estimates that.
    holdout
        Whether it is evaluated and never fitted.
    conditions
        Known values of its `tuner.vehicle.conditions`.
    finding
        Why its inlet is not the most upstream one whose signals were recorded; None if it is.
    input_late
        s by which its inputs are stamped later than its recorded state.
    """

    flight: Flight
    inlet: InletName = "reference"
    time_offset: float | None = 0.0
    holdout: bool = False
    conditions: Mapping[str, float] = field(default_factory=dict)
    finding: Finding | None = None
    input_late: float = 0.0


def with_logged_parameters(settings: Settings) -> tuple[Settings, tuple[Finding, ...]]:
    """Return settings with the rate loop of the parameters in PX4 logs, and findings on changes."""
    logs = {path: of for path in settings.flights if (of := parameters_in_flight(path))[0]}
    if not logs:
        return settings, ()
    (first, _), *others = logs.values()
    controller, changes = with_parameters(settings.controller, first)
    logged = [name for name in PARAMETER_OF.values() if name in first]
    unlike = {name for name in logged if any(other.get(name) != first[name] for other, _ in others)}
    unlike.update(*(later.intersection(logged) for _, later in logs.values()))
    findings = []
    if changes:
        named = not settings.origin.get("controller", "default").startswith("default")
        level: Literal["warning", "info"] = "warning" if named else "info"
        findings.append(Code.LOGGED_GAINS.at(level, next(iter(logs)).stem, *changes))
    if unlike:
        findings.append(Code.LOGS_DIFFER.warning("flights", *sorted(unlike)))
    origin = {**settings.origin, "controller": f"{settings.origin.get('controller', '')}, the log"}
    changed = replace(settings, controller=controller, origin=origin) if changes else settings
    return changed, tuple(findings)


def read_recordings(
    settings: Settings, *, holdout: Sequence[str] | None = None, fits: bool = True
) -> tuple[tuple[JobFlight, ...], tuple[Finding, ...]]:
    """Read every mission of a job's files that can be simulated, with findings on the others.

    Parameters
    ----------
    settings
        Settings of the job.
    holdout
        Names of the flights that are held out; None takes the job's.
    fits
        Whether at least one flight must remain to fit.

    Returns
    -------
    tuple
        The recordings, and a finding for each flight that is left out because it cannot be read,
        nothing flies in it, it contradicts itself, or it lacks signals of its inlet, and for each
        that enters further down than its signals allow.

    Raises
    ------
    InputError
        No file can be read, no flight holds what its inlet needs, a side-car names an
        impossible trajectory, or a held-out flight does not exist.
    """
    job = settings.job
    flights: list[Flight] = []
    left_out: list[tuple[str, RecordingError]] = []
    for path in settings.flights:
        try:
            flights += load_flights(path, topics=job.topics, namespace=job.namespace)
        except RecordingError as error:
            if not exists(path):
                raise
            left_out.append((path.stem, error))
    flights, passed_over = _fitted_manoeuvres(flights)
    names = [*(flight.name for flight in flights), *(name for name, _ in left_out)]
    for name in job.holdout:
        if name not in names:
            raise InputError("--holdout", f"there is no flight '{name}'", did_you_mean(name, names))
    recordings: list[JobFlight] = []
    held_out = job.holdout if holdout is None else holdout
    for flight in flights:
        try:
            with_reference = _with_reference(flight, settings)
            recordings.append(
                recording_of(settings, with_reference, holdout=flight.name in held_out)
            )
        except RecordingError as error:
            left_out.append((flight.name, error))
    none_to_fit = not any(recording.flight.name not in held_out for recording in recordings)
    if left_out and (not recordings or (fits and none_to_fit)):
        raise left_out[0][1]
    recordings = [_with_fitted_inlet(recording, recordings, settings) for recording in recordings]
    chosen = (recording.finding for recording in recordings if recording.finding is not None)
    return tuple(recordings), (
        *passed_over,
        *(left_out_finding(name, error) for name, error in left_out),
        *chosen,
    )


def _fitted_manoeuvres(flights: Sequence[Flight]) -> tuple[list[Flight], list[Finding]]:
    """Return the flights without unselected manoeuvres of long recordings, and findings."""
    chosen = {
        flight.name
        for flight in flights
        if not any(note.code is NoteCode.NOT_CHOSEN for note in flight.notes)
    }
    findings = []
    for path in dict.fromkeys(f.path for f in flights if f.name not in chosen):
        of_path = [flight for flight in flights if flight.path == path]
        fitted = [str(n) for n, flight in enumerate(of_path, 1) if flight.name in chosen]
        findings.append(
            Code.MANOEUVRES_CHOSEN.info(
                of_path[0].name,
                of_path[0].name,
                *fitted,
                fitted=float(len(fitted)),
                flights=float(len(of_path)),
            )
        )
    return [flight for flight in flights if flight.name in chosen], findings


def left_out_finding(name: str, error: RecordingError) -> Finding:
    """Return the finding that a flight is left out, and why."""
    return Code.LEFT_OUT.warning(name, error.what, error.remedy)


def with_known(
    recordings: Sequence[JobFlight], **known: Mapping[str, Any]
) -> tuple[JobFlight, ...]:
    """Return recordings with fields replaced: a `JobFlight`'s field = flight name -> value."""
    return tuple(
        replace(r, **{field: of_flight[r.flight.name] for field, of_flight in known.items()})
        for r in recordings
    )


def recording_of(settings: Settings, flight: Flight, *, holdout: bool) -> JobFlight:
    """Return a flight with the inlet and clock offset of a job's settings.

    Raises
    ------
    RecordingError
        It contradicts itself, or lacks signals of its inlet, or has too few of them together.
    ConfigError
        The mixer above an inlet cannot fly the vehicle's rotors.
    """
    job = settings.job
    own = job.flights.get(flight.name, FlightSettings())
    offset = job.time_offset if own.time_offset is None else own.time_offset
    if has_stale_attitude(flight.series, flight.notes):
        raise RecordingError(
            flight.path,
            "its attitude stops changing while the vehicle moves on, too soon for a flight",
            "look at what stopped: the controller, or the logger",
        )
    denied = contradiction_in(flight.notes)
    if denied is not None:
        raise RecordingError(
            flight.path,
            f"its {denied.names[0]} and its {denied.names[1]} contradict each other (agreement "
            f"{denied.numbers['agreement']:.2f} of 1)",
            "look for a time that runs backwards, and at frame and quaternion in the topic map",
        )
    flight = flight_in_rotor_order(flight, settings.vehicle)
    flight = with_speeds_in_si(with_commands(flight, settings.vehicle), settings.vehicle)
    chosen, finding = choose_inlet(
        flight, own.inlet or job.inlet, settings.vehicle, settings.controller
    )
    if not INLETS[chosen].closed_loop:
        seconds = window_seconds([chosen], job.search.window)
        require_windows(flight, seconds, INLETS[chosen].fed(flight))
    late = None if offset == "free" else float(offset)
    return JobFlight(flight, chosen, late, holdout, finding=finding)


def _with_fitted_inlet(
    recording: JobFlight, recordings: Sequence[JobFlight], settings: Settings
) -> JobFlight:
    """Return a held-out flight with the attitude inlet where all fitted ones have it.

    Otherwise its turning would be simulated with coefficients that nothing was fitted to.
    """
    job, flight = settings.job, recording.flight
    requested = job.flights.get(flight.name, FlightSettings()).inlet or job.inlet
    fitted = {other.inlet for other in recordings if not other.holdout}
    turns = recording.inlet in SIGNAL_OF_INLET and fitted == {"attitude"}
    if not (recording.holdout and requested == "auto" and turns):
        return recording
    try:
        require_windows(flight, window_seconds(["attitude"], job.search.window), ("attitude",))
    except RecordingError:
        return recording
    finding = Code.ATTITUDE_FOLLOWED.info(flight.name, recording.inlet)
    return replace(recording, inlet="attitude", finding=finding)


def _with_reference(flight: Flight, settings: Settings) -> Flight:
    """Return a flight with the trajectory that the job file names, or else its side-car."""
    named = settings.job.flights.get(flight.name, FlightSettings()).trajectory
    if named is None and flight.trajectory is not None and not flight.has("reference_position"):
        named = build(TrajectorySettings, flight.trajectory, f"side-car of {flight.path}")
    return flight if named is None else with_named_reference(flight, named)


def read_inertial_flights(
    settings: Settings,
) -> tuple[tuple[InertialFlight, ...], tuple[Finding, ...]]:
    """Return the flights of a job if none of its recordings has a pose, and findings on others.

    There are none where one has a pose.

    Raises
    ------
    RecordingError
        No recording can be used.
    """
    job = settings.job
    flights: list[InertialFlight] = []
    left_out: list[tuple[Path, RecordingError]] = []
    for path in settings.flights:
        try:
            flight = read_inertial(path, topics=job.topics, namespace=job.namespace)
        except RecordingError as error:
            if not exists(path):
                raise
            left_out.append((path, error))
            continue
        if flight is None:
            return (), ()
        columns = columns_of_rotors(settings.vehicle, flight.notes)
        if columns is not None:
            flight = replace(flight, series=in_rotor_order(flight.series, columns))
        flights.append(flight)
    if left_out and not flights:
        raise left_out[0][1]
    return tuple(flights), tuple(left_out_finding(path.stem, error) for path, error in left_out)


PREDICTION_S = 0.1
"""Time ahead for which a predicted body rate is compared with holding the current one."""


def predicts_turning(flight: Flight, vehicle: VehicleFile) -> bool:
    """Return whether a regression on one half of a flight predicts the other better than holding.

    It predicts roll and pitch rate `PREDICTION_S` ahead, from rotor speeds and places alone.
    """
    steps = steps_of(flight)
    if steps is None:
        return False
    half, squares = len(steps.rotor_speed) // 2, np.zeros(2)
    for axis in (0, 1):
        columns, turning = regressors(steps, vehicle)[axis], steps.accelerations[:, 3 + axis]
        for fitted in (np.arange(len(turning)) < half, np.arange(len(turning)) >= half):
            inside = fitted & steps.known
            weights = np.linalg.lstsq(columns[inside], turning[inside], rcond=None)[0]
            left = np.stack([turning - columns @ weights, turning], axis=1)[~fitted]
            squares += np.sum(
                convolved(left, steps.known[~fitted], summing(steps.step, PREDICTION_S)) ** 2,
                axis=0,
            )
    return bool(squares[0] < squares[1])


def regressors(steps: Steps, vehicle: VehicleFile) -> tuple[Array, Array, Array]:
    """Return the regressors (N, k) of angular acceleration about x, y and z.

    They are the rotors' torque up to a factor, air velocity across and body rate times the sum of
    the rotors' speeds, and a constant.
    """
    speed, motion = steps.rotor_speed, steps.motion
    body = rows_of(motion.attitude.to_body(motion.velocity))
    rate = rows_of(motion.body_rate)
    torque, total = np.square(speed) @ levers(vehicle), speed.sum(axis=1)
    steady = np.ones(len(speed))
    across = (body[:, 1], body[:, 0])
    x, y = (
        np.stack([torque[:, a], across[a] * total, rate[:, a] * total, steady], axis=1)
        for a in (0, 1)
    )
    return x, y, np.stack([torque[:, 2], rate[:, 2] * total, steady], axis=1)


MIN_TORQUE_CORRELATION = 0.15
"""Least correlation of torque and angular acceleration about roll and pitch of rotor signals that
are fed in: real 100 Hz logs of good commands have 0.3 to 0.5, one at 41 Hz of a faster loop has 0.
Measured speeds below it pass if they predict turning together with air velocity."""

REFERENCE = ("reference_position", "reference_velocity", "reference_acceleration")
DROPPED = (NoteCode.OUT_OF_RANGE, NoteCode.UNIT_UNKNOWN, NoteCode.NOT_A_NUMBER, NoteCode.OUTLIERS)
"""Notes of samples that the reader dropped for their values."""
SIGNAL_OF_INLET: dict[InletName, Source] = {"actuator": "command", "rotor_speed": "rotor_speed"}
"""Inlet at which recorded rotor signals turn the simulated vehicle -> that signal."""


def choose_inlet(
    flight: Flight, requested: str, vehicle: VehicleFile, controller: ControllerFile
) -> tuple[InletName, Finding | None]:
    """Return the inlet of a flight: the requested one, or for ``auto`` the best for its recording.

    And the finding why it is not the most upstream one whose signals were recorded; None if it is.

    Parameters
    ----------
    flight
        The recording.
    requested
        An inlet's name, or ``auto``.
    vehicle, controller
        The vehicle's rotors, and the controller that commands them above the inlet.

    Raises
    ------
    RecordingError
        The recording lacks signals that the inlet needs.
    """
    first = inlet_for(flight, requested)
    if requested == "auto" and first == "reference":
        if any(note.code is NoteCode.PX4_REFERENCE for note in flight.notes):
            with suppress(RecordingError):
                below, _ = choose_inlet(_without_reference(flight), "auto", vehicle, controller)
                return below, Code.PX4_LOOPS.info(flight.name, below)
        match = match_setpoints(flight, controller)
        if match is not None and not match.is_ours:
            (finding,) = setpoint_findings(flight, controller)
            below, _ = choose_inlet(_without_reference(flight), "auto", vehicle, controller)
            return below, finding
    if requested != "auto" or first not in SIGNAL_OF_INLET:
        return first, None
    doubt: TorqueCorrelation | None = None
    for name, source in SIGNAL_OF_INLET.items():
        if not INLETS[name].can_be_fed(flight):
            continue
        correlation = torque_correlation(flight, vehicle, source)
        if (
            correlation is None
            or correlation.tilting >= MIN_TORQUE_CORRELATION
            or (source == "rotor_speed" and predicts_turning(flight, vehicle))
        ):
            return name, None if doubt is None else _finding(flight, name, doubt, vehicle)
        doubt = doubt or correlation
    assert doubt is not None
    if not INLETS["attitude"].can_be_fed(flight):
        return first, None
    return "attitude", _finding(flight, "attitude", doubt, vehicle)


def _without_reference(flight: Flight) -> Flight:
    return replace(flight, signals={n: s for n, s in flight.signals.items() if n not in REFERENCE})


def _finding(
    flight: Flight, inlet: InletName, doubt: TorqueCorrelation, vehicle: VehicleFile
) -> Finding:
    """Return the finding on an inlet further down, and on motors in another order."""
    numbers = {
        "correlation": round(doubt.tilting, 2) + 0.0,
        "recorded": round(doubt.rate),
        "gyro": round(doubt.gyro_rate),
    }
    span = (0.0, flight.duration)
    order = motor_order(flight.series, vehicle, doubt.source, span)
    why = () if order is None or order.is_right else ("order",)
    level: Level = "warning" if inlet == "attitude" else "info"
    return Code.INLET_CHOSEN.at(level, flight.name, inlet, doubt.source, *why, **numbers)


def inlet_for(flight: Flight, requested: str) -> InletName:
    """Return the inlet of a flight: the one requested, or for ``auto`` the first preferred one.

    Raises
    ------
    RecordingError
        The recording lacks signals that the inlet needs.
    """
    preferred = next((inlet for inlet in INLETS.values() if inlet.is_preferred(flight)), None)
    if requested == "auto":
        if preferred is not None:
            return preferred.name
        alone = any(note.code is NoteCode.POSE_ALONE for note in flight.notes)
        fed = tuple(dict.fromkeys(signal for inlet in INLETS.values() for signal in inlet.needs))
        raise RecordingError(
            flight.path,
            f"holds {'a pose alone, and ' if alone else ''}neither a reference with velocities, "
            "nor rate set-points, nor four motor commands, nor four rotor speeds, nor thrust "
            f"set-points{_dropped(flight, fed)}",
            "name its trajectory in the job file",
        )
    (inlet,) = (inlet for inlet in INLETS.values() if inlet.name == requested)
    if not inlet.can_be_fed(flight):
        missing = " and no ".join(inlet.needs)
        dropped = _dropped(flight, inlet.needs)
        remedy = inlet.remedy
        if preferred is None:
            remedy = "inspect the recording: nothing in it can be fed in"
        raise RecordingError(
            flight.path, f"holds no {missing} for the {inlet.name} inlet{dropped}", remedy
        )
    return inlet.name


def _dropped(flight: Flight, signals: Sequence[str]) -> str:
    """Return why some signals lack samples, as a clause: corrupt, or of a rotor that is dead."""
    dead = [note for note in flight.notes if note.code is NoteCode.COMMAND_DEAD]
    if dead and "command" in signals:
        return f": {note_in_words(dead[0])}"
    counts = [
        (signal, sum(n.count for n in flight.notes if n.code in DROPPED and signal in n.names))
        for signal in signals
    ]
    parts = [f"{count} {name.replace('_', ' ')} samples" for name, count in counts if count]
    return f": {' and '.join(parts)} were dropped as corrupt" if parts else ""
