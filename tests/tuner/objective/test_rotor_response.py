"""Rotor speeds that follow commands, against the solution of their lag's equation."""

import numpy as np
import pytest

from lanes.program import _program_of
from tuner.objective.rotor_response import MotorLags, rotor_speeds
from tuner.vehicle import ControllerFile
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
