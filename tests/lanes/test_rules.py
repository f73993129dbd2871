"""Every primitive with a rule gives what jax gives, on random numbers and on those at the edge."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from lanes import Argument, Program

EDGES = [0.0, -0.0, 1.0, -1.0, 0.5, 1e-300, -1e-300, 1e300, -1e300, np.inf, -np.inf, np.nan]
WHOLE_EDGES = [0, 1, -1, 2, -2, 7, -7, 2**31 - 1, -(2**31)]
RANDOM = np.random.default_rng(0)
FLOATS = np.concatenate([np.array(EDGES), RANDOM.normal(size=30), 100.0 * RANDOM.normal(size=7)])
WHOLE = np.concatenate([np.array(WHOLE_EDGES), RANDOM.integers(-50, 50, 20)])
BOOLS = np.array([True, False, True, True, False])


def agree(functions, *arguments, rtol=2e-15, of=None):
    """Hold the kernel of functions of numbers, by name, against jax, every lane of its own.

    ``of`` has their own tolerances.
    """

    def each(*given):
        return {name: function(*given) for name, function in functions.items()}

    kinds = [Argument(np.shape(a)[:-1], a.dtype, lanes=True) for a in arguments]
    program = Program(lambda given, _: each(*given), tuple(kinds))
    assert program.is_kernel
    run = program(arguments, lanes=np.shape(arguments[0])[-1])
    expected = jax.jit(jax.vmap(each, in_axes=-1))(*map(jnp.asarray, arguments))
    for name in functions:
        got, want = run.values[name], np.asarray(expected[name])
        assert got.dtype == want.dtype, name
        smallest = np.finfo(got.dtype).tiny if got.dtype.kind == "f" else 0.0  # XLA flushes below
        near = (of or {}).get(name, rtol)
        np.testing.assert_allclose(got, want, rtol=near, atol=smallest, err_msg=name)


def pairs(values):
    """Return all pairs of some numbers, as two arrays."""
    first, second = np.meshgrid(values, values)
    return first.ravel(), second.ravel()


UNARY = {
    "neg": lambda x: -x,
    "abs": jnp.abs,
    "sign": jnp.sign,
    "square": lax.square,
    "sqrt": lax.sqrt,
    "rsqrt": lax.rsqrt,
    "cbrt": lax.cbrt,
    "exp": lax.exp,
    "exp2": lax.exp2,
    "log": lax.log,
    "expm1": lax.expm1,
    "log1p": lax.log1p,
    "sin": lax.sin,
    "cos": lax.cos,
    "tan": lax.tan,
    "asin": lax.asin,
    "acos": lax.acos,
    "atan": lax.atan,
    "sinh": lax.sinh,
    "cosh": lax.cosh,
    "tanh": lax.tanh,
    "asinh": lax.asinh,
    "acosh": lax.acosh,
    "atanh": lax.atanh,
    "erf": lax.erf,
    "erfc": lax.erfc,
    "logistic": lax.logistic,
    "floor": lax.floor,
    "ceil": lax.ceil,
    "round": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN),
    "round away": lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO),
    "is_finite": lax.is_finite,
    "square power": lambda x: lax.integer_pow(x, 2),
    "fifth power": lambda x: lax.integer_pow(x, 5),
    "inverse cube": lambda x: lax.integer_pow(x, -3),
    "no power": lambda x: lax.integer_pow(x, 0),
    "single precision": lambda x: lax.reduce_precision(x, 8, 23),
    "as a whole number": lambda x: lax.convert_element_type(x, jnp.int32),
    "as a truth value": lambda x: lax.convert_element_type(x, bool),
    "as float32": lambda x: lax.convert_element_type(x, jnp.float32),
    "at most": lambda x: lax.clamp(x.dtype.type(-0.7), x, x.dtype.type(0.9)),
}
ACCURATE = {
    "erf",
    "erfc",
    "asinh",
    "acosh",
    "atanh",
    "tan",
    "sinh",
    "cosh",
    "tanh",
    "exp2",
    "cbrt",
    "logistic",
    "log1p",
    "expm1",
}
"""Of which XLA's own approximation differs from the C library's in the last digits."""


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_functions_of_a_real_number(dtype):
    with np.errstate(over="ignore"):
        values = FLOATS.astype(dtype)
    unit = 8e-15 if dtype == np.float64 else 4e-6
    agree(UNARY, values, rtol=unit, of=dict.fromkeys(ACCURATE, 125 * unit))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", ["exp", "expm1"])
def test_an_exponential_is_right_to_two_units_in_the_last_place(name, dtype):
    rng = np.random.default_rng(1)
    info = np.finfo(dtype)
    beyond, least = np.log(float(info.max)) + 2.0, np.log(float(info.tiny)) - 50.0
    special = [0.0, -0.0, 1e-35, -1e-35, np.inf, -np.inf, np.nan, beyond, least]
    inside = [rng.uniform(-3, 3, 500), rng.uniform(least, beyond, 500)]
    values = np.concatenate([special, *inside]).astype(dtype)
    program = Program(lambda x, _: UNARY[name](x), Argument((), dtype, lanes=True))
    got = program(values, lanes=len(values)).values
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        want = getattr(np, name)(values.astype(np.longdouble)).astype(dtype)
    whole = np.isfinite(want)
    units = np.spacing(np.maximum(np.abs(want[whole]), info.tiny))
    assert np.max(np.abs(got[whole] - want[whole]) / units) <= 2.0
    np.testing.assert_array_equal(got[~whole], want[~whole])
    np.testing.assert_array_equal(np.signbit(got[:2]), np.signbit(want[:2]))


BINARY = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lax.div,
    "rem": lax.rem,
    "max": lax.max,
    "min": lax.min,
    "lt": lambda x, y: x < y,
    "le": lambda x, y: x <= y,
    "gt": lambda x, y: x > y,
    "ge": lambda x, y: x >= y,
    "eq": lambda x, y: x == y,
    "ne": lambda x, y: x != y,
    "select": lambda x, y: jnp.where(x < y, x, y),
}
OF_REALS = {"pow": lax.pow, "atan2": lax.atan2, "nextafter": lax.nextafter}


def test_functions_of_two_real_numbers():
    agree({**BINARY, **OF_REALS}, *pairs(FLOATS), rtol=8e-15)


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_functions_of_whole_numbers(dtype):
    agree(BINARY, *pairs(WHOLE.astype(dtype)))
    of_one = {"neg": lax.neg, "abs": lax.abs, "sign": lax.sign, "cube": lambda x: x**3}
    agree(
        of_one | conversions(np.float64, np.float32, np.int32, np.int64, np.bool_),
        WHOLE.astype(dtype),
    )


def test_functions_of_truth_values():
    of_two = (jnp.logical_and, jnp.logical_or, jnp.logical_xor, lax.max, lax.min, lax.eq, lax.ne)
    agree({function.__name__: function for function in of_two}, *pairs(BOOLS))
    agree({"not": jnp.logical_not} | conversions(np.float64, np.int32), BOOLS)
    agree({"select": lambda x: lax.select_n(x % 3, x, 2 * x, 3 * x)}, np.arange(9))


def test_bits_of_numbers():
    def half(x):
        whole = np.uint64 if x.dtype == np.float64 else np.uint32
        mask = whole((2 ** (4 * x.dtype.itemsize) - 1) << 4 * x.dtype.itemsize)
        return lax.bitcast_convert_type(lax.bitcast_convert_type(x, whole) & mask, x.dtype)

    agree({"upper half": half}, FLOATS)
    agree({"upper half": half}, FLOATS[np.abs(FLOATS) < 1e30].astype(np.float32))
    # rules for what has a sign would be wrong for what has none
    for name, shown in {"max": lax.max, "lt": lax.lt}.items():
        program = Program(
            lambda x, _, shown=shown: shown(lax.bitcast_convert_type(x, np.uint64), np.uint64(1)),
            Argument((), np.float64, lanes=True),
            name=name,
        )
        assert not program.is_kernel


def test_derivatives_of_error_functions():
    of = {f.__name__: jax.grad(f) for f in (lax.erf, lax.erfc)}
    slopes = {f"{name}'s": jax.grad(f) for name, f in of.items()}
    agree(of | slopes, np.linspace(-30.0, 30.0, 41), rtol=1e-12)


def conversions(*types):
    return {f"to {to.__name__}": lambda x, to=to: lax.convert_element_type(x, to) for to in types}


ARRAYS = {
    "broadcast": lambda x: jnp.broadcast_to(x[:, None], (6, 4)),
    "reshape": lambda x: x.reshape(2, 3),
    "transpose": lambda x: x.reshape(2, 3).T,
    "concatenate": lambda x: jnp.concatenate([x[2:], x[:2]]),
    "stack": lambda x: jnp.stack([x, 2.0 * x], axis=1),
    "unstack": lambda x: jnp.unstack(x.reshape(2, 3), axis=1)[1],
    "slice": lambda x: x[1:6:2],
    "split": lambda x: jnp.split(x, [2, 5])[1],
    "reverse": lambda x: x[::-1],
    "pad": lambda x: lax.pad(x, 0.5, [(1, -2, 1)]),
    "iota": lambda x: x * jnp.arange(6),
    "sum": lambda x: jnp.sum(x.reshape(2, 3), axis=1),
    "largest": jnp.max,
    "smallest": lambda x: jnp.min(x.reshape(2, 3), axis=0),
    "product": jnp.prod,
    "any": lambda x: jnp.any(x > 0.5),
    "all": lambda x: jnp.all(x.reshape(3, 2) > -1.0, axis=0),
    "matrix product": lambda x: x.reshape(2, 3) @ jnp.arange(12.0).reshape(3, 4),
    "matrices": lambda x: jnp.einsum("bij,bjk->bik", x.reshape(2, 1, 3), jnp.ones((2, 3, 2))),
    "table": lambda x: x[0] * lax.dynamic_index_in_dim(jnp.arange(600.0) ** 2, jnp.int32(7), 0),
    "changed at": lambda x: lax.dynamic_update_slice(x, x[:2] * 2.0, (3,)),
}


def test_long_arrays_are_joined_and_cut_without_being_laid_out():
    def long(x):
        return jnp.concatenate([x * jnp.arange(300.0)[:, None], jnp.ones((400, 3)), x[None]])

    numbers = np.array([0, 299, 300, 699, 700, 701, -1, 5, 301], np.int32)
    read = {
        "row": lambda x, number: lax.dynamic_index_in_dim(long(x), number, 0),
        "cut": lambda x, _: long(x)[299:302],
        "column": lambda x, n: lax.dynamic_index_in_dim(jnp.unstack(long(x), axis=1)[2], n, 0),
    }
    agree(read, RANDOM.normal(size=(3, 9)), numbers)


def test_what_one_branch_alone_remembers_for_its_derivative():
    def branched(x):
        return lax.cond(x > 0.3, lambda x: jnp.sin(x) * x, jnp.exp, x)

    agree({"cond": jax.grad(branched)}, RANDOM.normal(size=9), rtol=8e-15)


def test_functions_that_move_elements():
    agree(ARRAYS, RANDOM.normal(size=(6, 11)), rtol=8e-15)


def test_a_lane_reads_at_its_own_index_which_is_kept_inside():
    index = np.array([0, 5, -3, 2, 90, 1, 4, 3, 5], np.int32)
    table = RANDOM.normal(size=(6, 9))
    agree({"row": lambda x, i: lax.dynamic_index_in_dim(x, i, 0, keepdims=False)}, table, index)
