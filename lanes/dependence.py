"""Which variables of a jaxpr depend on some of its inputs: on a lane's own, or on a tangent."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import or_
from typing import Any

from jax.extend.core import Jaxpr, JaxprEqn, Literal

CALLS = frozenset(
    {
        "jit",
        "pjit",
        "closed_call",
        "core_call",
        "remat2",
        "remat",
        "checkpoint",
        "custom_jvp_call",
        "custom_vjp_call",
        "custom_vmap_call",
    }
)
"""Primitives that call a jaxpr once, with their own operands."""


def called(params: Any) -> tuple[Jaxpr, Sequence[Any]]:
    """Return the jaxpr that a primitive of `CALLS` calls, and its constants."""
    inner = next(
        params[key] for key in ("jaxpr", "call_jaxpr", "call", "fun_jaxpr") if key in params
    )
    return (inner.jaxpr, inner.consts) if hasattr(inner, "consts") else (inner, ())


def dependent(jaxpr: Jaxpr, flags: Sequence[int]) -> list[int]:
    """Return for each output whether it depends on a flagged input.

    The condition of a branch or of a loop counts too. A flag is a truth value, or a set of
    bits: then an output has the bits of all inputs that it depends on.
    """
    known = dict(zip(jaxpr.invars, flags, strict=True))
    for eqn in jaxpr.eqns:
        ins = [0 if isinstance(v, Literal) else known.get(v, 0) for v in eqn.invars]
        if not any(ins):
            continue
        name = eqn.primitive.name
        if name == "cond":
            outs = [ins[0]] * len(eqn.outvars)
            for branch in eqn.params["branches"]:
                outs = list(map(or_, outs, dependent(branch.jaxpr, ins[1:])))
        elif name == "scan":
            outs = dependent_in_scan(eqn, ins)
        elif name == "while":
            outs = dependent_in_while(eqn.params, ins)
        elif name in CALLS:
            outs = dependent(called(eqn.params)[0], ins)
        else:
            outs = [reduce(or_, ins)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, outs, strict=True))
    return [0 if isinstance(v, Literal) else known.get(v, 0) for v in jaxpr.outvars]


def parts_of_scan(eqn: JaxprEqn) -> tuple[int, int]:
    """Return how many operands of a scan are constants, and how many values it carries.

    Told by the axis that only what goes by turns has outside of the body: releases of jax name
    these numbers differently.
    """
    body = eqn.params["jaxpr"].jaxpr

    def by_turns(outside: Sequence[Any], inside: Sequence[Any]) -> int:
        return sum(o.aval.ndim > i.aval.ndim for o, i in zip(outside, inside, strict=True))

    carried = len(eqn.outvars) - by_turns(eqn.outvars, body.outvars)
    return len(eqn.invars) - by_turns(eqn.invars, body.invars) - carried, carried


def dependent_in_scan(eqn: JaxprEqn, flags: Sequence[int]) -> list[int]:
    """Return for each output of a scan, carry first, whether it depends on a flagged operand."""
    body, (consts, carried) = eqn.params["jaxpr"].jaxpr, parts_of_scan(eqn)
    now = list(flags)
    while True:
        outs = dependent(body, now)
        carry = now[consts : consts + carried]
        after = list(map(or_, carry, outs))
        if after == carry:
            return after + outs[carried:]
        now[consts : consts + carried] = after


def dependent_in_while(params: Any, flags: Sequence[int]) -> list[int]:
    """Return for each carried value of a while loop whether it depends on a flagged operand."""
    conds, consts = params["cond_nconsts"], params["body_nconsts"]
    of_cond, of_body = list(flags[:conds]), list(flags[conds : conds + consts])
    carry = list(flags[conds + consts :])
    while True:
        ends = dependent(params["cond_jaxpr"].jaxpr, of_cond + carry)[0]
        outs = dependent(params["body_jaxpr"].jaxpr, of_body + carry)
        after = [a | b | ends for a, b in zip(carry, outs, strict=True)]
        if after == carry:
            return after
        carry = after
