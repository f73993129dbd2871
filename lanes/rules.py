"""Elementwise primitives: one rule each, from LLVM values to an LLVM value.

Operands are scalars or vectors of one width; a rule does not see which.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir

from lanes.emitter import (
    CONTRACT,
    I32,
    I64,
    Emitter,
    constant,
    converted,
    is_bool,
    is_float,
    type_of,
)
from lanes.values import Element, Tangent, UnsupportedError, base, is_vector

Parameters: TypeAlias = Mapping[str, Any]
Rule: TypeAlias = Callable[..., ir.Value]

SIGNLESS = frozenset({"and", "or", "xor", "not", "bitcast_convert_type"})
"""Primitives that do the same to whole numbers without a sign; other rules have those with one."""


def _arithmetic(of_floats: str, of_integers: str) -> Rule:
    def rule(e: Emitter, _: Parameters, x: ir.Value, y: ir.Value) -> ir.Value:
        if is_float(x):
            return getattr(e.b, of_floats)(x, y, flags=e.flags)
        return getattr(e.b, of_integers)(x, y)

    return rule


def _compare(sign: str) -> Rule:
    def rule(e: Emitter, _: Parameters, x: ir.Value, y: ir.Value) -> ir.Value:
        if is_float(x):
            compare = e.b.fcmp_unordered if sign == "!=" else e.b.fcmp_ordered
            return compare(sign, x, y)
        if is_bool(x):
            return e.b.icmp_unsigned(sign, x, y)
        return e.b.icmp_signed(sign, x, y)

    return rule


def _intrinsic(name: str) -> Rule:
    return lambda e, _, x: e.intrinsic(name, x)


def _libm(name: str) -> Rule:
    return lambda e, _, *operands: e.libm(name, *operands)


def _divide(e: Emitter, _: Parameters, x: ir.Value, y: ir.Value) -> ir.Value:
    """Divide; whole numbers as XLA does: by zero -1, and no trap where the quotient overflows."""
    if is_float(x):
        return e.b.fdiv(x, y, flags=CONTRACT)
    by_zero, lowest, wraps = _special(e, x, y)
    safe = e.select(e.b.or_(by_zero, wraps), e.number(y, 1), y)
    quotient = e.select(wraps, lowest, e.b.sdiv(x, safe))
    return e.select(by_zero, e.number(x, -1), quotient)


def _remainder(e: Emitter, _: Parameters, x: ir.Value, y: ir.Value) -> ir.Value:
    if is_float(x):
        return e.libm("fmod", x, y)
    by_zero, _, wraps = _special(e, x, y)
    safe = e.select(e.b.or_(by_zero, wraps), e.number(y, 1), y)
    return e.select(by_zero, x, e.b.srem(x, safe))


def _special(e: Emitter, x: ir.Value, y: ir.Value) -> tuple[ir.Value, ir.Value, ir.Value]:
    lowest = e.number(x, -(2 ** (base(x.type).width - 1)))
    wraps = e.b.and_(e.b.icmp_signed("==", x, lowest), e.b.icmp_signed("==", y, e.number(y, -1)))
    return e.b.icmp_signed("==", y, e.number(y, 0)), lowest, wraps


def _extreme(sign: str) -> Rule:
    def rule(e: Emitter, _: Parameters, x: ir.Value, y: ir.Value) -> ir.Value:
        if is_bool(x):
            return e.b.or_(x, y) if sign == ">" else e.b.and_(x, y)
        if not is_float(x):
            return e.select(e.b.icmp_signed(sign, x, y), x, y)
        beyond = e.b.or_(e.b.fcmp_ordered(sign, x, y), e.isnan(x))
        return e.select(beyond, x, y)

    return rule


_larger, _smaller = _extreme(">"), _extreme("<")


def _absolute(e: Emitter, _: Parameters, x: ir.Value) -> ir.Value:
    if is_float(x):
        return e.intrinsic("fabs", x)
    return e.select(e.b.icmp_signed("<", x, e.number(x, 0)), e.b.neg(x), x)


def _sign(e: Emitter, _: Parameters, x: ir.Value) -> ir.Value:
    if not is_float(x):
        above = e.b.zext(e.b.icmp_signed(">", x, e.number(x, 0)), x.type)
        below = e.b.zext(e.b.icmp_signed("<", x, e.number(x, 0)), x.type)
        return e.b.sub(above, below)
    unit = e.intrinsic("copysign", e.number(x, 1.0), x)
    whole = e.b.fcmp_unordered("!=", x, e.number(x, 0.0))
    return e.select(e.isnan(x), x, e.select(whole, unit, x))


def _integer_power(e: Emitter, p: Parameters, x: ir.Value) -> ir.Value:
    exponent, factor, result = abs(p["y"]), x, None
    multiply = ELEMENTWISE["mul"]
    while exponent:
        if exponent & 1:
            result = factor if result is None else multiply(e, p, result, factor)
        exponent >>= 1
        if exponent:
            factor = multiply(e, p, factor, factor)
    if result is None:
        return e.number(x, 1)
    return _divide(e, p, e.number(x, 1), result) if p["y"] < 0 else result


_LOG_2E = 1.4426950408889634
_EXPONENTS = {
    ir.DoubleType(): (I64, 52, 1.90821492927058770002e-10, 0.693147180369123816490, -746.0, 710.0),
    ir.FloatType(): (I32, 23, -2.12194440e-4, 0.693359375, -104.0, 89.0),
}
"""Whole numbers as wide, bits of the fraction, ln 2 as a small part and one whose multiples have no
rounding error, and beyond which numbers the exponential is zero and infinite."""


def _exponential(e: Emitter, x: ir.Value) -> tuple[ir.Value, ir.Value, ir.Value, ir.Value]:
    """Return q, s, t, 1/t with exp x = (1 + q)·s·t, s and t powers of two.

    x is k·ln 2 and a rest of half a ln 2 at most, whose exponential is summed up. A function of
    the C library would be called lane by lane.
    """

    def number(value: float) -> ir.Value:
        return e.number(x, value)

    def plus(a: ir.Value, b: ir.Value, factor: ir.Value) -> ir.Value:
        return e.b.fadd(e.b.fmul(b, factor, flags=CONTRACT), a, flags=CONTRACT)

    integer, fraction, small, large, lowest, highest = _EXPONENTS[base(x.type)]
    whole = e.vector(integer) if is_vector(x) else integer
    within = e.select(e.b.fcmp_ordered(">", x, number(highest)), number(highest), x)
    within = e.select(e.b.fcmp_ordered("<", within, number(lowest)), number(lowest), within)
    # a number so large has no fraction: the last bits of the sum are k
    round_to = number(1.5 * 2.0**fraction)
    rounded = plus(round_to, within, number(_LOG_2E))
    k = e.b.fsub(rounded, round_to)
    rest = plus(plus(within, k, number(-large)), k, number(-small))
    terms = 14 if fraction == 52 else 9
    total = number(1.0 / math.factorial(terms))
    for order in range(terms - 1, 1, -1):
        total = plus(number(1.0 / math.factorial(order)), total, rest)
    q = plus(rest, e.b.fmul(rest, rest, flags=CONTRACT), total)
    count = e.b.sub(e.b.bitcast(rounded, whole), e.b.bitcast(round_to, whole))
    half = e.b.ashr(count, constant(whole, 1))

    def two_to(power: ir.Value) -> ir.Value:
        bias = constant(whole, 1023 if fraction == 52 else 127)
        return e.b.bitcast(e.b.shl(e.b.add(power, bias), constant(whole, fraction)), x.type)

    other = e.b.sub(count, half)
    return q, two_to(half), two_to(other), two_to(e.b.neg(other))


def _exp(e: Emitter, _: Parameters, x: ir.Value) -> ir.Value:
    q, s, t, _ = _exponential(e, x)
    return e.b.fmul(e.b.fmul(e.b.fadd(q, e.number(x, 1.0)), s), t)


def _expm1(e: Emitter, _: Parameters, x: ir.Value) -> ir.Value:
    q, s, t, inverse = _exponential(e, x)
    rest = e.b.fmul(t, e.b.fadd(e.b.fmul(q, s), e.b.fsub(s, inverse)))
    tiny = e.b.fcmp_ordered("<", e.intrinsic("fabs", x), e.number(x, 1e-30))
    return e.select(tiny, x, rest)  # keeps the sign of zero; the square of a tiny number is zero


def _logistic(e: Emitter, p: Parameters, x: ir.Value) -> ir.Value:
    one = e.number(x, 1.0)
    return e.b.fdiv(one, e.b.fadd(one, _exp(e, p, e.b.fneg(x))))


def _round(e: Emitter, p: Parameters, x: ir.Value) -> ir.Value:
    to_even = int(p["rounding_method"]) == 1  # lax.RoundingMethod.TO_NEAREST_EVEN
    return e.intrinsic("roundeven" if to_even else "round", x)


def _power(e: Emitter, _: Parameters, x: ir.Value, y: ir.Value) -> ir.Value:
    if not is_float(y):
        y = e.b.sitofp(y, x.type)
    return e.intrinsic("pow", x, y)


def _select_n(e: Emitter, _: Parameters, which: ir.Value, *cases: ir.Value) -> ir.Value:
    if is_bool(which):
        return e.select(which, cases[1], cases[0])
    chosen = cases[0]
    for number, case in enumerate(cases[1:], start=1):
        at_least = e.b.icmp_signed(">=", which, e.number(which, number))
        chosen = e.select(at_least, case, chosen)
    return chosen


def _reduce_precision(e: Emitter, p: Parameters, x: ir.Value) -> ir.Value:
    if (p["exponent_bits"], p["mantissa_bits"]) == (11, 52) or isinstance(
        base(x.type), ir.FloatType
    ):
        return x
    if (p["exponent_bits"], p["mantissa_bits"]) != (8, 23):
        raise UnsupportedError(f"reduce_precision to {p['mantissa_bits']} bits")
    return converted(e, converted(e, x, ir.FloatType()), ir.DoubleType())


def _bits(kind: ir.Type) -> int:
    return {ir.DoubleType(): 64, ir.FloatType(): 32}.get(kind) or int(kind.width)


def _same_bits(e: Emitter, p: Parameters, x: ir.Value) -> ir.Value:
    to = type_of(p["new_dtype"])
    if _bits(to) != _bits(base(x.type)):
        raise UnsupportedError(f"bits of {base(x.type)} as {p['new_dtype']}")
    return e.b.bitcast(x, e.vector(to) if is_vector(x) else to)


def _polynomial(e: Emitter, _: Parameters, x: ir.Value, *coefficients: ir.Value) -> ir.Value:
    """Sum up powers, their coefficients from the lowest."""

    def higher(total: ir.Value, coefficient: ir.Value) -> ir.Value:
        return e.b.fadd(e.b.fmul(total, x, flags=CONTRACT), coefficient, flags=CONTRACT)

    return reduce(higher, reversed(coefficients))


ELEMENTWISE: dict[str, Rule] = {
    "add": _arithmetic("fadd", "add"),
    "add_any": _arithmetic("fadd", "add"),
    "sub": _arithmetic("fsub", "sub"),
    "mul": _arithmetic("fmul", "mul"),
    "div": _divide,
    "rem": _remainder,
    "max": _larger,
    "min": _smaller,
    "pow": _power,
    "atan2": _libm("atan2"),
    "nextafter": _libm("nextafter"),
    "neg": lambda e, _, x: e.b.fneg(x) if is_float(x) else e.b.neg(x),
    "abs": _absolute,
    "sign": _sign,
    "square": lambda e, _, x: e.b.fmul(x, x, flags=CONTRACT) if is_float(x) else e.b.mul(x, x),
    "integer_pow": _integer_power,
    "sqrt": _intrinsic("sqrt"),
    "rsqrt": lambda e, _, x: e.b.fdiv(e.number(x, 1.0), e.intrinsic("sqrt", x), flags=CONTRACT),
    "cbrt": _libm("cbrt"),
    "exp": _exp,
    "exp2": _intrinsic("exp2"),
    "log": _intrinsic("log"),
    "expm1": _expm1,
    "log1p": _libm("log1p"),
    "sin": _intrinsic("sin"),
    "cos": _intrinsic("cos"),
    "tan": _libm("tan"),
    "asin": _libm("asin"),
    "acos": _libm("acos"),
    "atan": _libm("atan"),
    "sinh": _libm("sinh"),
    "cosh": _libm("cosh"),
    "tanh": _libm("tanh"),
    "asinh": _libm("asinh"),
    "acosh": _libm("acosh"),
    "atanh": _libm("atanh"),
    "erf": _libm("erf"),
    "erfc": _libm("erfc"),
    "logistic": _logistic,
    "floor": _intrinsic("floor"),
    "ceil": _intrinsic("ceil"),
    "round": _round,
    "is_finite": lambda e, _, x: e.b.fcmp_ordered("<", e.intrinsic("fabs", x), e.number(x, np.inf)),
    "lt": _compare("<"),
    "le": _compare("<="),
    "gt": _compare(">"),
    "ge": _compare(">="),
    "eq": _compare("=="),
    "ne": _compare("!="),
    "and": lambda e, _, x, y: e.b.and_(x, y),
    "or": lambda e, _, x, y: e.b.or_(x, y),
    "xor": lambda e, _, x, y: e.b.xor(x, y),
    "not": lambda e, _, x: e.b.not_(x),
    "clamp": lambda e, p, lower, x, upper: _smaller(e, p, _larger(e, p, x, lower), upper),
    "select_n": _select_n,
    "convert_element_type": lambda e, p, x: converted(e, x, type_of(p["new_dtype"])),
    "bitcast_convert_type": _same_bits,
    "polynomial": _polynomial,
    "reduce_precision": _reduce_precision,
    **dict.fromkeys(
        ("copy", "copy_p", "stop_gradient", "real", "optimization_barrier"), lambda _, __, x: x
    ),
}
"""Primitive -> rule, for elementwise primitives."""


def apply(emitter: Emitter, name: str, params: Parameters, *elements: Element) -> Element:
    """Apply a rule to elements, column by column where one is a tangent."""
    rule = ELEMENTWISE[name]
    moving = [x for x in elements if isinstance(x, Tangent)]
    if moving:
        to = name == "convert_element_type"
        kind = type_of(params["new_dtype"]) if to else moving[0].kind
        return Tangent(kind, name, params, elements)
    own = int(name == "select_n")  # the condition may be of another width than the choices
    return rule(emitter, params, *elements[:own], *emitter.alike(*elements[own:]))
