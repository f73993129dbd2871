"""Test rigs: a bifilar pendulum (thesis 3.1), stands and command steps (4.2, 6.3, 7.3).

A pendulum's swing gives the moment of inertia about its vertical axis. Stepwise experiments give
force by squared rotor speed, and rotor speed by command.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array, scaled_inverse
from tuner.ground.measurement import Curve, Measurement, Remark, rotor_radius
from tuner.ground.plan import Bifilar, RpmCurve, ThrustStand, TorqueStand
from tuner.ground.rig_data import mean_and_error, resolution, usable_plateaus, widen
from tuner.vehicle import VehicleFile
from tuner.vehicle.vehicle import REFERENCE_ARM, size_of

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
    What was recorded before the release is left out.

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
    released = _released(time, angle, guess) if guess > 0 else 0
    time, angle = time[released:] - time[released], angle[released:]
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


def _released(time: Array, angle: Array, guess: float) -> int:
    """Return the sample at which a body that was held for a swing or longer turns fast, or 0."""
    even = np.linspace(time[0], time[-1], len(time))
    width = 1 / (8 * guess) / (even[1] - even[0])
    speed = np.abs(gaussian_filter1d(np.interp(even, time, angle), max(width, 1.0), order=1))
    first = even[int(np.argmax(speed > 0.8 * speed.max()))]
    return int(np.searchsorted(time, first)) if first - time[0] > 1 / guess else 0


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


MIN_LEVEL_S = 1.0
"""A shorter level of the rotor speed is a transient."""
SPEED_STEP = 0.03
"""A larger change of the rotor speed, relative to its largest, is a step."""
MIN_LEVELS = 4
"""Fewer levels do not separate slope, offset and drift."""
MIN_SPEED_RATIO = 1.3
"""With a smaller ratio of fastest to slowest level an offset looks like a slope."""
THRUST_RANGE = (0.05, 20.0)
"""Largest thrust of all rotors over the weight; other values have a wrong unit or lever."""
TORQUE_RANGE = (0.005, 20.0)
"""Largest drag torque of all rotors over the weight times an arm, likewise."""


THRUST = {"motor_constant": 1.0}
TORQUE = {"moment_constant": 1.0, "motor_constant": 1.0}
"""Powers of coefficients in F · lever / (n Ω²): k of a thrust stand, k_M k_F of a torque stand."""


def measure_stand(
    name: str,
    path: str,
    samples: Mapping[str, Array],
    given: ThrustStand | TorqueStand,
    vehicle: VehicleFile,
) -> Measurement:
    """Return a constant of the rotors from F · lever = n k Ω² (Eq. 6.8, 7.3.2) and an offset.

    Parameters
    ----------
    samples
        ``time`` s, ``rotor_speed`` rad/s, ``force`` N.
    given
        The stand, its number of rotors, and its lever with the relative standard error.
    vehicle
        Checks the plausibility.

    Raises
    ------
    RecordingError
        There are too few steps, they are too short, the force does not grow with the speed, or
        thrust or torque are implausible for the vehicle.
    """
    title, row, lever, lever_error = (
        ("Thrust stand", THRUST, given.lever_ratio, given.lever_ratio_error)
        if isinstance(given, ThrustStand)
        else ("Torque stand", TORQUE, given.lever_arm, given.lever_arm_error)
    )
    time, speed, force = samples["time"], samples["rotor_speed"], samples["force"]
    step = SPEED_STEP * float(np.nanquantile(speed, 0.98))
    parts, used, dropped = usable_plateaus(
        speed, time, speed, np.isfinite(force), shortest=MIN_LEVEL_S, step=step
    )
    if len(parts) < MIN_LEVELS:
        what = f"holds {len(parts)} steady levels of rotor speed of {MIN_LEVEL_S:g} s and more"
        raise RecordingError(path, what, f"record {MIN_LEVELS} or more, each for some seconds")
    fine, coarse = resolution(speed), resolution(force)
    levels, level_error, measured, force_error = np.array(
        [(*mean_and_error(speed[at], fine), *mean_and_error(force[at], coarse)) for _, at in parts]
    ).T
    middle = np.array([0.5 * (plateau.begin + plateau.end) for plateau, _ in parts])
    fastest, slowest = levels.max(), levels.min()
    if fastest < MIN_SPEED_RATIO * slowest:
        what = f"has levels from {slowest:.0f} to {fastest:.0f} rad/s, too alike for a slope"
        raise RecordingError(path, what, "step from slow to fast")
    design = np.column_stack([levels**2, np.ones(len(levels)), middle - middle[0]])
    if len(levels) < MIN_LEVELS + 2:
        design = design[:, :2]
    errors = levels, level_error, force_error
    solution, covariance = _weighted(design, measured, *errors)
    slope = float(solution[0])
    if slope <= 0:
        raise RecordingError(
            path, "has a force that falls as the rotors speed up", "check the sign"
        )
    fit = design @ solution
    remarks = [
        Remark("levels", {"levels": len(levels), "outliers": dropped}),
        Remark("offset", {"force": float(solution[1])}),
    ]
    relative = design[:, 0] / design[:, 0].max()
    curved = _weighted(np.column_stack([design, relative**2]), measured, *errors)
    bend, bend_error = float(curved[0][-1]), math.sqrt(curved[1][-1, -1])  # of Ω⁴ beside Ω²
    if abs(bend) > 3 * bend_error and len(levels) >= MIN_LEVELS + 2:
        remarks.append(Remark("not_quadratic", {"deviation": bend / bend_error}))
    squares = design[:, 0]
    order = np.argsort(squares)
    curves = (
        Curve.of(
            ("Rotor speed", "time, s", "rotor speed, rad/s"),
            (time, speed),
            (middle, levels),
            used=used,
            law=False,
        ),
        Curve.of(
            (title, "rotor speed squared, rad²/s²", "force, N"),
            (squares, measured),
            (squares[order], fit[order]),
        ),
    )
    constant, top = slope * lever / given.rotors, float(np.nanquantile(speed, 0.95))
    thrust = len(vehicle.rotors) * constant * top**2
    weight = vehicle.mass * GRAVITY
    lifts = THRUST_RANGE[0] < thrust / weight < THRUST_RANGE[1]
    if row == THRUST and not lifts:
        what = f"gives {thrust:.3g} N of thrust at {top:.0f} rad/s to a vehicle of {vehicle.mass:g}"
        raise RecordingError(path, f"{what} kg", "check the force (N) and the lever ratio")
    twists = (
        TORQUE_RANGE[0] < thrust / (weight * REFERENCE_ARM * size_of(vehicle).arm) < TORQUE_RANGE[1]
    )  # of torque, N m
    if row == TORQUE and not twists:
        what = f"gives {thrust:.3g} N m of torque at {top:.0f} rad/s to a vehicle of"
        remedy = "check the force (N) and the lever arm (m)"
        raise RecordingError(path, f"{what} {vehicle.mass:g} kg", remedy)
    variance = covariance[0, 0] / slope**2 + lever_error**2
    return Measurement(
        name, (row,), np.log([constant]), np.array([[variance]]), tuple(remarks), curves
    )


def _weighted(
    design: Array, measured: Array, speed: Array, speed_error: Array, force_error: Array
) -> tuple[Array, Array]:
    """Return the weighted least squares solution and covariance, with Student's t for few levels.

    A speed's error becomes a force's by the slope; the residuals' scatter scales both.
    """
    slope = float(np.linalg.lstsq(design, measured, rcond=None)[0][0])
    variance = force_error**2 + (2 * slope * speed * speed_error) ** 2
    variance = np.maximum(variance, 0.25 * np.median(variance))
    weight = 1.0 / np.maximum(variance, 1e-30)
    normal = design.T @ (design * weight[:, None])
    inverse = scaled_inverse(normal)
    solution = inverse @ (design.T @ (weight * measured))
    residual = measured - design @ solution
    chi_square = float(residual @ (weight * residual))
    return solution, widen(inverse, chi_square, len(measured) - design.shape[1])


MIN_COMMAND_S = 0.8
COMMAND_STEP = 0.015
"""A larger change of the command is a step."""
MIN_COMMANDS = 4
MAX_SPEED_AT_REST = 0.03
"""Of the fastest level. A slower motor is stopped: the curve is that of one that turns."""
MIN_VOLTAGE_RATIO = 1.015
"""With a smaller ratio of highest to lowest voltage its exponent is not fitted."""
MIN_QUADRATIC_SIGMAS = 3.0
"""A quadratic term with fewer standard errors is not significant."""


def measure_rpm_curve(
    name: str, path: str, samples: Mapping[str, Array], given: RpmCurve
) -> Measurement:
    """Return input scaling, zero position and, if significant, curvature and exponent.

    Ω = (a u + b u² + c) (V/V_ref)^γ (Eq. 4.2, 4.4.1), one point for the middle of every step with
    turning rotors.

    Parameters
    ----------
    samples
        ``time`` s, ``command`` 0..1, ``rotor_speed`` rad/s, and ``voltage`` V if it was recorded.
    given
        Gives V_ref; by default the highest recorded voltage.

    Raises
    ------
    RecordingError
        There are too few steps or the rotor speed does not follow the command.
    """
    time, command, speed = samples["time"], samples["command"], samples["rotor_speed"]
    steady = np.isfinite(command) & np.isfinite(samples.get("voltage", command))
    parts, used, dropped = usable_plateaus(
        command, time, speed, steady, shortest=MIN_COMMAND_S, step=COMMAND_STEP
    )
    battery = samples.get("voltage", np.ones(len(time)))
    fine, coarse = resolution(speed), resolution(battery)
    points = [
        (float(np.mean(command[at])), *mean_and_error(speed[at], fine),
         *mean_and_error(battery[at], coarse))
        for _, at in parts
    ]  # fmt: skip
    at_rest = MAX_SPEED_AT_REST * max((speed for _, speed, *_ in points), default=0.0)
    points = [point for point in points if point[1] > at_rest]
    if len({round(point[0] / COMMAND_STEP) for point in points}) < MIN_COMMANDS:
        what = f"holds {len(points)} steady steps of the command of {MIN_COMMAND_S:g} s and more"
        raise RecordingError(
            path, what, f"record {MIN_COMMANDS} or more commands, each for seconds"
        )
    u, omega, error, volts, volts_error = np.array(points).T
    error = np.hypot(error, omega * volts_error / volts)  # an exponent of one, at most
    if not np.ptp(omega) > 0 or np.corrcoef(u, omega)[0, 1] < 0.8:
        raise RecordingError(path, "has a rotor speed that does not follow the command",
                             "check the columns")  # fmt: skip
    error = np.maximum(error, 0.5 * np.median(error))
    reference = given.reference_voltage or float(volts.max())
    if "voltage" in samples and not 0.5 < reference / float(volts.max()) < 2.0:
        what = f"holds {volts.min():.3g} to {volts.max():.3g} V, far from {reference:g} V"
        raise RecordingError(path, what, "give a reference_voltage of that battery")
    sags = "voltage" in samples and float(volts.max() / volts.min()) > MIN_VOLTAGE_RATIO
    ratio = volts / reference if "voltage" in samples else np.ones_like(u)
    straight = _fit_rpm_curve(u, omega, error, ratio, quadratic=False, sags=sags)
    bent = (
        _fit_rpm_curve(u, omega, error, ratio, quadratic=True, sags=sags)
        if len(u) > MIN_COMMANDS
        else None
    )
    curved = bent is not None and abs(bent[0][2]) > MIN_QUADRATIC_SIGMAS * math.sqrt(bent[1][2, 2])
    solution, covariance = bent if curved and bent is not None else straight
    remarks = [Remark("levels", {"levels": len(u), "outliers": dropped})]
    if "voltage" in samples:
        remarks.append(Remark("reference_voltage", {"voltage": reference}))
        if not sags:
            remarks.append(Remark("voltage_constant", {"ratio": float(volts.max() / volts.min())}))
    names = ["input_scaling", "zero_position_armed", "quadratic", "battery_exponent"]
    kept_names = [0, 1, *([2] if curved else []), *([3] if sags else [])]
    values = solution[kept_names].copy()
    matrix = covariance[np.ix_(kept_names, kept_names)].copy()
    if values[1] <= 0:
        raise RecordingError(path, f"gives {values[1]:.0f} rad/s at zero command",
                             "record slower steps, down to idle")  # fmt: skip
    slope = np.ones(len(values))
    slope[:2] = 1.0 / values[:2]  # the first two are searched by their logarithm
    values[:2] = np.log(values[:2])
    dense = np.linspace(u.min(), u.max(), 200)
    curves = (
        Curve.of(
            ("Steps used", "time, s", "rotor speed, rad/s"),
            (time, speed),
            (np.zeros(0), np.zeros(0)),
            used=used,
            law=False,
        ),
        Curve.of(
            (
                "Rotor speed against command",
                "command",
                "rotor speed at the reference voltage, rad/s",
            ),
            (u, omega / ratio ** solution[3]),
            (dense, solution[0] * dense + solution[2] * dense**2 + solution[1]),
        ),
    )
    return Measurement(
        name,
        tuple({names[index]: 1.0} for index in kept_names),
        values,
        matrix * np.outer(slope, slope),
        tuple(remarks),
        curves,
    )


def _fit_rpm_curve(
    u: Array, omega: Array, error: Array, ratio: Array, *, quadratic: bool, sags: bool
) -> tuple[Array, Array]:
    """Return a, c, b, γ and their covariance; those not fitted are zero."""
    places = [0, 1, *([2] if quadratic else []), *([3] if sags else [])]

    def residuals(free: Array) -> Array:
        p = np.zeros(4)
        p[places] = free
        return np.asarray(((p[0] * u + p[2] * u * u + p[1]) * ratio ** p[3] - omega) / error)

    line = np.polyfit(u, omega, 1)
    start = np.array([line[0], line[1], 0.0, 0.5])[places]
    solution = least_squares(residuals, start, x_scale=np.array([500.0, 100.0, 100.0, 0.5])[places])
    freedom = max(len(u) - len(places), 1)
    inverse = np.linalg.pinv(solution.jac.T @ solution.jac)
    small = widen(inverse, 2 * solution.cost, freedom)
    values, covariance = np.zeros(4), np.zeros((4, 4))
    values[places] = solution.x
    covariance[np.ix_(places, places)] = small
    return values, covariance
