"""The thesis's own numbers from its own inputs."""

import math

import numpy as np
import pytest

from tuner.ground.hovers import (
    fast_pair_speed,
    hover_motor_constant,
    propeller_moment_constant,
    propeller_motor_constant,
    spin_drag_over_torque,
)
from tuner.ground.rigs import bifilar_inertia

MASS, RADIUS, THRUST, TORQUE = 2.243, 0.25, 1.45e-5, 0.033


def test_a_bifilar_pendulum_swings_as_its_inertia_says():
    # small-angle pendulum: I θ'' = -m g d²/(4 h) θ
    inertia, distance, length = 0.028, 0.34, 1.14
    stiffness = MASS * 9.81 * distance**2 / (4 * length)
    frequency = math.sqrt(stiffness / inertia) / (2 * math.pi)
    measured = bifilar_inertia(frequency, mass=MASS, wire_distance=distance, wire_length=length)
    assert measured == pytest.approx(inertia, rel=1e-12)


def test_a_hover_gives_the_motor_constant_of_the_thesis():
    assert hover_motor_constant(2.243, 616) == pytest.approx(1.45e-5, rel=0.001)
    assert hover_motor_constant(2.343, 629) == pytest.approx(1.45e-5, rel=0.005)


@pytest.mark.parametrize(("rate", "slow"), [(2.0, 599.0), (3.0, 586.0), (4.0, 571.0)])
def test_yaw_spins_give_the_rotor_drag_of_the_thesis(rate, slow):
    fast = fast_pair_speed(slow, mass=MASS, motor_constant=THRUST)
    ratio = spin_drag_over_torque(rate, slow, fast, radius=RADIUS)
    assert 1.2e-4 < float(ratio) * TORQUE * THRUST < 1.7e-4


def test_the_fast_pair_is_the_text_s_and_not_that_of_equation_8_4():
    fast = float(fast_pair_speed(599.0, mass=MASS, motor_constant=THRUST))
    assert fast == pytest.approx(632, abs=1)
    from_text = float(spin_drag_over_torque(2.0, 599.0, 632.0, radius=RADIUS)) * TORQUE * THRUST
    from_slip = float(spin_drag_over_torque(2.0, 599.0, 643.0, radius=RADIUS)) * TORQUE * THRUST
    assert from_text == pytest.approx(1.263e-4, rel=0.01)
    assert from_slip == pytest.approx(1.684e-4, rel=0.01)


def test_a_propeller_s_torque_per_thrust_has_its_diameter_to_the_first_power():
    thrust, power, density = 0.1, 0.05, 1.225
    speed = 600.0
    turns = speed / (2 * math.pi)
    for diameter in (0.1, 0.2794):
        force = thrust * density * turns**2 * diameter**4
        torque = power * density * turns**3 * diameter**5 / speed
        per_square = propeller_motor_constant(thrust, diameter=diameter, density=density)
        assert per_square * speed**2 == pytest.approx(force)
        ratio = propeller_moment_constant(thrust, power, diameter=diameter)
        assert ratio == pytest.approx(torque / force)
        slip = ratio * diameter**3  # Eq. 7.9 of the thesis
        assert not np.isclose(slip, torque / force)
