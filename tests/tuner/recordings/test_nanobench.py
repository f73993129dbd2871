"""Real Crazyflie flights, where they lie beside the checkout: the map's order, signs and units."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tuner.core.shipped import find_config
from tuner.recordings.flight import Flight
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.interpolation import body_rate_of, correlation, smooth
from tuner.recordings.loader import load_flight
from tuner.vehicle import read_vehicle

REAL = Path(os.environ.get("TUNE_REAL_FLIGHTS", Path(__file__).parents[4] / "shared" / "flights"))
FILES = sorted((REAL / "nanobench").glob("*.csv"))

pytestmark = pytest.mark.skipif(not FILES, reason=f"no real flights in {REAL}")


@pytest.fixture(scope="module", params=FILES, ids=lambda path: path.stem)
def flight(request: pytest.FixtureRequest) -> Flight:
    return load_flight(request.param, cache=False)


def test_the_flown_part_is_whole(flight: Flight) -> None:
    assert 15 < flight.duration < 40
    for name in ("position", "attitude", "body_rate", "acceleration", "command", "velocity"):
        assert np.isfinite(flight.signals[name]).all(), name
    command = flight.signals["command"]
    assert command.min() > 0.2
    assert command.max() <= 1.0
    assert flight.signals["position"][:, 2].min() > 0.15
    assert np.isfinite(flight.initial.command).all()
    assert not [note for note in flight.notes if note.kind == "warning"]


def test_gyro_and_attitude_agree(flight: Flight) -> None:
    turning = smooth(body_rate_of(flight.signals["attitude"]), 0.1)
    assert correlation(turning, smooth(flight.signals["body_rate"], 0.1)) > 0.7


def test_specific_force_is_in_si(flight: Flight) -> None:
    assert flight.signals["acceleration"][:, 2].mean() == pytest.approx(9.81, rel=0.02)


def test_motors_in_px4_order_turn_the_vehicle_the_right_way(flight: Flight) -> None:
    """More thrust on the left rolls it right, at the back dips the nose; cw rotors turn it ccw."""
    command = smooth(flight.signals["command"], 0.05)
    right_front, left_rear, left_front, right_rear = command.T
    torque = np.column_stack(
        [
            left_rear + left_front - right_front - right_rear,
            left_rear + right_rear - right_front - left_front,
            left_front + right_rear - right_front - left_rear,
        ]
    )
    turned = np.gradient(smooth(flight.signals["body_rate"], 0.05), 0.01, axis=0)
    for axis in range(3):
        late = max(
            correlation(torque[: len(torque) - lag, [axis]], turned[lag:, [axis]])
            for lag in range(8)
        )
        assert late > 0.15, axis


def test_the_shipped_vehicle_nearly_hovers(flight: Flight) -> None:
    vehicle = read_vehicle(find_config("vehicles", "crazyflie", Path()))
    motor, rotor = vehicle.motor, vehicle.aerodynamics.motor_constant
    speed = motor.input_scaling * flight.signals["command"] + motor.zero_position_armed
    thrust = float((rotor * speed**2).sum(axis=1).mean())
    assert thrust == pytest.approx(9.81 * vehicle.mass, rel=0.2)


def test_inspection_names_the_inlet(flight: Flight) -> None:
    (inspection,), errors = inspect_recordings([flight.path], cache=False)
    assert errors == ()
    assert inspection.topic_map == "crazyflie"
    assert {inlet.name for inlet in inspection.inlets if not inlet.missing} >= {"actuator"}
    assert inspection.battery is not None
    assert 3.0 < min(inspection.battery) < max(inspection.battery) < 4.3
