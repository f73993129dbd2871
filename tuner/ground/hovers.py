"""Hovers with weights, steady yaw spins by balances of force and torque, and published propellers.

Equations are those of the thesis; docstrings name its slips, which are corrected here. A
propeller's published coefficients are a wide prior: theory was 60 % high in the thesis (6.2).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from tuner.core.disk import read_bytes
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.numerics import Array
from tuner.ground.measurement import Curve, Measurement, Remark, rotor_radius
from tuner.ground.plan import MAX_SPIN_RATE, MIN_SPIN_RATE, HoverWeights, Propeller, YawSpins
from tuner.ground.rig_data import recording_path, steady_flight
from tuner.vehicle import VehicleFile


def hover_motor_constant(
    mass: NDArray[np.float64] | float, rotor_speed: NDArray[np.float64] | float, rotors: int = 4
) -> NDArray[np.float64]:
    """Return the motor constant, N s²/rad², of a vehicle that hovers: m g = n k Ω² (6.4.1).

    Mass in kg, the rotors' common speed in rad/s. Two such hovers are Eq. 6.10.
    """
    return np.asarray(mass * GRAVITY / (rotors * np.square(rotor_speed)))


def fast_pair_speed(
    slow: NDArray[np.float64] | float, *, mass: float, motor_constant: float
) -> NDArray[np.float64]:
    """Return the speed, rad/s, of the faster pair of four rotors in a level spin, from the weight.

    m g = 2 k (Ω_slow² + Ω_fast²). At 599 rad/s of the slow pair of the thesis's vehicle (2.243 kg,
    1.45e-5 N s²/rad²) it is 632 rad/s, as its text computes; its Eq. 8.4 then uses 643.
    """
    square = mass * GRAVITY / (2 * motor_constant) - np.square(slow)
    return np.sqrt(np.maximum(square, 0.0))


def spin_drag_over_torque(
    yaw_rate: NDArray[np.float64] | float,
    slow: NDArray[np.float64] | float,
    fast: NDArray[np.float64] | float,
    *,
    radius: float,
) -> NDArray[np.float64]:
    """Return rotor_drag_coefficient / (moment_constant · motor_constant), rad s/m², of a spin.

    In a steady level spin at ω the drag of four rotors at a distance r from the axis, each
    c Ω (ω r) r, balances the difference of their drag torques (Eq. 8.3 without its small-angle
    shortcuts): c ω r² 2(Ω_s + Ω_f) = k_M k_F 2(Ω_f² - Ω_s²), so that
    c/(k_M k_F) = (Ω_f - Ω_s)/(ω r²).
    Speeds in rad/s, radius in m.
    """
    return np.asarray((np.asarray(fast) - np.asarray(slow)) / (np.asarray(yaw_rate) * radius**2))


def measure_hover_weights(
    name: str, given: HoverWeights, vehicle: VehicleFile, folder: Path
) -> Measurement:
    """Return the motor constant from hovers of mass m and rotor speed Ω: m g = n k Ω² (6.4.1).

    Parameters
    ----------
    given
        The hovers, and the standard errors of one; a larger scatter of three and more replaces
        them.
    vehicle
        Gives the number of rotors.
    folder
        From which paths of recordings count.

    Raises
    ------
    RecordingError
        A recording cannot be read, or shows no steady hover.
    """
    speeds, curves, rotors = list[float](), list[Curve](), len(vehicle.rotors)
    for point in given.points:
        if point.rotor_speed is not None:
            speeds.append(point.rotor_speed)
            continue
        rotor_speed, _, curve = steady_flight(recording_path(folder, point.recording))
        speeds.append(float(np.sqrt(np.mean(rotor_speed**2))))  # thrust goes with the square
        curves.append(curve)
    mass, speed = np.array([point.mass for point in given.points]), np.array(speeds)
    values = np.log(hover_motor_constant(mass, speed, rotors))
    variance = (given.mass_error / mass) ** 2 + (2 * given.rotor_speed_error / speed) ** 2
    weight = 1.0 / variance
    mean = float(weight @ values / weight.sum())
    error2 = 1.0 / float(weight.sum())
    freedom = len(values) - 1
    if freedom >= 2:
        birge = float(weight @ (values - mean) ** 2) / freedom
        error2 *= max(1.0, birge)
    weights = np.linspace(0.95 * mass.min(), 1.05 * mass.max(), 50)
    law = np.sqrt(weights * GRAVITY / (rotors * math.exp(mean)))
    titles = ("Hover", "mass, kg", "rotor speed, rad/s")
    curve = Curve.of(titles, (mass, speed), (weights, law))
    return Measurement(
        name, ({"motor_constant": 1.0},), np.array([mean]), np.array([[error2]]),
        (Remark("points", {"points": len(values)}),), (curve, *curves),
    )  # fmt: skip


def measure_yaw_spin(name: str, given: YawSpins, vehicle: VehicleFile, folder: Path) -> Measurement:
    """Return the relation of rotor drag to torque from spins: yaw rate, slow pair, fast pair.

    rotor_drag_coefficient / (moment_constant · motor_constant) = (Ω_fast - Ω_slow)/(ω r²)
    (Eq. 8.3, see `spin_drag_over_torque`). An unmeasured fast pair follows from the weight and the
    motor constant, on which the relation then depends.

    Parameters
    ----------
    given
        The spins, and the standard error of one speed.
    vehicle
        Its mass and rotors, and the motor constant at which the fast pair's speed is linearised.
    folder
        From which paths of recordings count.

    Raises
    ------
    ConfigError
        The vehicle has more rotors than four, or the fast pair is slower than the slow one.
    RecordingError
        A recording cannot be read, or shows no steady spin.
    """
    if not vehicle.is_quad:
        raise ConfigError(name, "needs a vehicle of four rotors", "leave it out")
    points, curves = list[tuple[float, float, float | None]](), list[Curve]()
    for point in given.points:
        if point.yaw_rate is not None and point.rotor_speed_slow is not None:
            points.append((point.yaw_rate, point.rotor_speed_slow, point.rotor_speed_fast))
            continue
        path = recording_path(folder, point.recording)
        rotor_speed, yaw_rate, curve = steady_flight(path)
        if not MIN_SPIN_RATE <= abs(yaw_rate) <= MAX_SPIN_RATE:
            raise RecordingError(path, "does not yaw, or has no body rate", "spin it steadily")
        pairs = sorted((rotor_speed[:2].mean(), rotor_speed[2:].mean()))
        points.append((yaw_rate, float(pairs[0]), float(pairs[1])))
        curves.append(curve)
    mass, radius = vehicle.mass, rotor_radius(vehicle)
    motor_constant = vehicle.aerodynamics.motor_constant
    rows, values, variances = [], [], []
    for rate, slow, fast in points:
        weighed = fast is None
        quick = (
            float(fast_pair_speed(slow, mass=mass, motor_constant=motor_constant))
            if weighed
            else float(fast or 0)
        )
        if quick <= slow:
            what = f"has a fast pair at {quick:.0f} rad/s and a slow pair at {slow:.0f} rad/s"
            remedy = "check the speeds, the mass and the motor constant"
            raise ConfigError(name, what, remedy)
        value = math.log(float(spin_drag_over_torque(abs(rate), slow, quick, radius=radius)))
        follows = 0.0
        spread = math.sqrt(2.0)
        if weighed:
            # dΩ_fast/dlog k of the weight's balance, and dΩ_fast/dΩ_slow = -Ω_slow/Ω_fast
            follows = -(mass * GRAVITY / (2 * motor_constant)) / (2 * quick) / (quick - slow)
            spread = 1.0 + slow / quick
        rows.append(
            {
                "rotor_drag_coefficient": 1.0,
                "moment_constant": -1.0,
                "motor_constant": -1.0 - follows,
            }
        )
        values.append(value - follows * math.log(motor_constant))
        variances.append((spread * given.rotor_speed_error / (quick - slow)) ** 2)
    rates = np.array([abs(point[0]) for point in points])
    ratios = np.array([
        math.exp(v + (-1 - r["motor_constant"]) * math.log(motor_constant))
        for v, r in zip(values, rows, strict=True)
    ])  # fmt: skip
    mean = float(np.exp(np.log(ratios).mean()))
    titles = ("Steady spin", "yaw rate, rad/s", "rotor drag over torque constant, rad s/m²")
    curve = Curve.of(titles, (rates, ratios), (rates, np.full(len(points), mean)))
    return Measurement(
        name, tuple(rows), np.array(values), np.diag(variances),
        (Remark("points", {"points": len(points)}),), (curve, *curves),
    )  # fmt: skip


THRUST_PRIOR_SD = 0.4
"""Of the logarithm of thrust: propellers on a vehicle differ so much from their table."""
TORQUE_RATIO_PRIOR_SD = 0.3
"""Of the logarithm of torque over thrust, in which part of the error cancels."""
MAX_BYTES = 1_000_000


def propeller_motor_constant(
    thrust_coefficient: float, *, diameter: float, density: float
) -> float:
    """Return the motor constant, N s²/rad²: C_T ρ D⁴/(2π)² (Eq. 6.8, 6.9).

    C_T is referred to revolutions per second, as propeller tables have it; D in m, ρ in kg/m³.
    """
    return thrust_coefficient * density * diameter**4 / (2 * math.pi) ** 2


def propeller_moment_constant(
    thrust_coefficient: float, power_coefficient: float, *, diameter: float
) -> float:
    """Return the moment constant, m: C_P D/(2π C_T) (Eq. 7.5, 7.7), D in m.

    Torque is power over speed, C_P ρ n³ D⁵/(2π n), and thrust C_T ρ n² D⁴: their ratio has D to the
    first power. Eq. 7.9 of the thesis carries D⁴ where Eq. 7.5 has D, which is a slip.
    """
    return power_coefficient * diameter / (2 * math.pi * thrust_coefficient)


def read_static_table(path: Path) -> Array:
    """Return (n, 3) RPM, C_T and C_P of a static table of UIUC's propeller data site.

    Raises
    ------
    RecordingError
        The file cannot be read or holds no such rows.
    """
    try:
        text = read_bytes(path, most=MAX_BYTES, remedy="give the propeller's static table")
    except ConfigError as error:
        raise RecordingError(path, error.what, error.remedy) from None
    rows = []
    for line in text.decode(errors="replace").splitlines():
        try:
            numbers = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            continue
        if len(numbers) >= 3 and all(math.isfinite(n) for n in numbers[:3]):
            rows.append(numbers[:3])
    table = np.array(rows)
    plausible = len(rows) > 0 and bool(
        (table[:, 0] > 200).all() and (table[:, 1:] > 0).all() and (table[:, 1:] < 1).all()
    )
    if not plausible:
        raise RecordingError(path, "holds no rows of RPM, CT and CP", "give a static table")
    return table


def measure_propeller(name: str, given: Propeller, folder: Path) -> Measurement:
    """Return motor and moment constant of a propeller from C_T and C_P, or medians of a table.

    Parameters
    ----------
    folder
        A table's path is relative to it.

    Raises
    ------
    RecordingError
        The table cannot be read, or is none.
    """
    curves: tuple[Curve, ...] = ()
    thrust, power = given.thrust_coefficient, given.power_coefficient
    if thrust is None or power is None:
        speeds, *columns = read_static_table(recording_path(folder, given.table)).T
        thrust, power = (float(np.median(column)) for column in columns)
        titles = ("Propeller table", "RPM", "thrust coefficient")
        curve = Curve.of(titles, (speeds, columns[0]), (speeds, np.full(len(speeds), thrust)))
        curves = (curve,)
    values = np.log([
        propeller_motor_constant(thrust, diameter=given.diameter, density=given.air_density),
        propeller_moment_constant(thrust, power, diameter=given.diameter),
    ])  # fmt: skip
    return Measurement(
        name,
        ({"motor_constant": 1.0}, {"moment_constant": 1.0}),
        values,
        np.diag([THRUST_PRIOR_SD**2, TORQUE_RATIO_PRIOR_SD**2]),
        (Remark("theory", {"thrust_coefficient": thrust, "power_coefficient": power}),),
        curves,
    )
