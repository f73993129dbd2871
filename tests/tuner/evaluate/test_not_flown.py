"""A fast lemniscate that a slightly weaker vehicle does not fly, and where it parts."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tests.tuner.evaluate.test_rmse import errors
from tuner.config import resolve_settings
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.validation import flights_not_followed
from tuner.findings.findings import Code, remedy, sentence
from tuner.options import Options
from tuner.search.job_flights import read_recordings
from tuner.vehicle import COEFFICIENTS, with_values

FLIGHTS = Path(__file__).parents[3] / "reference_flights"


@pytest.fixture(scope="module")
def flown():
    """The settings, the recordings, and what flies them with so much of the true thrust."""
    names = ("lemniscate_4mps", "circle_3mps", "diagonal_3mps")
    paths = [str(FLIGHTS / f"{name}.bag") for name in names]
    settings = resolve_settings(Options(paths, config=str(FLIGHTS / "tune.yaml")))
    recordings = read_recordings(settings, holdout=())[0]
    truth = yaml.safe_load((FLIGHTS / "truth.yaml").read_text())
    known = {name: value for name, value in truth.items() if name in COEFFICIENTS}
    comparison = Comparison(recordings, settings.controller)

    def fly(share):
        lift = share * known["motor_constant"]
        return comparison.fly(with_values(settings.vehicle, {**known, "motor_constant": lift}))

    return SimpleNamespace(settings=settings, recordings=recordings), fly


def test_a_loop_beyond_its_limit_is_named_with_the_time(flown):
    job, fly = flown
    (finding,) = flights_not_followed(job, fly(0.92))
    assert (finding.code, finding.subject) == (Code.FLIGHT_NOT_FLOWN, "lemniscate_4mps")
    assert 9.0 < finding.numbers["seconds"] < 15.0
    assert finding.numbers["beyond"] > 0.4
    assert finding.numbers["beyond_recorded"] < 0.1
    assert "beyond that limit" in sentence(finding)
    assert "max_feedback_acceleration" in remedy(finding)


@pytest.mark.parametrize("share", [1.0, 1.08])
def test_flights_that_are_all_flown_are_not(flown, share):
    job, fly = flown
    assert flights_not_followed(job, fly(share)) == ()


def test_a_flight_that_is_odd_for_another_reason_says_nothing_of_the_limit(flown):
    job, _ = flown
    met = {
        recording.flight.name: errors([[0.01, 0.0, 0.0]] * 90, [[0.0] * 3] * 90)
        for recording in job.recordings
    }
    assert flights_not_followed(job, met) == ()
    met["circle_3mps"] = errors([[0.01, 0, 0]] * 45 + [[0.5, 0, 0]] * 45, [[0.0] * 3] * 90)
    (finding,) = flights_not_followed(job, met)
    assert finding.subject == "circle_3mps"
    assert finding.numbers["seconds"] == met["circle_3mps"].position.time[45]
    assert "beyond" not in finding.numbers
    assert "max_feedback" not in remedy(finding)


def test_one_flight_has_no_peers(flown):
    job, _ = flown
    alone = SimpleNamespace(settings=job.settings, recordings=job.recordings[:1])
    name = job.recordings[0].flight.name
    far = {name: errors([[np.sqrt(0.5), 0, 0]] * 90, [[0.0] * 3] * 90)}
    assert flights_not_followed(alone, far) == ()
