"""Rotor speeds that follow commands, against the solution of their lag's equation."""

from dataclasses import replace

import numpy as np
import pytest

from lanes.program import _program_of
from tuner.core.shipped import configs_folder
from tuner.objective.rotor_response import MotorLags, rotor_speeds
from tuner.objective.rotor_signals import (
    commands_of,
    levers,
    rotor_limit,
    squared_speed,
    with_commands,
)
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


# rotors that stop at a limit


@pytest.mark.parametrize(
    ("limit", "lag", "highest", "found"),
    [
        (720.0, 0.02, 1.0, 720.0),
        (1100.0, 0.02, 1.0, None),  # at full command they are there
        (720.0, 0.02, 0.6, None),  # nothing asks for more
        (2000.0, 0.15, 1.0, None),  # slow rotors are on their way
    ],
)
def test_rotors_that_stop_whatever_more_is_commanded_show_their_limit(
    flight, limit, lag, highest, found
):
    random, rate = np.random.default_rng(0), 100.0
    time = np.arange(0.0, flight.duration, 1.0 / rate)
    levels = np.clip(0.55 + 0.15 * random.normal(size=(len(time) // 30 + 1, 4)), 0.3, highest)
    levels[::8] = highest
    command = levels.repeat(30, axis=0)[: len(time)]
    share, speed = 1.0 - np.exp(-1.0 / rate / lag), 100.0 + 1000.0 * command
    speed = np.minimum(speed, limit)
    for row in range(1, len(speed)):
        speed[row] = speed[row - 1] + share * (speed[row] - speed[row - 1])
    speed = speed + 2.0 * random.normal(size=speed.shape)
    series = {"command": Series(time, command), "rotor_speed": Series(time, speed)}
    seen = rotor_limit([replace(flight, series=series)])
    assert seen == (None if found is None else pytest.approx(found, rel=0.01))
    assert rotor_limit([replace(flight, series={"command": series["command"]})]) is None
