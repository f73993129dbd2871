"""What to log next time: numbers that are computed, held against what the signals really bring."""

from dataclasses import replace

import numpy as np
import pytest

from tests.tuner.job.test_attitude import settings_of, sparse_log
from tests.tuner.job.test_windows import job_through
from tests.tuner.recorded import recordings_of
from tests.tuner.uncertainty.making import ended
from tuner.core.errors import RecordingError
from tuner.core.numerics import std_errors_of
from tuner.design import ranking
from tuner.design.proposals import LogProposal, log_in_words
from tuner.design.ranking import propose_logs
from tuner.objective.criterion import picked
from tuner.objective.information import information_at
from tuner.recordings.flight import Series
from tuner.search.problem import job_of
from tuner.search.progress import criterion_of, initial_progress
from tuner.search.stages import WHOLE_LENGTH, Stage
from tuner.vehicle import values_of

FREE = ("input_scaling", "zero_position_armed", "motor_constant", "inertia_xx")


def at_truth(job, updated):
    """Return a fit that ended at the truth."""
    vector = job.space.vector_of(values_of(updated))
    stage = Stage(WHOLE_LENGTH, job.objective.samples, 1.0, False, False, 1, 1e-3, True, False)
    start = initial_progress(job.objective, vector[None])
    point = picked(start.points, 0)
    return ended(
        objective=job.objective,
        point=point,
        criterion=criterion_of(stage, start.scales, np.asarray(point.offsets), start.states),
        noise=job.noise,
        scales={flight.name: dict.fromkeys(start.scales, 1.0) for flight in job.fitted},
        loss_best=0.0,
    )


def seen(flight, bag, updated):
    """Return the job of a flight, its fit at the truth, and the information about it."""
    job = job_through("actuator", flight, bag, updated, free=FREE)
    fitted = at_truth(job, updated)
    return job, fitted, information_at(job.objective, fitted.point, fitted.criterion).total


def with_series(flight, **changed):
    series = {name: s for name, s in (dict(flight.series) | changed).items() if s is not None}
    signals = {name: rows for name, rows in flight.signals.items() if name in series}
    return replace(flight, series=series, signals=signals)


def thinned(series, every):
    return Series(series.time[::every], series.values[::every])


@pytest.mark.long
@pytest.mark.slow
def test_what_is_foreseen_is_what_comes_of_it(full_flight, full_bag, updated, monkeypatch):
    monkeypatch.setattr(ranking, "MAX_WORTHWHILE_SHARE", 1.0)
    command = full_flight.series["command"]
    logged = with_series(full_flight, command=thinned(command, 2), rotor_speed=None)
    job, fitted, known = seen(logged, full_bag, updated)
    proposals = propose_logs(job, fitted, known, updated)
    added, faster = sorted(proposals, key=lambda proposal: proposal.change)

    assert (added.signal, added.change) == ("rotor_speed", "added")
    assert all(0.0 < share <= 1.0 + 1e-9 for share in added.shrinks.values())
    assert min(added.shrinks.values()) < 0.9
    sentence = log_in_words(added)
    assert sentence.startswith("Log the rotor speed, at 100 Hz and good to")

    # speeds without noise would say what turns commands into speeds, and leave the rest to itself
    monkeypatch.setattr(ranking, "TACHOMETER_NOISE", 1e-6)
    (exact,) = (p for p in propose_logs(job, fitted, known, updated) if p.change == "added")
    rest = [job.space.names.index(name) for name in ("motor_constant", "inertia_xx")]
    alone = std_errors_of(known[np.ix_(rest, rest)]) / std_errors_of(known)[rest]
    shares = np.array(list(exact.shrinks.values()))
    np.testing.assert_allclose(shares[rest], alone, rtol=1e-3)
    assert max(exact.shrinks["input_scaling"], exact.shrinks["zero_position_armed"]) < 0.05

    assert (faster.signal, faster.change) == ("command", "faster")
    assert faster.rate == pytest.approx(400.0, rel=0.01)
    assert 0.5 <= faster.shrinks["motor_constant"] < 1.0


def test_a_log_too_slow_to_be_thinned_is_no_error(full_flight, full_bag, updated, monkeypatch):
    def refused(_, recordings):
        assert [recording.flight.name for recording in recordings] == [full_flight.name]
        raise RecordingError("full_circle", "holds no 0.5 s with rotor speed throughout", "")

    job = job_through("rotor_speed", full_flight, full_bag, updated, free=FREE[2:])
    elsewhere = replace(job.recordings[0], flight=with_series(full_flight, rotor_speed=None))
    held_out = replace(elsewhere, holdout=True)
    job = replace(job, recordings=(*job.recordings, held_out))
    monkeypatch.setattr(ranking, "job_of", refused)
    fitted = at_truth(job, updated)
    assert propose_logs(job, fitted, np.eye(len(job.space)), updated) == ()


@pytest.mark.parametrize("power", [1.0, 2.0, 4.0])
def test_what_twice_the_rate_wins_follows_from_what_half_of_it_loses(power):
    losses = [3.0 + 0.2 * between**power for between in (1.0, 2.0, 4.0, 0.5)]
    *coarser, finer = losses
    share = ranking.share_at_twice_the_rate(coarser)
    assert share == pytest.approx(np.sqrt(finer / losses[0]), rel=1e-9)


def test_no_more_is_promised_than_is_seen():
    assert ranking.share_at_twice_the_rate([3.0, 2.9, 4.0]) == 1.0
    all_missed = ranking.share_at_twice_the_rate([8.26, 30.17, 30.30])
    assert np.sqrt(5.32 / 8.26) < all_missed < 1.0  # the losses of a simulated flight; first 400 Hz
    assert ranking.share_at_twice_the_rate([1.0, 5.0, 13.0]) == 0.5


@pytest.mark.slow
def test_commands_that_could_be_fed_in_would_tell_what_turns_the_vehicle(
    full_flight, full_bag, updated
):
    log = sparse_log(full_flight, updated)
    settings = settings_of(updated, full_bag, free=("motor_constant", "inertia_xx", "inertia_yy"))
    job = job_of(settings, recordings_of(settings, [log]))
    assert job.inlets == ("attitude",)
    (commands,) = propose_logs(job, at_truth(job, updated), np.eye(len(job.space)), updated)
    assert (commands.signal, commands.change) == ("command", "fed")
    assert set(commands.shrinks) == {"inertia_xx", "inertia_yy"}
    assert max(commands.shrinks.values()) < 0.2
    sentence = log_in_words(commands)
    assert "Log the command at 250 Hz, so that it can be fed in" in sentence
    assert "it would narrow the interval of inertia_" in sentence
    assert "inertia_xx (not fitted so far) to" in sentence


def test_sentences_name_what_gains_most():
    added = LogProposal(
        signal="rotor_speed",
        change="added",
        rate=100.0,
        noise=17.3,
        shrinks={"motor_constant": 0.5, "inertia_xx": 0.95, "input_scaling": 0.2},
    )
    faster = LogProposal(signal="command", change="faster", rate=250.0, shrinks={"mass": 0.7})
    of_added, of_faster = map(log_in_words, (added, faster))
    assert of_added == (
        "Log the rotor speed, at 100 Hz and good to 17 rad/s: it would narrow the interval of "
        "input_scaling to 20 % of what it is and halve the interval of motor_constant."
    )
    assert of_faster == (
        "Log the command at 250 Hz: as far as the simulation misses what lies between its "
        "samples, that would narrow the interval of every coefficient by 30 %."
    )
