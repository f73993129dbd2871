"""A bifilar pendulum's swing to the moment of inertia about its vertical axis (thesis 3.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.ground.measurement import Curve, Measurement, Remark, rotor_radius
from tuner.ground.plan import Bifilar
from tuner.vehicle import VehicleFile

MIN_OSCILLATIONS = 5.0
MAX_AMPLITUDE_RAD = math.radians(20)
"""The law holds for small angles; larger amplitudes exceed its correction."""
MAX_SECOND_AMPLITUDE = 0.15
"""A second frequency with a larger share of the amplitude is a beat."""
GYRATION_RANGE = (0.05, 3.0)
"""Radius of gyration over the rotors' distance from the centre; other values have wrong units."""


def bifilar_inertia(
    frequency: float, *, mass: float, wire_distance: float, wire_length: float
) -> float:
    """Return the moment of inertia, kg m², about the vertical axis of a bifilar pendulum.

    I = m g d² / (16 π² h f²) (Eq. 3.1), for swings so small that sin θ is θ, with f the undamped
    frequency in Hz, m in kg, the distance d between the wires and their length h in m.
    """
    return mass * GRAVITY * wire_distance**2 / (16 * math.pi**2 * wire_length * frequency**2)


def measure_bifilar(
    name: str, path: str, samples: Mapping[str, Array], given: Bifilar, vehicle: VehicleFile
) -> Measurement:
    """Return the moment of inertia of one axis.

    A damped sine with offset and drift is fitted to the angle; its phase runs slower while the
    swing is wide (by amplitude²/16, as a pendulum's), and its frequency is corrected for damping.

    Parameters
    ----------
    samples
        ``time`` s and ``angle`` rad.
    given
        Axis, mass and wires, whose standard errors enter the result's.
    vehicle
        Its mass is the default; its size checks the units.

    Raises
    ------
    RecordingError
        Too few oscillations, too wide ones, or none; or an implausible inertia.
    """
    mass, distance, length = given.mass or vehicle.mass, given.wire_distance, given.wire_length
    time, angle = samples["time"] - samples["time"][0], samples["angle"]
    known = np.isfinite(angle)
    time, angle = time[known], angle[known]
    guess = _spectral_guess(time, angle)
    swings = guess * time[-1]
    if swings < MIN_OSCILLATIONS:
        what = f"shows {swings:.1f} oscillations, fewer than {MIN_OSCILLATIONS:g}"
        raise RecordingError(path, what, "let it swing longer")
    solution = _fit_swing(time, angle, guess)
    amplitude, decay, phase_rate = abs(solution.x[0]), solution.x[1], solution.x[2]
    if amplitude > MAX_AMPLITUDE_RAD:
        what = f"swings by {math.degrees(amplitude):.0f} degrees"
        raise RecordingError(
            path, what, "release it within 20 degrees, the law is for small angles"
        )
    residual = solution.fun
    noise = float(residual.std(ddof=len(solution.x)))
    if noise > 0.5 * amplitude:
        raise RecordingError(path, "shows no damped oscillation", "check the angle's column")
    frequency = math.hypot(phase_rate, decay / (2 * math.pi))
    error = _frequency_error(solution, residual)
    inertia = bifilar_inertia(frequency, mass=mass, wire_distance=distance, wire_length=length)
    gyration = math.sqrt(inertia / mass)
    low, high = (share * rotor_radius(vehicle) for share in GYRATION_RANGE)
    if not low < gyration < high:
        what = f"gives a radius of gyration of {gyration:.3g} m, not one of {low:.2g} to {high:.2g}"
        raise RecordingError(path, what, "check mass (kg), wires (m) and time (s)")
    variance = (
        (2 * error / frequency) ** 2
        + given.mass_error**2
        + (2 * given.wire_distance_error / distance) ** 2
        + (given.wire_length_error / length) ** 2
    )
    remarks = [
        Remark("swing", {"oscillations": swings, "amplitude": amplitude, "frequency": frequency})
    ]
    second = _second_frequency(time, residual) / amplitude
    if second > MAX_SECOND_AMPLITUDE:
        remarks.append(Remark("beat", {"share": second}))
    drift = abs(solution.x[5]) * time[-1]
    if drift > 0.2 * amplitude:
        remarks.append(Remark("drift", {"drift": drift}))
    dense = np.linspace(0.0, time[-1], 2000)
    titles = (f"Swing about {given.axis}", "time, s", "angle, rad")
    curve = Curve.of(titles, (time, angle), (dense, _damped_swing(solution.x, dense)))
    return Measurement(
        name,
        ({f"inertia_{given.axis * 2}": 1.0},),
        np.array([math.log(inertia)]),
        np.array([[variance]]),
        tuple(remarks),
        (curve,),
    )


def _damped_swing(parameters: Array, time: Array) -> Array:
    amplitude, decay, frequency, phase, offset, drift = parameters
    # a pendulum's period grows by amplitude²/16; integrated over the decaying amplitude
    slow = (
        amplitude**2
        / 16
        * (time if abs(decay) < 1e-9 else -np.expm1(-2 * decay * time) / (2 * decay))
    )
    angle = 2 * math.pi * frequency * (time - slow) + phase
    return np.asarray(amplitude * np.exp(-decay * time) * np.cos(angle) + offset + drift * time)


def _spectral_guess(time: Array, angle: Array) -> float:
    """Return the frequency, Hz, of the highest peak of the spectrum."""
    count = len(time)
    even = np.linspace(time[0], time[-1], count)
    values = np.interp(even, time, angle)
    values = values - np.polyval(np.polyfit(even, values, 1), even)
    padded = 8 * count
    power = np.abs(np.fft.rfft(values * np.hanning(count), padded))
    frequencies = np.fft.rfftfreq(padded, (even[-1] - even[0]) / (count - 1))
    power[frequencies < 0.5 / (even[-1] - even[0])] = 0.0
    return float(frequencies[int(np.argmax(power))])


def _fit_swing(time: Array, angle: Array, guess: float) -> Any:
    turns = 2 * math.pi * guess * time
    waves = np.column_stack([np.cos(turns), -np.sin(turns), np.ones_like(time)])
    cosine, sine, offset = np.linalg.lstsq(waves, angle, rcond=None)[0]
    half = 0.5 * float(np.ptp(angle))
    start = np.array([half, 0.5 / time[-1], guess, math.atan2(sine, cosine), offset, 0.0])
    return least_squares(
        lambda p: _damped_swing(p, time) - angle, start, x_scale=np.maximum(np.abs(start), 1e-3)
    )


def _frequency_error(solution: Any, residual: Array) -> float:
    """Return the frequency's standard error, Hz, correlated residuals included."""
    jacobian = solution.jac
    covariance = np.linalg.pinv(jacobian.T @ jacobian)
    white = covariance[2, 2] * float(residual @ residual) / max(len(residual) - len(solution.x), 1)
    influence = covariance[2] @ jacobian.T * residual
    blocks = np.array([part.sum() for part in np.array_split(influence, 20)])
    return math.sqrt(max(white, float(blocks @ blocks)))


def _second_frequency(time: Array, residual: Array) -> float:
    """Return the amplitude of the strongest oscillation that the fit leaves, in its unit."""
    even = np.linspace(time[0], time[-1], len(time))
    spectrum = np.abs(np.fft.rfft(np.interp(even, time, residual))) * 2 / len(time)
    return float(spectrum.max(initial=0.0))
