"""Other recordings, lengths, bounds and free coefficients find the program built for the first."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from lanes.machine import digest_of
from lanes.program import _program_of
from sim_jax import terms
from tests.tuner.recorded import recordings_of
from tests.tuner.uncertainty.making import criterion_of, problem
from tuner.config import JobFile, Search, resolve_settings
from tuner.objective import simulation
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.search.problem import job_of


def built(objective):
    """Return how many programs a Jacobian of a problem has built."""
    before = _program_of.cache_info().misses
    objective.sums(objective.start(objective.space.initial), criterion_of(objective))
    return _program_of.cache_info().misses - before


def shortened(flight, seconds):
    """Return a flight without its last seconds."""
    kept = flight.time <= flight.time[-1] - seconds
    end = flight.time[kept][-1]
    return replace(
        flight,
        time=flight.time[kept],
        signals={name: rows[kept] for name, rows in flight.signals.items()},
        series={
            name: Series(signal.time[signal.time <= end], signal.values[signal.time <= end])
            for name, signal in flight.series.items()
        },
    )


@pytest.mark.parametrize("free", [("inertia_zz", "mass", "moment_constant"), ("estimate_latency",)])
def test_other_coefficients_and_bounds_are_the_same_program(free):
    built(problem(("inertia_xx", "motor_constant")))
    prior = {"coefficients": {free[0]: {"prior": {"mean": 0.03, "sd": 0.01}}}}
    assert built(problem(free, job=prior)) == 0


def test_a_flight_of_another_length_is_the_same_program(flight, updated):
    settings = resolve_settings(Options(flights=(str(flight.path),), vehicle=updated))
    whole, part = (
        job_of(settings, recordings_of(settings, [each])).objective
        for each in (flight, shortened(flight, 7.3))
    )
    assert whole.samples != part.samples
    built(whole)
    assert built(part) == 0


def test_windows_from_recorded_and_from_free_starts_are_the_same_program(full_flight, updated):
    settings = resolve_settings(Options(flights=(str(full_flight.path),), vehicle=updated))
    windows = JobFile(free=("motor_constant",), inlet="actuator", search=Search(window=0.5))
    settings = replace(settings, job=windows)
    recorded = job_of(settings, recordings_of(settings, [full_flight])).objective
    assert recorded.segments.start_sd is None
    sd = np.ones((len(recorded.segments.free_rows), recorded.segments.count))
    free = replace(recorded, segments=replace(recorded.segments, start_sd=sd))
    built(recorded)
    assert built(free) == 0


def test_programs_of_flights_are_kept_for_other_processes():
    assert digest_of((simulation._flight, terms.TERMS), simulation.CODE)


def test_columns_do_not_depend_on_other_free_coefficients():
    groups = ("inertia_xx", "inertia_zz", "mass"), ("motor_constant", "moment_constant")
    fit = problem((*groups[0], *groups[1]))
    names, criterion = list(fit.space.names), criterion_of(fit)
    together = fit.jacobian(fit.start(fit.space.initial), criterion)
    for group in groups:
        part = problem(group)
        alone = part.jacobian(part.start(part.space.initial), criterion)
        for channel, columns in alone.columns.items():
            for number, name in enumerate(part.space.names):
                np.testing.assert_allclose(
                    together.columns[channel][names.index(name)],
                    columns[number],
                    rtol=1e-9,
                    atol=1e-9,
                )
            offsets = together.columns[channel][len(names) :]
            np.testing.assert_allclose(offsets, columns[len(group) :], rtol=1e-9, atol=1e-9)


def test_segments_give_the_same_sums_one_at_a_time_as_many_at_once():
    """Those that the memory does not hold at once take turns."""
    fit = problem(("inertia_xx", "time_constant_up"))
    which = np.arange(11) % fit.segments.count
    segments = jax.tree.map(lambda leaf: np.asarray(leaf)[..., which], fit.segments)
    many = replace(fit, segments=replace(segments, flight=np.arange(len(which))))
    small = replace(many, memory=1)
    point = many.start(np.asarray(many.space.initial))
    want = many.sums(point, criterion_of(many))
    got = small.sums(point, criterion_of(small))
    np.testing.assert_allclose(got.hessian, want.hessian, rtol=1e-12)
    np.testing.assert_allclose(got.loss, want.loss, rtol=1e-12)
    alone, beside = (of.jacobian(point, criterion_of(of)) for of in (small, many))
    jax.tree.map(np.testing.assert_array_equal, alone, beside)
