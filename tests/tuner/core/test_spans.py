"""Where a run's seconds go: every instant counted once, and jax's part told from ours."""

import json
import logging
import time
from threading import Thread

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lanes import Argument, Program
from tuner.cli.progress import profiling, trace_of
from tuner.core.spans import (
    _RECORDER,
    BUILDING,
    COMPILING,
    LOADING,
    OUTSIDE,
    TRACING,
    Span,
    recording,
    span,
    stage_table,
)


def add_beside(name, began, ended):
    """Add what another thread did between two readings of `time.time`."""
    recorder = _RECORDER.get()
    shift = recorder.now() - time.time()
    recorder.spans.append(Span(name, began + shift, ended + shift, beside=True))


def test_every_instant_counts_for_the_innermost_stage_that_holds_it():
    spans = [
        Span("page", 5.0, 9.0, processor=3.0),
        Span("figures", 6.0, 8.0, processor=2.0),
        Span(TRACING, 1.5, 2.0, "inner"),
        Span(TRACING, 1.0, 3.0, "outer"),
        Span(LOADING, 3.5, 4.0),
        Span(COMPILING, 3.0, 4.5, "outer"),
        Span("search", 0.5, 5.0, processor=8.0),
        Span("figures", 5.5, 8.5, beside=True),
    ]
    rows = {row.stage: row for row in stage_table(spans, 10.0, 12.0)}
    assert [*rows] == ["search", "page", "figures", OUTSIDE]
    assert [row.seconds for row in rows.values()] == [4.5, 2.0, 2.0, 1.5]
    assert [row.processor for row in rows.values()] == [8.0, 1.0, 2.0, 1.0]
    assert rows["search"].jax[TRACING] == 2.0
    assert rows["search"].jax[COMPILING] == 1.0
    assert rows["search"].jax[LOADING] == 0.5
    assert rows["search"].rest == 1.0
    assert rows["search"].programs == 1


def test_what_jax_traces_and_compiles_counts_within_the_stage_that_asks_for_it():
    with recording() as recorder:
        with span("square"):
            jax.block_until_ready(jax.jit(lambda x: x * x + 0.123)(jnp.arange(7.0)))
        with span("again"):
            jnp.zeros(3)
            time.sleep(0.02)
    rows = {
        row.stage: row for row in stage_table(recorder.spans, recorder.now(), time.process_time())
    }
    assert rows["square"].programs >= 1
    assert rows["square"].jax[TRACING] > 0.0
    assert 0.02 <= rows["again"].seconds < 1.0
    total = sum(row.seconds for row in rows.values())
    assert total == pytest.approx(recorder.now(), rel=0.05)
    with span("not recorded"):
        pass
    assert "not recorded" not in {span.name for span in recorder.spans}


def test_what_another_thread_compiles_goes_on_beside_the_stages():
    with recording() as recorder, span("check"):
        thread = Thread(target=lambda: jax.jit(lambda x: jnp.tanh(x) * 17.0)(jnp.arange(3.0)))
        thread.start()
        thread.join(60.0)
    compiled = [row for row in recorder.spans if row.name == COMPILING]
    assert compiled
    assert all(row.beside for row in compiled)
    (row, *_) = (r for r in stage_table(recorder.spans, recorder.now(), 1.0) if r.stage == "check")
    assert row.programs == 0


def test_the_trace_nests_as_perfetto_wants_it_and_other_processes_have_a_row():
    with recording() as recorder:
        with span("page"), span("figures"):
            add_beside("figures", time.time() - 0.5, time.time())
        jax.jit(lambda x: x - 0.321)(jnp.ones(5))
    trace = json.loads(json.dumps(trace_of(recorder.spans)))
    events = [event for event in trace["traceEvents"] if event["ph"] == "X"]
    assert {"page", "figures", "import"} <= {event["name"] for event in events}
    (beside,) = (event for event in events if event["tid"] == 2)
    assert beside["dur"] == pytest.approx(5e5, rel=0.01)
    open_until = []
    for event in (event for event in events if event["tid"] == 1):
        end = event["ts"] + event["dur"]
        while open_until and open_until[-1] <= event["ts"]:
            open_until.pop()
        assert not open_until or end <= open_until[-1] + 1, "children end within their parents"
        open_until.append(end)


def test_a_profile_is_left_in_the_folder_and_on_the_terminal(tmp_path, capsys):
    with profiling(True, quiet=False) as into:
        with span("reading"):
            time.sleep(0.06)
        for spent in (0.2, 0.3, 0.001):
            add_beside("figures", time.time() - spent, time.time())
        add_beside("loading", time.time() - 0.001, time.time())
        into(tmp_path)
    text = capsys.readouterr().out
    assert "reading" in text
    assert "Beside it, by other threads and processes: figures 0.5 s." in " ".join(text.split())
    header, *rows = (tmp_path / "profile.csv").read_text().splitlines()
    assert header.startswith("stage,seconds [s],processor [s],tracing [s]")
    (reading,) = (row.split(",") for row in rows if row.startswith("reading"))
    assert float(reading[1]) == pytest.approx(0.06, abs=0.05)
    assert json.loads((tmp_path / "profile.json").read_text())["traceEvents"]


def test_a_program_without_a_kernel_is_named(tmp_path, capsys):
    sorting = Program(lambda x, _: jnp.sort(x), Argument((3,), float, lanes=True), name="sorting")
    log = logging.getLogger("lanes.program")
    log.setLevel(logging.INFO)  # the suite fails what it hears of a fallback
    try:
        with profiling(True, quiet=False) as into:
            sorting(np.ones((3, 2)), lanes=2)
            into(tmp_path)
    finally:
        log.setLevel(logging.DEBUG)
    text = " ".join(capsys.readouterr().out.split())
    assert "Through XLA, not as a kernel: sorting: no rule for primitive sort." in text


def test_nothing_is_left_unless_it_is_asked_for(tmp_path):
    with profiling(False, quiet=False) as into:
        into(tmp_path)
    assert not list(tmp_path.iterdir())


def test_building_a_kernel_counts_in_the_stage_that_asks_for_it_and_has_a_name():
    double = Program(lambda x, _: 2.0 * x, Argument((), float, lanes=True), name="doubled")
    with recording() as recorder, span("twice"):
        assert double(np.arange(3.0), lanes=3).values.tolist() == [0.0, 2.0, 4.0]
    (row,) = (
        row for row in stage_table(recorder.spans, recorder.now(), 1.0) if row.stage == "twice"
    )
    assert row.jax[BUILDING] > 0.0
    assert [each.detail for each in recorder.spans if each.name == BUILDING] == ["doubled"]
