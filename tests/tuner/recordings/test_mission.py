"""The flown part of a recording is found by whatever was recorded."""

from __future__ import annotations

import numpy as np
import pytest

from tuner.recordings.flight import Series
from tuner.recordings.missions import YawSpin, airborne, find_missions, yaw_spin

TIME = np.arange(0, 40, 0.01)


def series(values: np.ndarray, time: np.ndarray = TIME) -> Series:
    return Series(time, values if values.ndim == 2 else values[:, None])


def flight(*, climb: float = 5.0, land: float = 35.0) -> dict[str, Series]:
    """Stand for five seconds, climb a metre in one, land again; with a little noise."""
    height = np.clip(TIME - climb, 0, 1) - np.clip(TIME - land, 0, 1)
    noise = np.random.default_rng(0).normal(0, 3e-4, (len(TIME), 3))
    return {
        "position": series(np.column_stack([0 * TIME, 0 * TIME, 0.05 + height]) + noise),
        "attitude": series(np.tile([1.0, 0, 0, 0], (len(TIME), 1))),
    }


def test_height_alone_distinguishes_flight_from_ground() -> None:
    (mission,) = find_missions(flight())
    assert mission.start == pytest.approx(5.12, abs=0.05)
    assert mission.end == pytest.approx(35.88, abs=0.05)
    assert mission.begins_with == "flight"


def test_motors_that_report_only_when_armed() -> None:
    armed = (TIME > 4) & (TIME < 37)
    command = np.where((TIME > 5) & (TIME < 36), 0.5, 0.05)
    signals = flight() | {"command": series(np.tile(command[armed, None], 4), TIME[armed])}
    (mission,) = find_missions(signals)
    assert mission.start == pytest.approx(5.12, abs=0.05)
    assert mission.end == pytest.approx(35.88, abs=0.05)


def test_a_hover_is_no_ground() -> None:
    signals = flight(climb=-10, land=100)
    assert airborne(signals) == [(TIME[0], TIME[-1])]
    up_and_away = np.column_stack([0 * TIME, 0 * TIME, 1 + np.clip(TIME - 20, 0, 2)])
    signals["position"] = series(up_and_away)
    signals["command"] = series(np.full((len(TIME), 4), 0.5))
    assert airborne(signals) == [(TIME[0], TIME[-1])]


def test_set_points_that_begin_on_the_ground_wait_for_the_reference() -> None:
    after = TIME[TIME > 3]
    reference = np.column_stack([0 * TIME, np.clip(TIME - 12, 0, None), np.ones_like(TIME)])
    signals = flight() | {
        "rate_setpoint": series(np.zeros((len(after), 3)), after),
        "reference_position": series(reference),
    }
    (mission,) = find_missions(signals)
    assert mission.start == pytest.approx(12.0, abs=0.02)
    assert mission.begins_with == "the reference's motion"


def test_set_points_that_begin_in_the_air_start_the_mission() -> None:
    during = TIME[(TIME > 10) & (TIME < 30)]
    signals = flight() | {"rate_setpoint": series(np.zeros((len(during), 3)), during)}
    (mission,) = find_missions(signals)
    assert (mission.start, mission.end) == pytest.approx((10.01, 29.99), abs=0.011)
    assert mission.begins_with == "attitude set-points"


def test_two_flights_with_a_landing_between() -> None:
    height = np.clip(TIME - 2, 0, 1) - np.clip(TIME - 15, 0, 1)
    height += np.clip(TIME - 20, 0, 1) - np.clip(TIME - 36, 0, 1)
    signals = flight() | {"position": series(np.column_stack([0 * TIME, 0 * TIME, height]))}
    command = np.where(height > 0, 0.5, 0.0)
    signals["command"] = series(np.tile(command[:, None], 4))
    first, second = find_missions(signals)
    assert (first.start, first.end) == pytest.approx((2.12, 15.88), abs=0.05)
    assert (second.start, second.end) == pytest.approx((20.12, 36.88), abs=0.05)


def test_what_never_flies_has_no_mission() -> None:
    signals = flight(climb=100, land=200) | {"command": series(np.zeros((len(TIME), 4)))}
    assert find_missions(signals) == ()


@pytest.mark.parametrize(
    ("rates", "expected"),
    [
        (np.tile([0.0, 0.0, -2.5], (len(TIME), 1)), YawSpin(-2.5, level_held=False)),
        (
            np.column_stack([0.1 * np.sin(TIME), 0.1 * np.cos(TIME), 0 * TIME + 3]),
            YawSpin(3.0, level_held=True),
        ),
        (np.tile([0.0, 0.0, 0.0], (len(TIME), 1)), None),
        (np.tile([0.01, 0.0, 2.5], (len(TIME), 1)), None),
        (np.column_stack([0 * TIME, 0 * TIME, np.sin(TIME)]), None),
    ],
    ids=["spin", "held level", "hover", "tilted", "wobble"],
)
def test_yaw_spin(rates: np.ndarray, expected: YawSpin | None) -> None:
    assert yaw_spin(series(rates), 0.0, 40.0) == expected


def low_passes(*, still: bool = False) -> dict[str, Series]:
    """Fly in the air from the first sample to the last, and come as low as there at every turn."""
    turning = np.clip(TIME - 3, 0, 34)
    height = 0.55 + 0.725 * (1 - np.cos(2 * np.pi * turning / 2.0))
    across = 0 * TIME if still else np.sin(1.5 * TIME)
    noise = np.random.default_rng(0).normal(0, 3e-4, (len(TIME), 3))
    return {
        "position": series(np.column_stack([across, 0 * TIME, height]) + noise),
        "attitude": series(np.tile([1.0, 0, 0, 0], (len(TIME), 1))),
    }


@pytest.mark.parametrize(
    "drive",
    [
        {},
        {"rotor_speed": series(np.full((len(TIME), 4), 900.0))},
        {"rotor_speed": series(np.full((len(TIME), 4), 60.0))},
        {"command": series(np.full((len(TIME), 4), 0.1))},
        {"command": series(np.where(np.abs(TIME - 20) < 0.3, 0.0, 0.5)[:, None] * np.ones(4))},
    ],
    ids=["none", "speed", "slow rotors", "little throttle", "a moment without"],
)
def test_what_the_rotors_carry_is_one_mission_however_low_it_comes(
    drive: dict[str, Series],
) -> None:
    (mission,) = find_missions(low_passes() | drive)
    assert (mission.start, mission.end) == (TIME[0], TIME[-1])


def test_only_what_stands_still_at_the_lowest_height_may_be_ground() -> None:
    (mission,) = find_missions(low_passes(still=True))
    assert (mission.start, mission.end) == pytest.approx((3.2, 36.8), abs=0.2)


def test_what_stands_with_turning_motors_between_two_flights_is_cut() -> None:
    up = np.clip(TIME - 2, 0, 1) - np.clip(TIME - 15, 0, 1)
    up += np.clip(TIME - 20, 0, 1) - np.clip(TIME - 36, 0, 1)
    command = np.where((TIME > 1) & (TIME < 38), 0.3, 0.0)
    signals = flight() | {
        "position": series(np.column_stack([0 * TIME, 0 * TIME, up])),
        "command": series(np.tile(command[:, None], 4)),
    }
    assert len(find_missions(signals)) == 2
