"""What is usual for a coefficient turns a small vehicle as much as a large one, to scale."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.environment import Air
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.rigid_body import Motion
from sim_jax.terms import total_wrench
from tuner.config import JobFile
from tuner.core.shipped import find_config
from tuner.objective.space import space_of
from tuner.vehicle import COEFFICIENTS, ControllerFile, VehicleFile, read_vehicle, with_values
from tuner.vehicle.model import model_of
from tuner.vehicle.vehicle import Size, scaled_to_size, size_of

SMALL = Size(mass=0.015, arm=0.2)
LINEAR = [
    row for row in COEFFICIENTS.values() if row.is_effect and row.scale == "linear" and row.group
]


@pytest.fixture(scope="module")
def large() -> VehicleFile:
    return read_vehicle(find_config("vehicles", "hovergames", Path()))


def scaled(vehicle: VehicleFile, size: Size) -> VehicleFile:
    """Return a vehicle in proportion: its rotors turn quicker as all times are shorter."""
    turns = size.mass * size.arm**2
    rotors = tuple(
        rotor.replace(position=tuple(size.arm * x for x in rotor.position))
        for rotor in vehicle.rotors
    )
    air = vehicle.aerodynamics
    fastest = air.max_relative_airspeed * size.arm**0.5
    return with_values(
        vehicle.replace(rotors=rotors, aerodynamics=air.replace(max_relative_airspeed=fastest)),
        {
            "mass": vehicle.mass * size.mass,
            "inertia_xx": vehicle.inertia.xx * turns,
            "inertia_yy": vehicle.inertia.yy * turns,
            "inertia_zz": vehicle.inertia.zz * turns,
            "motor_constant": air.motor_constant * size.mass * size.arm,
            "moment_constant": air.moment_constant * size.arm,
            "rotor_drag_coefficient": air.rotor_drag_coefficient * size.mass,
            "rolling_moment_coefficient": air.rolling_moment_coefficient * size.mass * size.arm,
        },
    )


def acting(vehicle: VehicleFile, size: Size) -> np.ndarray:
    """Return force over weight, and moment over weight and arm, in proportionate motion."""
    slow = size.arm**0.5
    motion = Motion(
        position=Vec3(*map(jnp.asarray, (0.0, 0.0, 5.0 * size.arm))),
        velocity=Vec3(*(jnp.asarray(v * slow) for v in (2.0, -1.0, 0.5))),
        attitude=Quaternion.of(jnp.asarray([0.99, 0.1, -0.05, 0.08])).normalized(),
        body_rate=Vec3(*(jnp.asarray(w / slow) for w in (1.0, -2.0, 3.0))),
    )
    speeds = tuple(jnp.asarray(s / slow) for s in (600.0, 640.0, 580.0, 620.0))
    changes = tuple(jnp.asarray(a / size.arm) for a in (300.0, -200.0, 500.0, 100.0))
    flown = model_of(vehicle, ControllerFile()).vehicle
    wrench = total_wrench(
        flown, motion, speeds, Air.around(flown, motion, rotor_acceleration=changes)
    )
    force, moment = (np.asarray(v.stacked()) for v in (wrench.force, wrench.moment))
    return np.concatenate([force / size.mass, moment / (size.mass * size.arm)])


@pytest.mark.parametrize("row", LINEAR, ids=lambda row: row.name)
def test_a_usual_coefficient_acts_on_a_small_vehicle_as_on_a_large_one(large, row) -> None:
    small = scaled(large, SMALL)
    of_large, of_small = (scaled_to_size(row, size_of(vehicle)) for vehicle in (large, small))
    expected = acting(with_values(large, {row.name: of_large.step}), Size())
    found = acting(with_values(small, {row.name: of_small.step}), SMALL)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    for name in ("prior_sd", "step"):
        assert getattr(of_small, name) / getattr(row, name) == pytest.approx(
            of_small.bounds[1] / row.bounds[1]
        )


def test_the_tables_numbers_are_those_of_the_vehicle_a_fit_starts_from(large) -> None:
    assert size_of(large).mass == 1.0
    assert size_of(large).arm == pytest.approx(1.0, rel=1e-4)


def test_about_up_what_blades_take_is_usual(large) -> None:
    """A rotor's drag torque goes with its turns against the air, to which the body's turn adds."""
    air, turn = large.aerodynamics, 1e-3
    hover = np.sqrt(large.mass * 9.81 / (4.0 * air.motor_constant))
    damping = sum(
        air.moment_constant * air.motor_constant * sense * (hover + sense * turn) ** 2
        for sense in (1.0, -1.0, 1.0, -1.0)
    )
    usual = COEFFICIENTS["angular_drag_z"].prior_sd
    assert 0.7 * usual < damping / turn < 1.4 * usual


def test_a_small_vehicles_drag_is_known_by_its_own_size(large) -> None:
    job = JobFile(free=("angular_drag_x", "motor_constant"))
    small, usual = (
        space_of(vehicle, ControllerFile(), job).parameters
        for vehicle in (scaled(large, SMALL), large)
    )
    names = [parameter.name for parameter in small]
    drag, constant = names.index("angular_drag_x"), names.index("motor_constant")
    assert small[constant].usual == usual[constant].usual == 0.0
    assert small[drag].usual == small[drag].prior_sd < 2e-3 * usual[drag].usual
