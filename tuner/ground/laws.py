"""The laws by which a rig's reading becomes a coefficient, each with its equation in the thesis.

Where the thesis's text slips, the law here is the corrected one, and its docstring names the slip.
Source: M. te Braake, "Improving the PX4 software-in-the-loop multirotor UAV simulator accuracy".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY


def bifilar_inertia(
    frequency: float, *, mass: float, wire_distance: float, wire_length: float
) -> float:
    """Return the moment of inertia, kg m², about the vertical axis of a bifilar pendulum.

    I = m g d² / (16 π² h f²) (Eq. 3.1), for swings so small that sin θ is θ, with f the undamped
    frequency in Hz, m in kg, the distance d between the wires and their length h in m.
    """
    return mass * GRAVITY * wire_distance**2 / (16 * math.pi**2 * wire_length * frequency**2)


def hover_motor_constant(mass: float, rotor_speed: float, rotors: int = 4) -> float:
    """Return the motor constant, N s²/rad², of a vehicle that hovers: m g = n k Ω² (6.4.1).

    Mass in kg, the rotors' common speed in rad/s. Two such hovers are Eq. 6.10.
    """
    return mass * GRAVITY / (rotors * rotor_speed**2)


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
