"""Rotor speeds that follow commands, against the solution of their lag's equation."""

from dataclasses import replace

import numpy as np
import pytest

from lanes.program import _program_of
from tuner.core.shipped import configs_folder
from tuner.objective.rotor_response import MotorLags, rotor_speeds
from tuner.objective.rotor_signals import commands_of, levers, squared_speed, with_commands
from tuner.recordings.flight import Series
from tuner.recordings.notes import NoteCode
from tuner.vehicle import ControllerFile, read_vehicle
from tuner.vehicle.model import model_of

STEP = 0.0025
LAGS = MotorLags(up=0.02, down=0.05, delay=0.004)


@pytest.fixture(scope="module")
def motor(updated):
    return model_of(updated, ControllerFile()).vehicle.motor


@pytest.mark.parametrize(("low", "high", "lag"), [(0.3, 0.5, LAGS.up), (0.6, 0.4, LAGS.down)])
def test_a_step_of_the_command_is_followed_late_and_with_its_own_lag(low, high, lag, motor):
    command = np.full((200, 4), 0.5)
    command[:, 1] = np.where(np.arange(200) < 80, low, high)
    speeds = rotor_speeds(command, STEP, motor, LAGS)
    begin, end = (float(motor.input_scaling * c + motor.zero_position_armed) for c in (low, high))
    # one step of the command's mean holds both: of the latency's 1.6 steps, 0.4 of the second act
    mean = begin + 0.4 * (end - begin)
    first = mean + (begin - mean) * np.exp(-STEP / lag)
    since = np.arange(200) * STEP - 82 * STEP
    want = np.where(since < 0.0, begin, end + (first - end) * np.exp(-np.maximum(since, 0.0) / lag))
    np.testing.assert_allclose(speeds[:, 1], want, rtol=1e-12)
    np.testing.assert_allclose(speeds[:, 0], speeds[0, 0], rtol=1e-12)


def test_rotors_begin_settled_at_the_first_command_alone(motor):
    command = np.full((10, 4), 0.6)
    command[0] = 0.3
    speeds = rotor_speeds(command, STEP, motor, MotorLags(up=0.02, down=0.05, delay=0.0))
    np.testing.assert_allclose(speeds[0], motor.input_scaling * 0.3 + motor.zero_position_armed)
    assert (np.diff(speeds[1:], axis=0) > 0.0).all()


def test_a_flight_of_another_length_is_the_same_program(motor):
    rotor_speeds(np.full((30, 4), 0.5), STEP, motor, LAGS)
    before = _program_of.cache_info().misses
    assert rotor_speeds(np.full((57, 4), 0.5), STEP, motor, LAGS).shape == (57, 4)
    assert _program_of.cache_info().misses == before


# a commanded wrench becomes the commands whose rotors, by the vehicle file, give it


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
