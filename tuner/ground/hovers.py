"""Hovers with weights and steady yaw spins: what the balance of force and torque says.

Equations are those of the thesis; where its text slips, the law here is the corrected one, and its
docstring names the slip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from tuner.core.errors import ConfigError
from tuner.ground.measurement import Curve, Measurement, Remark


def hover_motor_constant(mass: float, rotor_speed: float, rotors: int = 4) -> float:
    """Return the motor constant, N s²/rad², of a vehicle that hovers: m g = n k Ω² (6.4.1).

    Mass in kg, the rotors' common speed in rad/s. Two such hovers are Eq. 6.10.
    """
    return mass * GRAVITY / (rotors * rotor_speed**2)


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


def hover_weights(
    name: str,
    points: Sequence[tuple[float, float]],
    *,
    rotors: int,
    mass_error: float,
    rotor_speed_error: float,
) -> Measurement:
    """Return the motor constant from hovers of (mass kg, rotor speed rad/s): m g = n k Ω² (6.4.1).

    Parameters
    ----------
    mass_error, rotor_speed_error
        Standard errors of one point, kg and rad/s; where three and more points scatter by more,
        their scatter counts.
    """
    mass, speed = (np.array(column, float) for column in zip(*points, strict=True))
    values = np.log([hover_motor_constant(m, w, rotors) for m, w in points])
    variance = (mass_error / mass) ** 2 + (2 * rotor_speed_error / speed) ** 2
    weight = 1.0 / variance
    mean = float(weight @ values / weight.sum())
    error2 = 1.0 / float(weight.sum())
    freedom = len(points) - 1
    if freedom >= 2:
        birge = float(weight @ (values - mean) ** 2) / freedom
        error2 *= max(1.0, birge)
    weights = np.linspace(0.95 * mass.min(), 1.05 * mass.max(), 50)
    speeds = np.sqrt(weights * GRAVITY / (rotors * math.exp(mean)))
    titles = ("Hover", "mass, kg", "rotor speed, rad/s")
    curve = Curve.of(titles, (mass, speed), (weights, speeds))
    return Measurement(
        name, ({"motor_constant": 1.0},), np.array([mean]), np.array([[error2]]),
        (Remark("points", {"points": len(points)}),), (curve,),
    )  # fmt: skip


def yaw_spin(
    name: str,
    points: Sequence[tuple[float, float, float | None]],
    *,
    mass: float,
    radius: float,
    motor_constant: float,
    rotor_speed_error: float,
) -> Measurement:
    """Return the relation of rotor drag to torque from spins of (yaw rate, slow pair, fast pair).

    rotor_drag_coefficient / (moment_constant · motor_constant) = (Ω_fast - Ω_slow)/(ω r²)
    (Eq. 8.3, see `spin_drag_over_torque`). Where the fast pair was not measured it follows from
    the weight and the motor constant, on which the relation then depends.

    Parameters
    ----------
    points
        Yaw rate rad/s, speed of the slow pair rad/s, and of the fast pair or None.
    mass, radius
        kg, and m from the yaw axis to each rotor.
    motor_constant
        N s²/rad², where the fast pair's speed is linearised.
    rotor_speed_error
        Standard error of one speed, rad/s.

    Raises
    ------
    ConfigError
        The fast pair is slower than the slow one.
    """
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
        variances.append((spread * rotor_speed_error / (quick - slow)) ** 2)
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
        (Remark("points", {"points": len(points)}),), (curve,),
    )  # fmt: skip
