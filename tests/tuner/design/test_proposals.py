"""What to fly next, as sentences."""

from __future__ import annotations

from tuner.design.proposals import Proposal, Proposals, proposals_in_words


def proposals(*flights: Proposal) -> Proposals:
    return Proposals(
        arena=(4.0, 3.0, 2.0),
        seconds=20.0,
        targets=["inertia_xx", "moment_constant", "mass"],
        fixed_targets=["mass"],
        all_known=False,
        flights=list(flights),
    )


def flight(name: str, **shrinks: float) -> Proposal:
    return Proposal(name=name, trajectory={}, shrinks=shrinks, volume=0.9)


def test_sentences_name_each_flight_and_what_it_would_narrow() -> None:
    sentences = proposals_in_words(
        proposals(
            flight("a circle", inertia_xx=0.2, moment_constant=0.95, mass=0.97),
            flight("a yaw spin at 4 rad/s", inertia_xx=0.8, moment_constant=0.5, mass=0.99),
        )
    )
    not_narrowed = "No single flight in this arena would narrow the interval of mass (fixed so far)"
    assert sentences == [
        "A circle would narrow the interval of inertia_xx to 20% of what it is.",
        "A yaw spin at 4 rad/s would halve the interval of moment_constant.",
        f"{not_narrowed} by more than 10%.",
    ]


def test_an_arena_in_which_nothing_flies() -> None:
    (sentence,) = proposals_in_words(proposals())
    assert "stays in the air" in sentence
