"""Loops, conditions, memory and columns of a program against XLA; what it does where it cannot."""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import subprocess
import sys
import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lanes.linear as lanes_linear
import lanes.program
from lanes import Argument, Program, dependent, joined, keep_code_in
from lanes.machine import object_code, register_bytes
from lanes.memory_access import LINE_BYTES

RANDOM = np.random.default_rng(1)


def filtered(given, lengths):
    """Return a delay line's answer to a table: loops, conditions of a lane and of all, memory."""
    x, gain, table = given["x"], given["gain"], given["table"]

    def turn(carry, number):
        state, line = carry
        row = lax.dynamic_index_in_dim(table, number, 0, keepdims=False)
        line = lax.dynamic_update_index_in_dim(line, state * row, number % 4, 0)
        late = lax.dynamic_index_in_dim(line, (number + 1) % 4, 0, keepdims=False)
        state = lax.cond(
            number % 2 == 0, lambda: jnp.sin(state) + late * gain, lambda: state * 0.9 + late
        )
        state = lax.fori_loop(0, 3, lambda _, s: s - 0.1 * gain * s, state)
        state = lax.cond(state[0] > 1.0, lambda: state - 1.0, lambda: state)
        return (state, line), {"state": state, "twice": state[0] * 2.0, "high": state[1] > 0.0}

    (state, _), rows = lax.scan(turn, (x, jnp.zeros((4, 3), x.dtype)), jnp.arange(lengths["turns"]))
    return rows, state


ARGUMENTS = {
    "x": Argument((3,), float, lanes=True, moves=True),
    "gain": Argument((), float, lanes=False, moves=True),
    "table": Argument(("rows", 3), float, lanes=True),
}


def given(count, rows, seed=2):
    random = np.random.default_rng(seed)
    values = {
        "x": random.normal(size=(3, count)),
        "gain": np.array(0.3),
        "table": random.normal(size=(rows, 3, count)),
    }
    return values, [random.normal(size=5), random.normal(size=(5, 3))]


def flat(run):
    """Return all arrays of a run, columns side by side."""
    (rows, _), (moved_rows, moved) = run.values, run.columns
    return [
        *jax.tree.leaves(rows),
        run.values[1],
        *(joined(moved_rows[name]) for name in ("state", "twice")),
        moved,
    ]


@pytest.fixture(scope="module")
def program():
    return Program(filtered, ARGUMENTS)


@pytest.mark.parametrize(("count", "turns"), [(1, 7), (3, 20), (8, 1), (19, 32), (19, 33), (64, 2)])
def test_one_program_serves_every_length_and_every_number_of_lanes(program, count, turns):
    values, tangents = given(count, turns)
    assert program.is_kernel
    got = program(values, tangents, lanes=count, turns=turns)
    assert all(leaf.ctypes.data % LINE_BYTES == 0 for leaf in jax.tree.leaves(got.values))
    want = program.by_xla(values, tangents, turns=turns)
    assert all(type(leaf) is np.ndarray for leaf in jax.tree.leaves((want.values, want.columns)))
    for mine, theirs in zip(flat(got), flat(want), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("real", "turns"), [(float, 9), (np.float32, 37)])
def test_many_lanes_in_wider_blocks_give_what_few_do(monkeypatch, real, turns):
    monkeypatch.setattr(lanes.program, "MIN_STEPS_OF_TWO_VECTORS", 256 * turns)
    still = {name: replace(a, moves=False, dtype=real) for name, a in ARGUMENTS.items()}
    program, count = Program(filtered, still), 259
    values, _ = given(count, turns)
    few = {name: v if name == "gain" else v[..., -5:] for name, v in values.items()}
    wide, narrow = program(values, lanes=count, turns=turns), program(few, lanes=5, turns=turns)
    assert len({kernel.width for kernel in program._kernels.values()}) == 2
    for many, some in zip(
        jax.tree.leaves(wide.values), jax.tree.leaves(narrow.values), strict=True
    ):
        np.testing.assert_allclose(many[-5:], some, rtol=1e-14)


@pytest.mark.parametrize("count", [1, 3, 9])
def test_a_program_for_few_lanes_gives_what_others_do(monkeypatch, count):
    monkeypatch.setattr(lanes.program, "FEW_LANES_BYTES", 16)
    values, tangents = given(count, 7)
    few, many = (Program(filtered, ARGUMENTS, few_lanes=own) for own in (True, False))
    found = [flat(each(values, tangents, lanes=count, turns=7)) for each in (few, many)]
    assert [few._kernel().width, many._kernel().width] == [2, register_bytes() // 8]
    for mine, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-14)


def test_values_beside_derivatives_are_summed_up_in_the_order_that_is_written():
    program = Program(lambda x, _: (x + 1e16) - 1e16, Argument((), float, lanes=True, moves=True))
    run = program(np.array([0.3, 3.0]), [np.ones(1)], lanes=2)
    np.testing.assert_array_equal(run.values, [0.0, 4.0])
    np.testing.assert_array_equal(run.columns, [[1.0], [1.0]])


@pytest.mark.parametrize("count", [1, 3, 4, 9])
def test_lanes_that_lie_apart_are_read_as_those_that_lie_beside_each_other(count):
    """By whole rows, by single numbers and by vectors of them; columns take turns with lanes."""

    def summed(given, lengths):
        table, gain = given["table"], given["gain"]

        def turn(total, number):
            row = lax.dynamic_slice(table, (number, 1, 0), (1, 1, 19))[0, 0]
            part = lax.dynamic_slice(table, (number, 0, 2), (1, 2, 3))[0]
            return total + gain * jnp.sum(row) * part[1, 2], row[:5] * gain

        return lax.scan(turn, given["x"], jnp.arange(lengths["turns"]))

    rng = np.random.default_rng(count)
    values = {
        "x": rng.normal(size=count),
        "gain": np.array(0.3),
        "table": rng.normal(size=(count, 6, 2, 19)).astype(np.float32),
    }
    found = []
    for apart in (True, False):
        arguments = {
            "x": Argument((), float, lanes=True),
            "gain": Argument((), float, lanes=False, moves=True),
            "table": Argument(("rows", 2, 19), np.float32, lanes=True, apart=apart),
        }
        table = values["table"] if apart else np.moveaxis(values["table"], 0, -1)
        program = Program(summed, arguments)
        assert program.is_kernel
        run = program({**values, "table": table}, [np.arange(1.0, 6.0)], lanes=count, turns=6)
        found.append(jax.tree.leaves((run.values, run.columns)))
        by_xla = program.by_xla({**values, "table": table}, [np.arange(1.0, 6.0)], turns=6)
        np.testing.assert_allclose(run.values[0], by_xla.values[0], rtol=1e-6)
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_is_not_wanted_is_not_returned_and_changes_nothing(program):
    values, moved = given(5, 8)
    whole = program(values, moved, lanes=5, turns=8)
    wanted = jax.tree.map(lambda _: True, (whole.values, whole.columns))
    wanted[0][0]["high"] = wanted[0][0]["twice"] = wanted[1][0]["state"] = False
    some = program(values, moved, lanes=5, turns=8, wanted=wanted)
    assert some.values[0]["high"] is some.columns[0]["state"] is None
    np.testing.assert_array_equal(some.values[0]["state"], whole.values[0]["state"])
    np.testing.assert_array_equal(some.columns[0]["twice"], whole.columns[0]["twice"])


@pytest.mark.parametrize("none", [None, [np.zeros(0), np.zeros((0, 3))]])
def test_a_differentiated_program_computes_values_alone(program, none):
    values, tangents = given(19, 33)
    moved = program(values, tangents, lanes=19, turns=33)
    wanted = {"state": True, "twice": None, "high": True}, True
    alone = program(values, none, lanes=19, turns=33, wanted=wanted)
    assert alone.columns is None
    assert alone.values[0]["twice"] is None
    for name in ("state", "high"):
        np.testing.assert_array_equal(alone.values[0][name], moved.values[0][name])
    np.testing.assert_array_equal(alone.values[1], moved.values[1])
    by_xla = program.by_xla(values, none, turns=33)
    assert by_xla.columns is None
    np.testing.assert_allclose(by_xla.values[1], alone.values[1], rtol=1e-13, atol=1e-13)


def test_an_output_has_the_bits_of_all_inputs_that_it_depends_on():
    def function(x, y, z, flag):
        chosen = lax.cond(flag > 0.0, lambda: x, lambda: x * 2.0)
        total = lax.fori_loop(0, 3, lambda _, t: t + y, z)
        ended = lax.while_loop(lambda t: t < x, lambda t: t + 1.0, y)
        return x * y, chosen, total, ended, lax.stop_gradient(z), jnp.ones(())

    jaxpr = jax.make_jaxpr(function)(*[1.0] * 4).jaxpr
    assert dependent(jaxpr, [1, 2, 4, 8]) == [3, 9, 6, 3, 4, 0]
    assert list(map(bool, dependent(jaxpr, [False, True, False, False]))) == [
        True, False, True, True, False, False,
    ]  # fmt: skip


def test_results_do_not_depend_on_threads_nor_on_other_lanes(program, monkeypatch):
    values, tangents = given(37, 25)
    together = flat(program(values, tangents, lanes=37, turns=25))
    monkeypatch.setattr(lanes.program, "TASKS_PER_CORE", 64)
    for mine, theirs in zip(
        together, flat(program(values, tangents, lanes=37, turns=25)), strict=True
    ):
        np.testing.assert_array_equal(mine, theirs)
    some = {"x": values["x"][:, 5:6], "gain": values["gain"], "table": values["table"][..., 5:6]}
    alone = flat(program(some, tangents, lanes=1, turns=25))
    for mine, theirs in zip(together, alone, strict=True):
        np.testing.assert_array_equal(mine[5:6], theirs)


def test_a_loop_that_each_lane_ends_for_itself():
    def halved(x, _):
        return lax.while_loop(lambda c: c[0] > 1.0, lambda c: (c[0] / 2.0, c[1] + 1), (x, 0))

    program = Program(halved, Argument((), float, lanes=True))
    values = np.array([0.5, 3.0, 100.0, 7.0, 1.0, 2.0, 1e9, 5.0, 6.0])
    got = program(values, lanes=9)
    assert program.is_kernel
    want = program.by_xla(values)
    for mine, theirs in zip(got.values, want.values, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_choice_of_several_branches_shared_or_not():
    def chosen(given, _):
        branches = [lambda x: x, lambda x: -x, lambda x: x * x]
        mine = lax.switch(given[0], branches, given[2])
        return mine, lax.switch(given[1], branches, given[2])

    kinds = (
        Argument((), np.int32, lanes=True),
        Argument((), np.int32, lanes=False),
        Argument((), float, lanes=True),
    )
    program = Program(chosen, kinds)
    for shared in (-1, 0, 1, 2, 5):
        index = RANDOM.integers(-1, 4, 11).astype(np.int32)
        values = (index, np.int32(shared), RANDOM.normal(size=11))
        got, want = program(values, lanes=11), program.by_xla(values)
        for mine, theirs in zip(got.values, want.values, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_an_array_read_after_it_was_changed_in_place_is_refused_not_misread():
    def stale(x, lengths):
        def turn(line, number):
            new = lax.dynamic_update_index_in_dim(line, x * number, number % 40, 0)
            old = lax.dynamic_index_in_dim(line, number % 40, 0, keepdims=False)
            return new, old

        return lax.scan(turn, jnp.zeros(40), jnp.arange(lengths["turns"]))[1]

    program = Program(stale, Argument((), float, lanes=True))
    values = np.arange(3.0)
    assert not program.is_kernel
    got = program(values, lanes=3, turns=90)
    np.testing.assert_array_equal(got.values, program.by_xla(values, turns=90).values)


IN_PLACE = {
    "a lane's own choice": lambda line, x, i: lax.cond(
        x > 0.0, lambda: line.at[i % 40].set(x), lambda: line
    ),
    "a shared choice": lambda line, x, i: lax.cond(
        i % 3 == 0, lambda: lax.dynamic_update_index_in_dim(line, x, i % 40, 0), lambda: line
    ),
    "a loop that reads what it was": lambda line, x, _: lax.fori_loop(
        0,
        40,
        lambda j, new: lax.dynamic_update_index_in_dim(
            new, x + lax.dynamic_index_in_dim(line, (j + 1) % 40, 0, keepdims=False), j, 0
        ),
        line,
    ),
    "a loop that changes what others read": lambda line, x, _: (
        line
        + lax.fori_loop(
            0,
            3,
            lambda j, total: (
                total
                + lax.dynamic_index_in_dim(
                    lax.dynamic_update_index_in_dim(line, x * j, 7, 0), 7, 0, keepdims=False
                )
            ),
            jnp.zeros(()),
        )
        * lax.dynamic_index_in_dim(line, 7, 0, keepdims=False)
    ),
}


@pytest.mark.parametrize("how", IN_PLACE)
def test_an_array_changed_in_place_is_what_jax_makes_of_it(how):
    """Or the function is refused: never another number."""

    def function(x, lengths):
        def turn(line, number):
            line = IN_PLACE[how](line, x * jnp.cos(number * x), number)
            return line, line[3] + line[7]

        return lax.scan(turn, jnp.arange(40.0), jnp.arange(lengths["turns"]))[1]

    program = Program(function, Argument((), float, lanes=True))
    values = np.linspace(-2.0, 3.0, 11)
    got = program(values, lanes=11, turns=50)
    want = program.by_xla(values, turns=50)
    np.testing.assert_allclose(got.values, want.values, rtol=1e-12, atol=1e-12)


def test_a_long_constant_that_a_loop_reads_is_changed_to_each_lanes_own():
    empty = jnp.zeros((7, 4))

    def function(given, lengths):
        def turn(state, _):
            def push(place, total):
                line = lax.dynamic_update_index_in_dim(empty, total * state, place, 0)
                return total + line.sum(axis=0) * 0.1

            state = lax.fori_loop(0, 3, push, state)
            return state, state

        return lax.scan(turn, given, jnp.arange(lengths["turns"]))[1]

    program = Program(function, Argument((4,), float, lanes=True, moves=True))
    values, tangents = RANDOM.normal(size=(4, 5)), [RANDOM.normal(size=(2, 4))]
    assert program.is_kernel
    got = program(values, tangents, lanes=5, turns=6)
    want = program.by_xla(values, tangents, turns=6)
    np.testing.assert_allclose(got.values, want.values, rtol=1e-12)
    np.testing.assert_allclose(got.columns, want.columns, rtol=1e-12)


def test_what_has_no_rule_runs_through_xla_and_is_named(caplog):
    def sorted_(x, _):
        return jnp.sort(x)

    program = Program(sorted_, Argument((4,), float, lanes=True), name="sorting")
    values = RANDOM.normal(size=(4, 6))
    with caplog.at_level(logging.DEBUG, logger="lanes"):
        got = program(values, lanes=6)
    np.testing.assert_array_equal(got.values, np.sort(values, axis=0).T)
    assert "sorting runs through XLA: no rule for primitive sort" in caplog.text


def test_what_a_loop_computes_for_nobody_needs_no_rule():
    def summed(x, lengths):
        def turn(total, _):
            return total + x[0], (jnp.sort(x), total)

        return lax.scan(turn, 0.0, jnp.arange(lengths["turns"]))[0]

    program = Program(summed, Argument((2,), float, lanes=True), name="summed")
    got = program(np.array([[2.0, 3.0], [1.0, 1.0]]), lanes=2, turns=4)
    assert program.is_kernel
    np.testing.assert_array_equal(got.values, [8.0, 12.0])


TEXT = "define i32 @seven() {\n ret i32 7\n}\n"


def test_kept_code_is_used_and_damage_is_noticed(kernels):
    code = object_code(TEXT)
    (path,) = kernels.glob("*.o")
    held = path.read_bytes()
    assert held[32:] == code
    assert held[:32] == hashlib.sha256(code).digest()
    other = b"other code"
    path.write_bytes(hashlib.sha256(other).digest() + other)
    assert object_code(TEXT) == other  # it is the file that is read
    for damaged in (b"", held[:40], held[:-1] + b"!", b"x" * len(held)):
        path.write_bytes(damaged)
        assert object_code(TEXT) == code
        assert path.read_bytes() == held


def test_kept_code_is_bounded_and_the_longest_unused_goes(kernels, monkeypatch):
    monkeypatch.setattr(lanes.machine, "MAX_CODE_BYTES", 1500)
    left = kernels / ".code-of-a-process-that-was-killed"
    left.write_bytes(bytes(1000))
    for number in range(6):
        object_code(TEXT.replace("7", str(number)))
    held = list(kernels.glob("*.o"))
    assert not left.exists()
    assert sum(path.stat().st_size for path in held) <= 1500
    assert held


def test_a_folder_that_cannot_be_written_is_no_reason_to_fail(kernels):
    blocked = kernels / "file"
    blocked.write_text("")
    keep_code_in(blocked / "below")
    assert object_code(TEXT)


def test_a_kernel_keeps_nothing_of_what_it_was_made_from():
    """What jax traces of a flight is tens of megabytes, and programs stay for their kernels."""

    def equations():
        jax.clear_caches()
        gc.collect()
        return sum(type(known).__name__ == "JaxprEqn" for known in gc.get_objects())

    before = equations()
    program = Program(filtered, ARGUMENTS)
    assert program.is_kernel
    assert equations() == before


def test_where_jax_computes_in_single_precision_a_kernel_does_too():
    script = (
        "import jax, numpy as np\n"
        "from jax import numpy as jnp\n"
        "from lanes import Argument, Program\n"
        "program = Program(lambda x, _: jnp.sin(x) * 2.5 + 1.0, Argument((), float, lanes=True))\n"
        "got = program(np.arange(5.0), lanes=5).values\n"
        "assert program.is_kernel and got.dtype == np.float32, got.dtype\n"
        "np.testing.assert_allclose(got, 2.5 * np.sin(np.arange(5.0)) + 1.0, rtol=1e-6)\n"
    )
    environment = {**os.environ, "JAX_ENABLE_X64": "false"}
    subprocess.run([sys.executable, "-c", script], env=environment, check=True)


def test_an_array_is_laid_out_without_a_warning():
    with warnings.catch_warnings(action="error"):
        assert Argument.of(jnp.zeros(3, jnp.float32), lanes=True).dtype == jnp.float32


ROWS = 24
WITH_ROWS = {
    "x": Argument((ROWS,), float, lanes=True),
    "matrix": Argument((ROWS, ROWS), float, lanes=True),
    "slot": Argument((), int, lanes=False),
}


def pushed(given, _):
    """Return a matrix times a map's Jacobian from both sides: choices, delay lines, divisions."""
    x, matrix, slot = given["x"], given["matrix"], given["slot"]

    def answer(state):
        line = lax.dynamic_update_index_in_dim(state[4:16].reshape(3, 4), state[:4], slot, 0)
        late = lax.dynamic_index_in_dim(line, (slot + 1) % 3, 0, keepdims=False)
        size = jnp.where(state[16] > 0.0, jnp.sqrt(jnp.where(state[16] > 0.0, state[16], 1.0)), 0.0)
        turned = lax.cond(slot == 1, lambda: jnp.sin(late) * size, lambda: late / (2.0 + size**2))
        turned = lax.cond(state[3] > 0.0, lambda: turned, lambda: turned * state[0])
        swapped = jnp.where(turned > 0.2, turned[::-1], state[17:21])
        rest = jnp.exp(-state[21:]) * jnp.sum(swapped) - state[0] * state[21:]
        return jnp.concatenate([turned, line.ravel(), size[None], swapped, rest])

    _, push = jax.linearize(answer, x)

    def row(_, row):
        return None, push(row)

    def turn(matrix, _):
        half = lax.scan(row, None, matrix)[1]
        whole = lax.scan(row, None, half.T)[1]

        def with_row(i, matrix):
            return lax.dynamic_update_index_in_dim(matrix, 0.1 * whole[i], i, 0)

        return lax.fori_loop(0, len(x), with_row, matrix), None

    matrix, _ = lax.scan(turn, matrix, None, length=2)
    sometimes = lax.cond(slot == 2, lambda: lax.scan(row, None, matrix)[1][0], lambda: matrix[0])
    return matrix, sometimes, lax.scan(row, None, matrix)[1]


def test_rows_that_enter_a_loop_linearly_are_what_they_are_one_by_one(monkeypatch):
    lanes, maps = 5, []
    make = lanes_linear._Map.__init__
    monkeypatch.setattr(lanes_linear._Map, "__init__", lambda *a: (maps.append(a), make(*a))[1])
    random = np.random.default_rng(3)
    values = {
        "x": random.normal(size=(ROWS, lanes)),
        "matrix": random.normal(size=(ROWS, ROWS, lanes)),
    }
    program = Program(pushed, WITH_ROWS)
    assert program.is_kernel
    assert len(maps) == 3, "one of both products, one in a branch, one after it"
    for slot in range(3):
        run = program({**values, "slot": np.array(slot)}, lanes=lanes)
        other = program.by_xla({**values, "slot": np.array(slot)})
        for mine, theirs in zip(run.values, other.values, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-11, atol=1e-11)


def looping(given, call=lambda function: function):
    """Return rows times what a loop in a branch finds, which takes time only where it is taken."""

    @call
    def found(x):
        return lax.fori_loop(0, 2, lambda _, x: jnp.sin(x), x)

    x = given["x"]
    return lambda row: lax.cond(given["slot"] > 0, lambda: row * found(x), lambda: row)


@pytest.mark.parametrize(
    "body",
    [
        lambda _: lambda row: row * jnp.sum(row),
        lambda given: lambda row: given["x"] / (2.0 + row),
        lambda _: lambda row: jnp.where(row > 0.0, row, 0.0),
        lambda _: lambda row: row.astype(int).astype(float),
        looping,
        lambda given: looping(given, jax.jit),
    ],
    ids=["squares", "quotients", "signs", "whole numbers", "loops", "loops in calls"],
)
def test_rows_that_do_not_enter_linearly_stay_rows(monkeypatch, body):
    lanes = 3

    def function(given, _):
        row = body(given)
        return lax.scan(lambda _, r: (None, row(r)), None, given["matrix"])[1]

    monkeypatch.setattr(lanes_linear, "_Map", None)
    random = np.random.default_rng(4)
    values = {
        "x": random.normal(size=(ROWS, lanes)),
        "matrix": random.normal(size=(ROWS, ROWS, lanes)),
        "slot": np.array(1),
    }
    program = Program(function, WITH_ROWS)
    assert program.is_kernel
    np.testing.assert_allclose(program(values, lanes=lanes).values, program.by_xla(values).values)


def test_a_table_that_rows_change_is_as_it_was_after_them():
    """Each changes a copy of it: what a map reads is not changed in place."""

    def function(given, _):
        slot, ones = given["slot"], jnp.ones(ROWS)

        def with_ones(i, table):
            return lax.dynamic_update_index_in_dim(table, ones, i, 0)

        table = lax.fori_loop(0, 9, with_ones, given["table"])

        def row(_, row):
            changed = lax.dynamic_update_index_in_dim(table, 2.0 * given["x"], slot, 0)
            return None, row * changed[slot] + row * changed[slot + 1]

        return lax.scan(row, None, given["matrix"])[1], table

    random = np.random.default_rng(6)
    values = {name: random.normal(size=(ROWS, ROWS, 2)) for name in ("matrix", "table")}
    values["x"] = random.normal(size=(ROWS, 2))
    values["slot"] = np.array(3)
    program = Program(function, WITH_ROWS | {"table": WITH_ROWS["matrix"]})
    assert program.is_kernel
    for mine, theirs in zip(
        program(values, lanes=2).values, program.by_xla(values).values, strict=True
    ):
        np.testing.assert_allclose(mine, theirs)


def test_a_transposed_matrix_is_the_one_before_a_change_in_place():
    """It shares the matrix's memory: read after the change, it has no kernel."""

    def function(given, _):
        def doubled(i, matrix):
            row = 2.0 * lax.dynamic_index_in_dim(matrix, i, 0, keepdims=False)
            return lax.dynamic_update_index_in_dim(matrix, row, i, 0)

        matrix = lax.fori_loop(0, 24, doubled, given)
        turned = matrix.T
        after = lax.fori_loop(0, 24, doubled, matrix)
        return after, lax.dynamic_slice(turned, (2, 0), (1, 24))

    values = np.random.default_rng(5).normal(size=(24, 24, 2))
    program = Program(function, Argument((24, 24), float, lanes=True))
    for mine, theirs in zip(
        program(values, lanes=2).values, program.by_xla(values).values, strict=True
    ):
        np.testing.assert_allclose(mine, theirs)
