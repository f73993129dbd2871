"""Missions begin and end where the vehicle flies; long ones are taken as their manoeuvres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.tuner.recordings import making
from tuner.config import resolve_settings
from tuner.core.errors import ConfigError
from tuner.findings.findings import Code
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.missions import (
    MAX_FITTED_S,
    MAX_MANOEUVRE_S,
    Mission,
    airborne,
    find_missions,
    mission_error,
    split_into_manoeuvres,
    yaw_spin,
)
from tuner.search.job_flights import load_flights, read_recordings

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


def test_motors_that_are_carried_by_hand_do_not_fly() -> None:
    """Commands are recorded of armed motors alone, and rotor speeds throughout."""
    signals = flight(climb=15.0, land=30.0)
    carried = np.clip(TIME - 1, 0, 1) - np.clip(TIME - 8, 0, 1)
    carried += np.clip(TIME - 34, 0, 1) - np.clip(TIME - 38, 0, 1)
    signals["position"].values[:, 2] += carried
    armed, flies = (TIME > 13) & (TIME < 32), (TIME > 15) & (TIME < 31)
    command = np.where(flies, 0.5, 0.05)[armed, None]
    signals["command"] = series(np.tile(command, 4), TIME[armed])
    signals["rotor_speed"] = series(np.tile(600.0 * flies[:, None], 4))
    (mission,) = find_missions(signals)
    assert (mission.start, mission.end) == pytest.approx((15.12, 30.88), abs=0.05)


def test_thrust_set_points_do_not_lift_disarmed_motors() -> None:
    """An autopilot is sent them before it takes over; they ask for the climb."""
    during = flight() | {"thrust_setpoint": series(np.full(len(TIME), 0.9))}
    (mission,) = find_missions(during)
    assert (mission.start, mission.end) == pytest.approx((5.12, 35.88), abs=0.05)


@pytest.mark.parametrize(("floor", "end"), [(-0.1, 35.9), (0.4, 35.48)], ids=["lower", "table"])
def test_a_flight_that_lands_at_another_height(floor: float, end: float) -> None:
    signals = flight()
    height = signals["position"].values[:, 2]
    height += np.clip(TIME - 15, 0, 1) - np.clip(TIME - 30, 0, 1)
    height[TIME > 30] = np.maximum(height[TIME > 30], 0.05 + floor)
    if floor < 0:
        height += floor * np.clip(TIME - 35, 0, 1)
    (mission,) = find_missions(signals)
    assert (mission.start, mission.end) == pytest.approx((5.12, end), abs=0.05)


@pytest.mark.parametrize("bounces", [False, True])
@pytest.mark.parametrize("rests", [False, True])
def test_a_fall_is_not_flown(*, bounces: bool, rests: bool) -> None:
    """Motors stop in the air, which no command and no rotor speed shows."""
    signals = flight(land=100.0)
    height, since = signals["position"].values[:, 2], TIME - 30.0
    since_impact = since - np.sqrt(2 * 1.0 / 9.81)
    fallen = 1.05 - 0.5 * 9.81 * since**2
    bounced = np.maximum(2.5 * since_impact - 0.5 * 9.81 * since_impact**2, 0.0) * bounces + 0.05
    falls = since > 0
    height[falls] = np.where(since_impact > 0, bounced, fallen)[falls]
    recorded = since < (10.0 if rests else 0.4)
    signals = {name: samples.where(recorded) for name, samples in signals.items()}
    (mission,) = find_missions(signals)
    assert mission.start == pytest.approx(5.12, abs=0.05)
    assert mission.end == pytest.approx(30.0, abs=0.06)


def test_a_spin_between_other_manoeuvres_is_a_mission_of_its_own() -> None:
    """Its yaw rate set-point is constant; elsewhere attitude control sets one."""
    random = np.random.default_rng(0)
    rates = random.normal(0, 0.05, (len(TIME), 3))
    rates[(TIME > 12) & (TIME < 21.99), 2] = 3.0
    rates[(TIME > 21.99) & (TIME < 24), 2] = -6.0  # it turns back
    rates[(TIME > 26) & (TIME < 28), 2] = 2.0  # a moment at the limit
    signals = flight(climb=-10, land=100) | {"rate_setpoint": series(rates)}
    assert len(find_missions(signals)) == 1  # without a reference nothing simulates its heading
    signals["reference_position"] = series(np.tile([0.0, 0.0, 1.0], (len(TIME), 1)))
    before, spin, after = find_missions(signals)
    assert (spin.start, spin.end) == pytest.approx((12.0, 22.0), abs=0.02)
    assert before.end == spin.start
    assert after.start == pytest.approx(24.0, abs=0.02)
    assert [m.begins_with for m in (spin, after)] == ["a yaw spin", "flight"]
    assert yaw_spin(signals["rate_setpoint"], spin.start, spin.end) == (3.0, True)


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
    assert mission.start == pytest.approx(12.0, abs=1e-9)  # a tick later is another loop
    assert mission.begins_with == "the reference's motion"


def test_a_reference_that_moves_from_its_first_sample_on_begins_there() -> None:
    """As in a table of tune simulate: at rest at first, but already with a velocity."""
    signals = {
        "position": series(np.tile([0.0, 0.0, 1.0], (len(TIME), 1))),
        "attitude": series(np.tile([1.0, 0, 0, 0], (len(TIME), 1))),
        "reference_position": series(np.column_stack([0.07 * TIME**2, 0 * TIME, 1 + 0 * TIME])),
        "reference_velocity": series(np.column_stack([0.14 * (TIME + 0.01), 0 * TIME, 0 * TIME])),
    }
    (mission,) = find_missions(signals)
    assert (mission.start, mission.begins_with) == (0.0, "flight")


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
    assert mission_error(Path("x"), signals).what.startswith("nothing flies in it")


def test_motors_that_idle_in_flight_are_named_with_what_was_read() -> None:
    """As commands in percent that a topic map calls pulses of PWM."""
    percent = np.where((TIME > 5) & (TIME < 36), 60.0, 0.0)
    signals = flight() | {"command": series(np.tile(1e-3 * (percent[:, None] - 1000), 4))}
    assert find_missions(signals) == ()
    assert str(mission_error(Path("x"), signals)) == (
        "x: moves with motors that idle, by its command, which is read as -0.94; if it flew, give "
        "command its unit in a topic map (--topics FILE)"
    )


@pytest.mark.parametrize(
    ("rates", "expected"),
    [
        (np.tile([0.0, 0.0, -2.5], (len(TIME), 1)), (-2.5, False)),
        (
            np.column_stack([0.1 * np.sin(TIME), 0.1 * np.cos(TIME), 0 * TIME + 3]),
            (3.0, True),
        ),
        (np.tile([0.0, 0.0, 0.0], (len(TIME), 1)), (None, False)),
        (np.tile([0.01, 0.0, 2.5], (len(TIME), 1)), (None, False)),
        (np.column_stack([0 * TIME, 0 * TIME, np.sin(TIME)]), (None, False)),
    ],
    ids=["spin", "held level", "hover", "tilted", "wobble"],
)
def test_yaw_spin(rates: np.ndarray, expected: tuple[float | None, bool]) -> None:
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


CLOCK = np.arange(0.0, 1000.0, 0.02)


def flown(moves: np.ndarray) -> dict[str, Series]:
    """Return a flight that swings to and fro by some metres."""
    across = moves * np.sin(1.5 * CLOCK)
    position = np.column_stack([across, 0 * CLOCK, 1 + 0 * CLOCK])
    noise = np.random.default_rng(0).normal(0, 5e-4, position.shape)
    return {"position": Series(CLOCK, position + noise)}


def test_a_short_mission_stays_as_it_is() -> None:
    missions = (Mission(0.0, 100.0, "flight"), Mission(110.0, 150.0, "flight"))
    assert split_into_manoeuvres(flown(np.ones_like(CLOCK)), missions) == missions


def test_hover_parts_manoeuvres_and_the_liveliest_are_fitted() -> None:
    turn = (CLOCK // 100).astype(int)
    moves = np.where((CLOCK % 100 > 30) & (CLOCK % 100 < 75), 0.5 + 0.1 * turn, 0.0)
    found = split_into_manoeuvres(flown(moves), (Mission(0.0, 999.0, "flight"),))
    assert len(found) == 10
    assert [m.start for m in found] == pytest.approx([100 * i + 29 for i in range(10)], abs=1.0)
    assert [m.end for m in found] == pytest.approx([100 * i + 75 for i in range(10)], abs=1.0)
    assert [m.fitted for m in found] == [False] * 7 + [True] * 3


def test_what_never_hovers_is_cut_into_pieces() -> None:
    found = split_into_manoeuvres(flown(np.ones_like(CLOCK)), (Mission(10.0, 990.0, "flight"),))
    assert max(m.end - m.start for m in found) <= MAX_MANOEUVRE_S + 1e-6
    assert sum(m.end - m.start for m in found) == pytest.approx(980.0, abs=2.0)
    assert sum(m.end - m.start for m in found if m.fitted) <= MAX_FITTED_S


def test_what_only_hovers_is_cut_to_a_piece() -> None:
    (found,) = split_into_manoeuvres(flown(np.zeros_like(CLOCK)), (Mission(10.0, 990.0, "flight"),))
    assert (found.start, found.end, found.fitted) == (10.0, 10.0 + MAX_MANOEUVRE_S, True)


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the shipped circle seven times, with half a minute of hover between."""
    messages = making.px4_messages(making.CIRCLE)
    names = (
        "vehicle_local_position",
        "vehicle_attitude",
        "vehicle_angular_velocity",
        "actuator_outputs",
    )
    joined = {}
    for name in names:
        column = messages[name]
        hover = column.time < column.time[0] + 4e9
        random = np.random.default_rng(1)
        parts, times = [], []
        for lap in range(7):
            start = column.time[0] + lap * 68 * 10**9
            times.append(start + column.time - column.time[0])
            parts.append(column.values)
            for pause in range(7):
                rest = column.values[hover]
                parts.append(rest + random.normal(0, 1e-5, rest.shape))
                when = column.time[hover] - column.time[0]
                times.append(start + (40 + 4 * pause) * 10**9 + when)
        joined[name] = making.Column(np.concatenate(times), np.concatenate(parts))
    boot = int(messages["vehicle_attitude"].time[0]) - 5_000_000_000
    path = tmp_path_factory.mktemp("long") / "long.ulg"
    return making.to_ulog(joined, path, boot=boot)


def test_missions_of_a_long_log(long_log: Path) -> None:
    flights = load_flights(long_log)
    assert len(flights) == 7
    assert all(flight.duration < 60 for flight in flights)
    (inspection,), _ = inspect_recordings([long_log])
    assert sum(mission.fitted for mission in inspection.missions) in (4, 5)
    recordings, findings = read_recordings(resolve_settings(Options([str(long_log)])))
    assert len(recordings) == sum(mission.fitted for mission in inspection.missions)
    (chosen,) = [f for f in findings if f.code is Code.MANOEUVRES_CHOSEN]
    assert chosen.numbers["flights"] == 7


def test_a_side_car_names_the_missions(long_log: Path) -> None:
    beside = long_log.with_suffix(".yaml")
    beside.write_text("missions: [2, 7]\n")
    try:
        recordings, _ = read_recordings(resolve_settings(Options([str(long_log)])))
    finally:
        beside.unlink()
    assert [recording.flight.name for recording in recordings] == ["long-2", "long-7"]


@pytest.mark.parametrize(
    ("said", "what"),
    [
        ("missions: [1, 7]", "names mission 7, and spin.bag holds 1"),
        ("missions: [0]", "should be at least 1"),
        ("missions: []", "at least 1"),
        ("start: 5\nend: 5", "start 5 is not before end 5"),
        ("start: 1000", "leaves nothing of spin.bag, from 1000 to"),
    ],
)
def test_a_side_car_that_leaves_nothing_to_fit_is_refused(
    said: str, what: str, tmp_path: Path
) -> None:
    path = tmp_path / "spin.bag"
    path.symlink_to(making.FLIGHTS / "yaw_spin_3rps.bag")
    path.with_suffix(".yaml").write_text(said)
    with pytest.raises(ConfigError, match=what) as refusal:
        load_flights(path, cache=False)
    assert refusal.value.where == str(tmp_path / "spin.yaml")
