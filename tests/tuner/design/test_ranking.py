"""What to fly next, on a problem whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.design import ranking
from tuner.design.candidates import CLEARANCE, Arena, candidates
from tuner.design.next_flight_json import (
    Proposal,
    Proposals,
    in_words,
    read_proposals,
    write_proposals,
)
from tuner.design.ranking import Habits, rank_next_flights
from tuner.errors import InputError
from tuner.examination.examination import Examination, examine
from tuner.objective.normal import Objective
from tuner.search.fitted import Fitted

FREE = ("inertia_xx", "inertia_zz", "input_scaling", "motor_constant", "moment_constant")
ARENA = Arena(4.0, 3.0, 2.0)
HABITS = Habits(("body_rate", "rotor_speed", "command"), 20.0)


def only(objective: Objective, segment: int) -> Objective:
    segments = jax.tree.map(lambda leaf: leaf[..., segment : segment + 1], objective.segments)
    segments = eqx.tree_at(lambda segment: segment.flight, segments, np.zeros(1, int))
    changed: Objective = eqx.tree_at(lambda o: o.segments, objective, segments)
    return changed


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """A fit to the swing alone, which hardly turns about up, met 200 times worse than noise."""
    exact = making.problem(FREE)
    noisy = making.with_data(exact, making.truth(exact), noise=np.random.default_rng(0))
    alone = only(noisy, 0)
    found = making.fitted_of(alone, making.truth(alone))
    rough = {name: 200.0 * scale[:1] for name, scale in found.criterion.scale.items()}
    criterion = eqx.tree_at(lambda s: (s.scale, s.held), found.criterion, (rough, np.zeros((2, 1))))
    return replace(found, criterion=criterion)


@pytest.fixture(scope="module")
def examination(fitted: Fitted) -> Examination:
    return examine(fitted, names=("swing",))


@pytest.fixture(scope="module")
def proposals(examination: Examination, fitted: Fitted) -> Proposals:
    return rank_next_flights(examination, fitted.criterion, arena=ARENA, habits=HABITS)


def test_what_the_swing_does_not_tell_is_told_by_a_yaw_spin(proposals: Proposals) -> None:
    assert "moment_constant" in proposals.targets
    best = min(proposals.flights, key=lambda row: row.shrinks["moment_constant"])
    assert best.trajectory["name"] == "yaw_spin"
    assert best.shrinks["moment_constant"] < 0.3
    said = [text for text in proposals.sentences if "moment_constant" in text]
    assert said[0].startswith("A yaw spin at")


def test_no_flight_widens_an_interval(proposals: Proposals) -> None:
    for flight in proposals.flights:
        assert flight.volume < 1.0
        assert all(0.0 < share <= 1.0 + 1e-9 for share in flight.shrinks.values())
    means = [flight.mean for flight in proposals.flights]
    assert means == sorted(means)


def test_fewer_samples_weighed_more_say_nearly_the_same(
    examination: Examination,
    fitted: Fitted,
    proposals: Proposals,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ranking, "SAMPLE_RATE", 50.0)
    coarser = rank_next_flights(examination, fitted.criterion, arena=ARENA, habits=HABITS)
    by_name = {row.name: row for row in coarser.flights}
    for row in proposals.flights:
        for name, share in row.shrinks.items():
            assert by_name[row.name].shrinks[name] == pytest.approx(share, rel=0.12)


@pytest.mark.parametrize("size", [(4.0, 3.0, 2.0), (12.0, 8.0, 3.0)])
def test_candidates_stay_between_the_walls(size: tuple[float, float, float]) -> None:
    arena = Arena.of(size)
    found = candidates(arena)
    assert {one.trajectory.name for one in found} == {
        "circle",
        "lemniscate",
        "straight",
        "diagonal",
        "yaw_spin",
    }
    assert len({one.name for one in found}) == len(found)
    for one in found:
        if one.trajectory.name != "yaw_spin":
            assert one.trajectory.radius <= size[0] / 2 - CLEARANCE + 0.01
        if one.trajectory.name in ("circle", "diagonal"):
            assert one.trajectory.radius <= size[1] / 2 - CLEARANCE + 0.01


@pytest.mark.parametrize("numbers", [(3.0, 3.0), (1.5, 4.0, 3.0), (4.0, 4.0, 1.2)])
def test_an_arena_that_nothing_fits_is_refused(numbers: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="--arena"):
        Arena.of(numbers)


def a_flight(name: str, **shrinks: float) -> Proposal:
    return Proposal(name=name, trajectory={}, shrinks=shrinks, volume=0.9)


def test_sentences_say_what_each_flight_is_for() -> None:
    rows = [
        a_flight("a circle", inertia_xx=0.2, moment_constant=0.95, mass=0.97),
        a_flight("a yaw spin at 4 rad/s", inertia_xx=0.8, moment_constant=0.5, mass=0.99),
    ]
    said = in_words(rows, ["inertia_xx", "moment_constant", "mass"], fixed=("mass",))
    idle = "No single flight in this arena would narrow the interval of mass (fixed so far) by "
    assert said == [
        "A circle would narrow the interval of inertia_xx to 20% of what it is.",
        "A yaw spin at 4 rad/s would halve the interval of moment_constant.",
        f"{idle}more than 10%.",
    ]
    assert "stays in the air" in in_words([], ["mass"])[0]


def test_proposals_can_be_read_back(proposals: Proposals, tmp_path: Path) -> None:
    write_proposals(proposals, tmp_path)
    assert read_proposals(tmp_path) == proposals
    lines = (tmp_path / "next_flight.csv").read_text().splitlines()
    assert len(lines) == 1 + len(proposals.flights)
    assert lines[0].startswith("flight,mean_shrink,volume_shrink,")
