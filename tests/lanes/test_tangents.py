"""Derivatives by columns: how few terms they take, and what is read, changed and kept meanwhile."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from llvmlite import ir

from lanes import Argument, Program, joined
from lanes.memory_access import MAX_COLUMNS
from lanes.tangents import Graph
from lanes.values import READ, Tangent

KIND = ir.DoubleType()
RANDOM = np.random.default_rng(3)


def read():
    return Tangent(KIND, READ, {}, (object(),))


def factor():
    return ir.Constant(KIND, ir.Undefined)


def tangent(name, *operands):
    return Tangent(KIND, name, {}, operands)


def operations(graph):
    """Return how many products and sums a column takes."""
    return sum(len(node.sum) for node in graph.nodes if node.terms is not None)


def test_a_chain_of_products_is_one():
    x = read()
    for _ in range(5):
        x = tangent("mul", x, factor())
    assert operations(Graph([x])) == 1


def test_three_numbers_that_three_others_read_are_put_in_together():
    """A vector product by a matrix and another one: nine products of columns, not eighteen."""
    vector = [read() for _ in range(3)]

    def by_matrix(given):
        rows = []
        for _ in range(3):
            x, y, z = (tangent("mul", each, factor()) for each in given)
            rows.append(tangent("add", tangent("add", x, y), z))
        return rows

    assert operations(Graph(by_matrix(by_matrix(vector)))) == 9


def test_what_was_refused_is_tried_again_when_its_readers_have_changed():
    """No number is left, alone or beside those that the same numbers read, that need not be."""
    for seed in range(20):
        random = np.random.default_rng(seed)
        numbers = [read() for _ in range(4)]
        for _ in range(60):
            x, y = (numbers[-i] for i in random.integers(1, 5, 2))
            numbers.append(tangent("add", x, tangent("mul", y, factor())))
        graph = Graph(numbers[-3:])
        together = {frozenset(n.readers): [] for n in graph.nodes}
        for node in graph.nodes:
            together[frozenset(node.readers)].append(node)
        again = [[node] for node in graph.nodes] + list(together.values())
        saved = sum(map(graph._eliminate_nodes, again))
        assert saved == 0


def test_what_many_read_of_many_stays():
    given = [read() for _ in range(4)]
    total = given[0]
    for each in given[1:]:
        total = tangent("add", tangent("mul", total, factor()), tangent("mul", each, factor()))
    outs = [tangent("mul", total, factor()) for _ in range(4)]
    assert operations(Graph(outs)) == 8


def flown(function, size, columns, turns=1, lanes=3):
    """Return derivatives of a kernel and of XLA."""
    program = Program(function, Argument((size,), float, lanes=True, moves=True))
    values, moved = RANDOM.normal(size=(size, lanes)), [RANDOM.normal(size=(columns, size))]
    assert program.is_kernel
    ways = (program, program.by_xla)
    runs = [
        way(values, moved, turns=turns, **({"lanes": lanes} if way is program else {}))
        for way in ways
    ]
    return [np.asarray(run.columns) for run in runs]


@pytest.mark.parametrize("columns", [1, 2, MAX_COLUMNS, MAX_COLUMNS + 1, 3 * MAX_COLUMNS + 2])
@pytest.mark.parametrize("lanes", [1, 3, 17])
def test_any_number_of_columns_is_laid_side_by_side(columns, lanes):
    def function(x, lengths):
        def turn(state, _):
            state = jnp.sin(state) * 0.5 + state[::-1]
            return state, state

        return lax.scan(turn, x, jnp.arange(lengths["turns"]))[1]

    got, want = map(joined, flown(function, 3, columns, turns=4, lanes=lanes))
    assert got.shape == (lanes, 4, 3, columns)
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-13)


def test_a_choice_between_multiples_of_one_number_is_that_number_by_the_chosen_factor():
    x, which = read(), ir.Constant(ir.IntType(1), ir.Undefined)
    chosen = tangent("select_n", which, tangent("mul", x, factor()), tangent("mul", x, factor()))
    assert operations(Graph([chosen])) == 1

    def function(x, _):
        return jnp.where(x > 0, jnp.sqrt(x), jnp.where(x > -1, 3.0 * x, -x))

    got, want = flown(function, 9, 2)
    assert np.isfinite(got).all()
    np.testing.assert_allclose(got, want, rtol=1e-12)


def test_what_is_not_chosen_may_be_no_number():
    def function(x, _):
        size = jnp.sqrt(jnp.sum((x - x) ** 2))
        return jnp.where(size > 0, x * jnp.sum(x) / size, 2.0 * x)

    got, want = flown(function, 3, 2)
    assert np.isfinite(got).all()
    np.testing.assert_allclose(got, want, rtol=1e-12)


def test_a_choice_between_a_sum_and_zero_is_the_sum_with_chosen_factors():
    x, y, which = read(), read(), ir.Constant(ir.IntType(1), ir.Undefined)
    total = tangent("add", tangent("mul", x, factor()), tangent("mul", y, factor()))
    for either in ((total, ir.Constant(KIND, 0.0)), (ir.Constant(KIND, 0.0), total)):
        chosen = tangent("mul", tangent("select_n", which, *either), factor())
        graph = Graph([tangent("add", chosen, x)])
        assert operations(graph) == 2
        assert len(graph.nodes) == 3

    def function(x, _):
        return jnp.where(x > 0, 2.0 * x + x[::-1], 0.0) * x[0] + jnp.where(x > 0, 0.0, x)

    got, want = flown(function, 9, 2)
    np.testing.assert_allclose(got, want, rtol=1e-12)


@pytest.mark.parametrize("twice", [False, True])
def test_what_zero_stands_for_may_be_no_number(twice):
    def function(x, _):
        size = jnp.sqrt(jnp.sum((x - x) ** 2))
        far = x / size
        return jnp.where(size > 0, far * 2.0 + jnp.sin(far) if twice else far, 0.0)

    got, want = flown(function, 3, 2)
    assert np.isfinite(got).all()
    np.testing.assert_array_equal(got, want)


def test_what_does_not_move_in_a_column_is_not_computed_there():
    """No number comes of an infinite slope where nothing moves along it."""

    def function(x, lengths):
        def turn(state, _):
            state = 0.5 * state + jnp.stack([jnp.sqrt(x[0]) * x[1], jnp.sqrt(x[0]), x[2]])
            return state, state

        return lax.scan(turn, jnp.zeros(3) + x[2], jnp.arange(lengths["turns"]))[1]

    program = Program(function, Argument((3,), float, lanes=True, moves=True))
    values, moved = np.abs(RANDOM.normal(size=(3, 16))), [np.eye(3)]
    runs = [program(values, moved, lanes=16, turns=4), program.by_xla(values, moved, turns=4)]
    got, want = (joined(np.asarray(run.columns)) for run in runs)
    np.testing.assert_allclose(got, want, rtol=1e-12)
    values[0] = 0.0
    got = joined(np.asarray(program(values, moved, lanes=16, turns=4).columns))
    assert np.isfinite(got[..., 1:]).all()
    assert not np.isfinite(got[:, :, :2, 0]).any()
    np.testing.assert_allclose(got[..., 2], want[..., 2], rtol=1e-12)


def test_memory_is_read_as_it_was_before_it_was_changed():
    """What a delay line held is asked for after it is changed, in a sum that is written, too."""

    def function(x, lengths):
        def turn(carry, number):
            line, kept = carry
            old = lax.dynamic_index_in_dim(line, number % 3, 0, keepdims=False)
            line = lax.dynamic_update_index_in_dim(line, old * kept + kept, number % 3, 0)
            new = lax.dynamic_index_in_dim(line, number % 3, 0, keepdims=False)
            kept = jnp.sin(old) + 0.5 * new
            return (line, kept), old - new

        line = jnp.zeros((30, 2)) + x
        return lax.scan(turn, (line, x), jnp.arange(lengths["turns"]))[1]

    got, want = flown(function, 2, 4, turns=9)
    np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-12)


def test_a_branch_changes_what_a_loop_carries_only_where_nothing_else_asks_for_it():
    def function(x, lengths):
        def turn(carry, number):
            a, b = carry
            due = number % 3 == 0
            changed = lax.cond(due, lambda: jnp.cos(a) * b, lambda: a)
            later = lax.cond(due, lambda: b * 1.5, lambda: b)
            return (changed, later + a * 0.1), changed - b

        return lax.scan(turn, (x, x * 2.0), jnp.arange(lengths["turns"]))[1]

    got, want = flown(function, 2, 3, turns=8)
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-13)


def test_numbers_do_not_depend_on_how_many_columns_there_are():
    def function(x, lengths):
        def turn(state, _):
            return jnp.sin(state) + 0.1 * state[::-1] ** 2, state

        return lax.scan(turn, x, jnp.arange(lengths["turns"]))[1]

    program = Program(function, Argument((3,), float, lanes=True, moves=True))
    values, moved = RANDOM.normal(size=(3, 5)), RANDOM.normal(size=(20, 3))
    whole = program(values, [moved], lanes=5, turns=6).columns
    some = program(values, [moved[:3]], lanes=5, turns=6).columns
    np.testing.assert_array_equal(jax.device_get(whole[:, :3]), some)
