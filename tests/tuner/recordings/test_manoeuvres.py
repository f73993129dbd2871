"""A long recording is taken apart into its manoeuvres, and those that show most are fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.tuner.recordings import making
from tuner.config import Options, settle
from tuner.findings.findings import Code
from tuner.recordings import inspect_recordings
from tuner.recordings.flight import Series
from tuner.recordings.missions import FITTED, PIECE, Mission, manoeuvres
from tuner.search.job_flights import load_flights, read_usable

TIME = np.arange(0.0, 1000.0, 0.02)


def flown(moves: np.ndarray) -> dict[str, Series]:
    """Return a flight that swings to and fro by some metres."""
    across = moves * np.sin(1.5 * TIME)
    position = np.column_stack([across, 0 * TIME, 1 + 0 * TIME])
    noise = np.random.default_rng(0).normal(0, 5e-4, position.shape)
    return {"position": Series(TIME, position + noise)}


def test_a_short_mission_stays_as_it_is() -> None:
    missions = (Mission(0.0, 100.0, "flight"), Mission(110.0, 150.0, "flight"))
    assert manoeuvres(flown(np.ones_like(TIME)), missions) == missions


def test_hover_parts_manoeuvres_and_the_liveliest_are_fitted() -> None:
    turn = (TIME // 100).astype(int)
    moves = np.where((TIME % 100 > 30) & (TIME % 100 < 75), 0.5 + 0.1 * turn, 0.0)
    found = manoeuvres(flown(moves), (Mission(0.0, 999.0, "flight"),))
    assert len(found) == 10
    assert [m.start for m in found] == pytest.approx([100 * i + 29 for i in range(10)], abs=1.0)
    assert [m.end for m in found] == pytest.approx([100 * i + 75 for i in range(10)], abs=1.0)
    assert [m.fitted for m in found] == [False] * 7 + [True] * 3


def test_what_never_hovers_is_cut_into_pieces() -> None:
    found = manoeuvres(flown(np.ones_like(TIME)), (Mission(10.0, 990.0, "flight"),))
    assert max(m.end - m.start for m in found) <= PIECE + 1e-6
    assert sum(m.end - m.start for m in found) == pytest.approx(980.0, abs=2.0)
    assert sum(m.end - m.start for m in found if m.fitted) <= FITTED


def test_what_only_hovers_is_cut_to_a_piece() -> None:
    (found,) = manoeuvres(flown(np.zeros_like(TIME)), (Mission(10.0, 990.0, "flight"),))
    assert (found.start, found.end, found.fitted) == (10.0, 10.0 + PIECE, True)


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the shipped circle ten times, with half a minute of hover between."""
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
        for lap in range(10):
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
    assert len(flights) == 10
    assert all(flight.duration < 60 for flight in flights)
    (inspection,), _ = inspect_recordings([long_log])
    assert sum(mission.fitted for mission in inspection.missions) in (4, 5)
    recordings, findings = read_usable(settle(Options([str(long_log)])))
    assert len(recordings) == sum(mission.fitted for mission in inspection.missions)
    (chosen,) = [f for f in findings if f.code is Code.MANOEUVRES_CHOSEN]
    assert chosen.numbers["flights"] == 10


def test_a_side_car_names_the_missions(long_log: Path) -> None:
    beside = long_log.with_suffix(".yaml")
    beside.write_text("missions: [2, 7]\n")
    try:
        recordings, _ = read_usable(settle(Options([str(long_log)])))
    finally:
        beside.unlink()
    assert [recording.flight.name for recording in recordings] == ["long-2", "long-7"]
