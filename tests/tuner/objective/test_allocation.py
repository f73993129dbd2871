"""A commanded wrench becomes the commands whose rotors, by the vehicle file, give it."""

from dataclasses import replace

import numpy as np
import pytest

from tuner.core.shipped import configs_folder
from tuner.objective.rotor_signals import commands_of, levers, squared_speed, with_commands
from tuner.recordings.flight import Series
from tuner.recordings.notes import NoteCode
from tuner.vehicle import read_vehicle


@pytest.mark.parametrize("quadratic", [0.0, 200.0])
@pytest.mark.parametrize("name", ["crazyflie", "hovergames_updated"])
def test_rotors_at_the_commands_give_the_wrench(name, quadratic):
    vehicle = read_vehicle(configs_folder() / "vehicles" / f"{name}.yaml")
    motor = vehicle.motor.replace(quadratic=quadratic, input_offset=0.02)
    vehicle = vehicle.replace(motor=motor)
    weight, arm = 9.81 * vehicle.mass, abs(vehicle.rotors[0].position[1])
    rows = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 4))
    drag = vehicle.aerodynamics.moment_constant
    wrench = weight * (rows * [1.0, arm, arm, drag] + [1.0, 0.0, 0.0, 0.0])
    lift = vehicle.aerodynamics.motor_constant * squared_speed(
        vehicle, "command", commands_of(wrench, vehicle)
    )
    np.testing.assert_allclose(lift.sum(axis=1), wrench[:, 0], rtol=1e-9)
    np.testing.assert_allclose(lift @ levers(vehicle), wrench[:, 1:], atol=1e-9 * weight)


def test_only_a_flight_without_commands_gets_them(flight, updated):
    assert with_commands(flight, updated) is flight
    time = flight.series["position"].time
    series = {"commanded_thrust": Series(time, np.full((len(time), 1), 9.81 * updated.mass))}
    series["commanded_torque"] = Series(time, np.zeros((len(time), 3)))
    ones = {name: np.ones((len(flight.time), s.values.shape[1])) for name, s in series.items()}
    signals = {n: v for n, v in flight.signals.items() if n != "command"} | ones
    bare = replace(flight, series=dict(flight.series) | series, signals=signals)
    made = with_commands(bare, updated)
    command = made.signals["command"]
    assert made.notes[-1].code is NoteCode.COMMAND_DERIVED
    assert np.ptp(command[np.isfinite(command)]) < 1e-9
    assert command[10, 0] == pytest.approx((np.sqrt(9.81 * 2.243 / 4 / 1.45e-5) - 100) / 950)
