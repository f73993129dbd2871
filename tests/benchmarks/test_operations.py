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
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.case import COEFFICIENTS, Kernel, factors, fly

VEHICLES, SAMPLES = 8, 10
flight = partial(fly, samples=SAMPLES)


def jacobian(factor):
    """Return the motion's derivatives by 12 shared factors, (samples, 12, vehicles)."""
    ones = jnp.ones(COEFFICIENTS)
    moved = partial(jax.jvp, lambda shared: flight(factor * shared[:, None]), (ones,))
    return jax.vmap(lambda direction: moved((direction,))[1], out_axes=-2)(jnp.eye(COEFFICIENTS))


COUNTED = {"forward": (flight, 6_943, 102), "jacobian": (jacobian, 102_175, 102)}
"""Function, floating-point operations, and transcendental functions among what it calls."""
MOST_PROGRAMS = 30
"""Programs, small ones too, that the fit of the shipped flights asks jax for."""


@pytest.mark.parametrize("name", COUNTED)
def test_a_step_costs_as_many_operations_as_it_did(name):
    function, operations, functions = COUNTED[name]
    counted = jax.jit(function).lower(factors(VEHICLES)).compile().cost_analysis()
    assert counted["flops"] == pytest.approx(operations, rel=0.02)
    assert counted["transcendentals"] == pytest.approx(functions, rel=0.02)


@pytest.mark.usefixtures("optimised")
def test_the_kernel_that_is_timed_flies_what_xla_does():
    factor = np.asarray(factors(5))
    run = Kernel(moves=True)(factor, samples=30)
    want = jax.jit(partial(fly, samples=30))(factor)
    for found, expected in zip(jax.tree.leaves(run.values), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(found.T, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_a_fit_asks_for_as_few_programs_as_it_did(demo):
    folder, _ = demo
    with (folder / "profile.csv").open() as table:
        rows = list(csv.DictReader(table))
    asked = {row["stage"]: int(row["programs"]) for row in rows}
    assert 0 < sum(asked.values()) <= MOST_PROGRAMS, asked
