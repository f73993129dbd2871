"""Other recordings, bounds and free coefficients find the code that was compiled for the first."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.tuner.uncertainty.making import criterion_of, problem
from tuner.config import Options, settle
from tuner.flights.flight import Series
from tuner.job.prepare import job_of
from tuner.objective import simulator
from tuner.objective.normal import Objective
from tuner.recordings import recordings_of


def program(objective: Objective) -> object:
    """Return what compiled code belongs to: statics, structure, shapes and types."""
    point = objective.start(objective.space.initial)
    arguments = objective.data(point.offsets, criterion_of(objective)), objective.tunable
    leaves = [jax.typeof(np.asarray(leaf)) for leaf in jax.tree.leaves(arguments)]
    return objective.simulator, jax.tree.structure(arguments), leaves


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


@pytest.mark.parametrize("free", [("inertia_zz", "mass"), ("estimate_latency", "quadratic")])
def test_other_coefficients_and_bounds_are_the_same_program(free):
    first = problem(("inertia_xx", "motor_constant"))
    second = problem(free, job={"coefficients": {free[0]: {"prior": {"mean": 0.03, "sd": 0.01}}}})
    assert program(first) == program(second)


def test_a_flight_a_little_shorter_is_the_same_program(flight, updated):
    settings = settle(Options(flights=(str(flight.path),), vehicle=updated))
    jobs = [
        job_of(settings, recordings_of(settings, [part]))
        for part in (flight, shortened(flight, 0.4))
    ]
    assert jobs[0].objective.samples != jobs[1].objective.samples
    assert program(jobs[0].objective) == program(jobs[1].objective)


def test_columns_three_at_a_time_are_those_of_each_fit_and_one_program(monkeypatch):
    groups = ("inertia_xx", "inertia_zz", "mass"), ("motor_constant", "moment_constant")
    fit = problem((*groups[0], *groups[1]))
    names, criterion = list(fit.space.names), criterion_of(fit)
    traced = []
    forward = simulator._jacobian_forward

    def counted(*arguments, **options):
        traced.append(1)
        return forward(*arguments, **options)

    monkeypatch.setattr(simulator, "_jacobian_forward", counted)
    together = fit.jacobian(fit.start(fit.space.initial), criterion, columns=3)
    for group in groups:
        part = problem(group)
        alone = part.jacobian(part.start(part.space.initial), criterion, columns=3)
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
    assert len(traced) <= 1  # by none, if another test was here before
