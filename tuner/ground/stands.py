"""Stepwise experiments: force by squared rotor speed (6.3, 7.3), and rotor speed by command."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.optimize import least_squares

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array, scaled_inverse
from tuner.ground.measurement import Curve, Measurement, Remark
from tuner.ground.plan import RpmCurve, ThrustStand, TorqueStand
from tuner.ground.rig_data import mean_and_error, usable_plateaus, widen
from tuner.vehicle import VehicleFile
from tuner.vehicle.vehicle import REFERENCE_ARM, size_of

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
    levels, level_error, measured, force_error = np.array(
        [(*mean_and_error(speed[at]), *mean_and_error(force[at])) for _, at in parts]
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
MIN_VOLTAGE_RATIO = 1.015
"""With a smaller ratio of highest to lowest voltage its exponent is not fitted."""
MIN_QUADRATIC_SIGMAS = 3.0
"""A quadratic term with fewer standard errors is not significant."""


def measure_rpm_curve(
    name: str, path: str, samples: Mapping[str, Array], given: RpmCurve
) -> Measurement:
    """Return input scaling, zero position and, if significant, curvature and exponent.

    Ω = (a u + b u² + c) (V/V_ref)^γ (Eq. 4.2, 4.4.1), one point for the middle of every step.

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
    points = [
        (float(np.mean(command[at])), *mean_and_error(speed[at]), float(np.mean(battery[at])))
        for _, at in parts
    ]
    if len({round(point[0] / COMMAND_STEP) for point in points}) < MIN_COMMANDS:
        what = f"holds {len(points)} steady steps of the command of {MIN_COMMAND_S:g} s and more"
        raise RecordingError(
            path, what, f"record {MIN_COMMANDS} or more commands, each for seconds"
        )
    u, omega, error, volts = (np.array(column) for column in zip(*points, strict=True))
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
