"""Measurements of coefficients from flights without a pose.

Specific force and body rate show thrust over mass and torque over inertia. With the weighed mass
and the vehicle file's curve of rotor speed over command, these give the motor constant, two moments
of inertia, and about z the moment constant over the third. Angular acceleration without command is
a steady moment over inertia: the vehicle's trim. Without a tachometer only the motor constant times
the square of the curve's scale is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tuner.core.errors import RecordingError
from tuner.core.phrases import clause
from tuner.findings.findings import remedy, sentence
from tuner.ground.measurement import Curve, Measurement, Remark
from tuner.inertial.fit import NUMBER_NAMES, OUTPUTS, STEADY, Response, fit_response
from tuner.inertial.signals import stretches_of
from tuner.objective.rotor_signals import order_findings
from tuner.recordings.loader import InertialFlight
from tuner.vehicle import COEFFICIENTS, VehicleFile

POWERS: tuple[Mapping[str, float], ...] = (
    {"time_constant_up": 1.0},
    {"time_constant_down": 1.0},
    {"actuator_latency": 1.0},
    {"inertia_xx": -1.0},
    {"inertia_yy": -1.0},
    {"moment_constant": 1.0, "inertia_zz": -1.0, "motor_constant": 1.0, "input_scaling": 2.0},
    {"motor_constant": 1.0, "input_scaling": 2.0},
    {"torque_trim_x": 1.0},
    {"torque_trim_y": 1.0},
    {"torque_trim_z": 1.0},
)
"""Powers of the coefficients in each number of a `Response`. The scale of the rotors' curve is not
observable; its square multiplies the motor constant."""
OUTPUT_OF = dict(zip(STEADY, OUTPUTS, strict=False))
"""Constant -> its output."""
MIN_EXPLAINED = 0.1
"""An output with a smaller explained share of its variance is not used."""
MAX_RELATIVE_ERROR = 0.25
"""A gain with a larger relative standard error is not used."""
MAX_CERTAIN_ERROR = 0.1
"""A gain of the wrong sign with a smaller one is an error of the vehicle file, not chance."""
TITLES = {
    "roll": "angular acceleration about x, rad/s²",
    "pitch": "angular acceleration about y, rad/s²",
    "yaw": "angular acceleration about z, rad/s²",
    "thrust": "specific force along z, m/s²",
}


def measure_inertial(flight: InertialFlight, vehicle: VehicleFile) -> Measurement:
    """Return the measurement of a flight without a pose, for a known mass and geometry.

    Raises
    ------
    RecordingError
        Its commands turn the vehicle the other way, or it does not move.
    """
    stretches = stretches_of(flight.series, flight.flying)
    longest = max(flight.flying, key=lambda span: span[1] - span[0])
    for finding in order_findings(flight.name, flight.series, vehicle, longest):
        raise RecordingError(flight.path, clause(sentence(finding)), clause(remedy(finding)))
    response = fit_response(stretches, vehicle)
    wrong = [
        name
        for name in _outputs_within(response, MAX_CERTAIN_ERROR)
        if response.values[name] <= 0.0
    ]
    if wrong:
        raise RecordingError(
            flight.path,
            f"its commands turn the vehicle against the vehicle file in {', '.join(wrong)}",
            "check the motor order in the topic map, and the rotors' spins in the vehicle file",
        )
    used = _used_numbers(response)
    if not set(used) & set(OUTPUTS):
        raise RecordingError(
            flight.path,
            "holds no pose, and nothing turns it or changes its thrust",
            "record a flight that moves",
        )
    return _measurement(flight.name, response, used, vehicle)


def _outputs_within(response: Response, dim: float) -> list[str]:
    """Return the outputs whose gains have relative standard errors below a limit."""
    gains, errors, explained = response.values, response.errors, response.explained
    return [
        name
        for name in OUTPUTS
        if explained[name] > MIN_EXPLAINED and errors[name] < dim * abs(gains[name])
    ]


def _used_numbers(response: Response) -> tuple[str, ...]:
    """Return the names of the numbers that are used."""
    well = _outputs_within(response, MAX_RELATIVE_ERROR)
    shown = {name for name in well if response.values[name] > 0.0}
    errors = response.errors
    lags = {name for name in ("up", "down") if errors[name] < 2.0 * MAX_RELATIVE_ERROR} | {"late"}
    steady = {name for name, output in OUTPUT_OF.items() if output in shown}
    return tuple(name for name in NUMBER_NAMES if name in shown | lags | steady)


def _measurement(
    name: str, response: Response, used: Sequence[str], vehicle: VehicleFile
) -> Measurement:
    gains = response.values
    curve = 2.0 * COEFFICIENTS["input_scaling"].scaled(vehicle.motor.input_scaling)
    values = {
        **response.values,
        "roll": math.log(max(gains["roll"] / vehicle.mass, 1e-300)),
        "pitch": math.log(max(gains["pitch"] / vehicle.mass, 1e-300)),
        "yaw": curve + math.log(max(gains["yaw"] * vehicle.aerodynamics.moment_constant, 1e-300)),
        "thrust": curve + math.log(max(gains["thrust"] * vehicle.mass, 1e-300)),
    }
    thrust = gains["thrust"] * vehicle.mass if "thrust" in used else None
    constant = vehicle.aerodynamics.motor_constant if thrust is None else thrust
    over = {"roll": vehicle.mass, "pitch": vehicle.mass, "yaw": constant}
    inertia = {
        name: over[output] / gains[output] for name, output in OUTPUT_OF.items() if name in used
    }
    values |= {name: response.values[name] * moment for name, moment in inertia.items()}
    places = [NUMBER_NAMES.index(number) for number in used]
    # gains enter by their logarithms, constants as moments
    slope = np.array(
        [1.0 / gains[n] if n in OUTPUTS else inertia[n] if n in STEADY else 1.0 for n in used]
    )
    covariance = response.covariance[np.ix_(places, places)] * np.outer(slope, slope)
    explained = {name: 100.0 * max(response.explained[name], 0.0) for name in OUTPUTS}
    return Measurement(
        experiment=name,
        rows=tuple(POWERS[place] for place in places),
        value=np.array([values[number] for number in used]),
        covariance=covariance,
        remarks=(Remark("explained", explained),),
        curves=tuple(
            Curve.of(
                (title, "time, s", title.split(", ")[0]),
                *((response.time, curve) for curve in response.curves[output]),
            )
            for output, title in TITLES.items()
        ),
    )


def widen_to_agree(
    measurements: Sequence[Measurement], chi_square: float, freedom: int
) -> tuple[Measurement, ...]:
    """Return the measurements with covariances as wide as their disagreement (Birge ratio).

    Batteries, propellers and air differ from flight to flight by more than one flight shows.
    """
    ratio = max(chi_square / freedom, 1.0) if freedom > 0 else 1.0
    return tuple(replace(m, covariance=np.asarray(m.covariance * ratio)) for m in measurements)
