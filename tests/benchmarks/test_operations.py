"""What a step and its derivatives cost, in counts that do not wander with the machine.

The operations are those that XLA's cost analysis counts in the compiled program: of a loop, one
turn. A change that raises them slows every fit down, whatever a clock says; where it is meant, or
a new release of jax counts otherwise, the figures here change with it, and the commit says why.
The flight is short, for its reference costs six operations a sample before the loop: of 20 s these
would be two thirds of what is counted.
"""

import csv
from functools import partial

import jax
import pytest

from benchmarks.case import factors, fly
from benchmarks.contestants.derivatives import jacobian_of

VEHICLES, SAMPLES = 8, 10
flight = partial(fly, samples=SAMPLES)
jacobian = partial(jacobian_of, flight)
COUNTED = {"forward": (flight, 6_943, 94), "jacobian": (jacobian, 102_175, 94)}
"""Function, floating-point operations, and transcendental functions among what it calls."""
MOST_PROGRAMS = 245
"""Programs, small ones too, that the fit of the shipped flights asks jax for."""


@pytest.mark.parametrize("name", COUNTED)
def test_a_step_costs_as_many_operations_as_it_did(name):
    function, operations, functions = COUNTED[name]
    counted = jax.jit(function).lower(factors(VEHICLES)).compile().cost_analysis()
    assert counted["flops"] == pytest.approx(operations, rel=0.02)
    assert counted["transcendentals"] == pytest.approx(functions, rel=0.02)


@pytest.mark.slow
def test_a_fit_asks_for_as_few_programs_as_it_did(demo):
    folder, _ = demo
    with (folder / "profile.csv").open() as table:
        rows = list(csv.DictReader(table))
    asked = {row["stage"]: int(row["programs"]) for row in rows}
    assert asked["search"] > 0
    assert sum(asked.values()) <= MOST_PROGRAMS, asked
