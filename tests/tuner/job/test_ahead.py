"""What comes after the search finds its programs ready, and nothing waits that need not."""

from __future__ import annotations

import threading

import pytest

from tests.tuner.selection.making import unfitted_with
from tests.tuner.uncertainty.making import FLIGHTS
from tuner.examination.examination import examine
from tuner.job import ahead, terms
from tuner.job.ahead import ProgramsAhead
from tuner.job.selection import Selection
from tuner.objective.simulator import Simulator


def few_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    groups = {"fuselage_drag": ("fuselage_drag",)}
    monkeypatch.setattr(terms, "candidate_groups", lambda *_: groups)
    monkeypatch.setattr(terms, "groups_around", lambda *_, **__: {})


@pytest.mark.slow
def test_selection_and_examination_trace_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    few_groups(monkeypatch)
    job, fitted = unfitted_with(0.0, seed=0)
    with ProgramsAhead(job) as programs:
        programs.await_selection()
        programs.await_examination()

    def trace(*_: object) -> None:
        raise AssertionError("a program was traced")

    monkeypatch.setattr(Simulator, "jacobian", trace)
    selection = Selection(job, fitted, terms.candidates_of(job), lambda *_: None, lambda _: None)
    assert selection.seen(fitted, {}).linear.loss > 0.0
    assert examine(fitted, names=FLIGHTS).uncertainty.estimates


def test_what_has_not_begun_is_left_to_whoever_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    few_groups(monkeypatch)
    begun, ended, examined = threading.Event(), threading.Event(), []

    def select(*_: object) -> None:
        begun.set()
        ended.wait(60.0)

    monkeypatch.setattr(ahead, "_select", select)
    monkeypatch.setattr(ahead, "_examine", examined.append)
    job, _ = unfitted_with(0.0, seed=0)
    with ProgramsAhead(job) as programs:
        assert begun.wait(60.0)
        programs.await_examination()  # behind the selection's, which has not ended
        ended.set()
        programs.await_selection()
    assert not examined


def test_who_waits_for_the_selection_makes_the_examination_ready(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few_groups(monkeypatch)
    begun, examined = threading.Event(), threading.Event()
    threads = []

    def select(*_: object) -> None:
        begun.set()
        assert examined.wait(60.0)

    def examine(*_: object) -> None:
        threads.append(threading.current_thread())
        examined.set()

    monkeypatch.setattr(ahead, "_select", select)
    monkeypatch.setattr(ahead, "_examine", examine)
    job, _ = unfitted_with(0.0, seed=0)
    with ProgramsAhead(job) as programs:
        assert begun.wait(60.0)
        programs.await_selection()
        programs.await_examination()
    assert threads == [threading.current_thread()]


def test_what_fails_ahead_is_left_to_whoever_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    few_groups(monkeypatch)

    def fail(*_: object) -> None:
        raise FloatingPointError("a start that is no vehicle")

    monkeypatch.setattr(ahead, "_select", fail)
    monkeypatch.setattr(ahead, "_examine", fail)
    job, _ = unfitted_with(0.0, seed=0)
    with ProgramsAhead(job) as programs:
        programs.await_selection()
        programs.await_examination()


def test_many_flights_leave_their_memory_to_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few_groups(monkeypatch)
    monkeypatch.setattr(ahead, "MOST", 10**6)
    monkeypatch.setattr(ahead, "_examine", lambda *_: pytest.fail("it was examined"))
    job, _ = unfitted_with(0.0, seed=0)
    with ProgramsAhead(job) as programs:
        programs.await_selection()
        programs.await_examination()
