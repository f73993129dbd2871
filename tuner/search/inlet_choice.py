"""The choice of a recording's inlet from its data, and the reason as a finding."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from tuner.config.job import InletName
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.equation_error.recorded_accelerations import Steps, rows_of, steps_of
from tuner.equation_error.regression import convolved, summing
from tuner.findings.findings import Code, Finding, Level
from tuner.objective.inlets import INLETS
from tuner.objective.rotor_signals import (
    Source,
    TorqueCorrelation,
    levers,
    motor_order,
    torque_correlation,
)
from tuner.objective.setpoints import match_setpoints, setpoint_findings
from tuner.recordings.flight import Flight
from tuner.recordings.notes import NoteCode
from tuner.vehicle import ControllerFile, VehicleFile

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
                return below, Finding(Code.PX4_LOOPS, "info", flight.name, names=(below,))
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
    return Finding(Code.INLET_CHOSEN, level, flight.name, numbers, (inlet, doubt.source, *why))


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
    """Return how many samples of some signals were dropped as corrupt, as a clause."""
    counts = [
        (signal, sum(n.count for n in flight.notes if n.code in DROPPED and signal in n.names))
        for signal in signals
    ]
    parts = [f"{count} {name.replace('_', ' ')} samples" for name, count in counts if count]
    return f": {' and '.join(parts)} were dropped as corrupt" if parts else ""
