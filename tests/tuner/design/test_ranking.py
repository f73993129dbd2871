"""What to fly next, on a problem whose answer is known, and as sentences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.core.errors import InputError
from tuner.design import ranking as proposed
from tuner.design.proposals import (
    Proposal,
    Proposals,
    proposals_in_words,
)
from tuner.design.ranking import CLEARANCE_M, Arena, candidates, rank_next_flights
from tuner.objective.normal_equations import Objective
from tuner.search.progress import Fit
from tuner.uncertainty.examination import Examination, examine

FREE = ("inertia_xx", "inertia_zz", "input_scaling", "motor_constant", "moment_constant")
ARENA = Arena(4.0, 3.0, 2.0)


def only(objective: Objective, segment: int) -> Objective:
    segments = jax.tree.map(lambda leaf: leaf[..., segment : segment + 1], objective.segments)
    segments = eqx.tree_at(lambda segment: segment.flight, segments, np.zeros(1, int))
    changed: Objective = eqx.tree_at(lambda o: o.segments, objective, segments)
    return changed


@pytest.fixture(scope="module")
def fitted() -> Fit:
    """A fit to the swing alone, which hardly turns about up, met 200 times worse than noise."""
    noisy = making.problem(FREE, seed=0)
    swing = only(noisy, 0)
    exact_fit = making.fitted_of(swing, making.truth(swing))
    rough = {name: 200.0 * scale[:1] for name, scale in exact_fit.criterion.scale.items()}
    criterion = replace(exact_fit.criterion, scale=rough, reference_offset=np.zeros((2, 1)))
    scales = {"swing": exact_fit.scales[making.FLIGHTS[0]]}
    return replace(exact_fit, criterion=criterion, scales=scales)


@pytest.fixture(scope="module")
def examination(fitted: Fit) -> Examination:
    return examine(fitted)


def ranked(examination: Examination, fitted: Fit) -> Proposals:
    return rank_next_flights(
        examination,
        fitted.criterion,
        arena=ARENA,
        seconds=making.SECONDS,
    )


@pytest.fixture(scope="module")
def proposals(examination: Examination, fitted: Fit) -> Proposals:
    return ranked(examination, fitted)


def test_candidates_are_flown_by_the_program_of_the_examination(
    fitted: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    examination = examine(fitted)

    def build(*_: object) -> None:
        raise AssertionError("a program was built for the candidates")

    monkeypatch.setattr("lanes.program.Program", build)
    assert ranked(examination, fitted).flights


def test_what_the_swing_does_not_identify_a_yaw_spin_does(proposals: Proposals) -> None:
    assert "moment_constant" in proposals.targets
    best = min(proposals.flights, key=lambda row: row.shrinks["moment_constant"])
    assert best.trajectory["name"] == "yaw_spin"
    assert best.shrinks["moment_constant"] < 0.3
    sentences = proposals_in_words(proposals)
    about = [sentence for sentence in sentences if "moment_constant" in sentence]
    assert about[0].startswith("A yaw spin at")


def test_no_flight_widens_an_interval(proposals: Proposals) -> None:
    for flight in proposals.flights:
        assert flight.volume < 1.0
        assert all(0.0 < share <= 1.0 + 1e-9 for share in flight.shrinks.values())
    means = [flight.mean for flight in proposals.flights]
    assert means == sorted(means)


def test_fewer_samples_of_larger_weight_carry_nearly_the_same_information(
    examination: Examination,
    fitted: Fit,
    proposals: Proposals,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(proposed, "MAX_SAMPLE_RATE_HZ", 50.0)
    coarser = ranked(examination, fitted)
    by_name = {row.name: row for row in coarser.flights}
    for row in proposals.flights:
        for name, share in row.shrinks.items():
            assert by_name[row.name].shrinks[name] == pytest.approx(share, rel=0.12)


@pytest.mark.parametrize("size", [(4.0, 3.0, 2.0), (12.0, 8.0, 3.0)])
def test_candidates_stay_between_the_walls(size: tuple[float, float, float]) -> None:
    arena = Arena.of(size)
    flights = candidates(arena).values()
    assert {flight.name for flight in flights} == {
        "circle",
        "lemniscate",
        "straight",
        "diagonal",
        "yaw_spin",
    }
    for flight in flights:
        if flight.name != "yaw_spin":
            assert flight.radius <= size[0] / 2 - CLEARANCE_M + 0.01
        if flight.name in ("circle", "diagonal"):
            assert flight.radius <= size[1] / 2 - CLEARANCE_M + 0.01


@pytest.mark.parametrize(
    "numbers", [(3.0, 3.0), (1.5, 4.0, 3.0), (4.0, 4.0, 1.2), (np.nan,) * 3, (np.inf,) * 3]
)
def test_an_arena_that_nothing_fits_is_refused(numbers: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="--arena"):
        Arena.of(numbers)


def test_proposals_can_be_read_back(proposals: Proposals, tmp_path: Path) -> None:
    proposals.write(tmp_path)
    assert Proposals.read(tmp_path) == proposals
    lines = (tmp_path / "next_flight.csv").read_text().splitlines()
    assert len(lines) == 1 + len(proposals.flights)
    assert lines[0].startswith("flight,mean_shrink,volume_shrink,")


def in_a_hall(*flights: Proposal) -> Proposals:
    return Proposals(
        arena=(4.0, 3.0, 2.0),
        seconds=20.0,
        targets=["inertia_xx", "inertia_yy", "moment_constant", "mass"],
        fixed_targets=["mass"],
        all_known=False,
        flights=list(flights),
    )


def flight(name: str, **shrinks: float) -> Proposal:
    return Proposal(name=name, trajectory={}, shrinks=shrinks, volume=0.9)


def test_sentences_name_each_flight_and_what_it_would_narrow() -> None:
    sentences = proposals_in_words(
        in_a_hall(
            flight("a circle", inertia_xx=0.2, inertia_yy=0.3, moment_constant=0.95, mass=0.97),
            flight(
                "a yaw spin at 4 rad/s",
                inertia_xx=0.8,
                inertia_yy=0.9,
                moment_constant=0.5,
                mass=0.99,
            ),
        )
    )
    not_narrowed = "No single flight in this arena would narrow the interval of mass (fixed so far)"
    narrowed = "inertia_xx to 20 % and inertia_yy to 30 % of what it is"
    assert sentences == [
        f"A circle would narrow the interval of {narrowed}.",
        "A yaw spin at 4 rad/s would halve the interval of moment_constant.",
        f"{not_narrowed} by more than 10 %.",
    ]


def test_an_arena_in_which_nothing_flies() -> None:
    (sentence,) = proposals_in_words(in_a_hall())
    assert "stays in the air" in sentence
