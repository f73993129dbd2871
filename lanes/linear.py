"""Loops over the rows of matrices that enter linearly: each row is a column of a tangent.

What all rows share is computed before the loop: the map is a graph of sums, of which what can be is
eliminated (`lanes.tangents`). Of a matrix's product with a Jacobian, given as a linear function,
only so much is left for each row.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import reduce
from math import prod
from typing import Any

import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from llvmlite import ir

from lanes.columns import ColumnLoop, factors_of
from lanes.dependence import CALLS, called, parts_of_scan
from lanes.emitter import BOOL, I64, constant, type_of
from lanes.lowering import MAX_IN_REGISTERS, Lowering, dtype_of, read_only, shape_of
from lanes.rules import apply
from lanes.tangents import Graph
from lanes.values import (
    OF_LANE,
    READ,
    Element,
    Elements,
    Memory,
    Tangent,
    Value,
    array_of,
    base,
    kind_of,
)

SHARED_COST = 3.0
"""Cost of an operation on factors, over that of one in all rows: it is code, too."""
_OF_ANY = frozenset(
    {"add", "add_any", "sub", "neg", "copy", "convert_element_type", "reduce_sum", "concatenate"}
    | {"stack", "slice", "split", "rev", "pad", "reshape", "squeeze", "expand_dims", "transpose"}
    | {"broadcast_in_dim", "unstack", "select_n", "cond"}
)
"""Primitives that are linear in all operands that are real numbers."""
_OF_FIRST = frozenset({"div", "dynamic_slice"})
"""Primitives that are linear in the first."""


def _moving(jaxpr: Jaxpr, moves: Sequence[bool]) -> list[bool] | None:
    """Return which outputs depend on some inputs; None where one may not be linear in them."""
    known = dict(zip(jaxpr.invars, moves, strict=True))
    for eqn in jaxpr.eqns:
        ins = [not isinstance(v, Literal) and known.get(v, False) for v in eqn.invars]
        if not any(ins):
            continue
        outs = _moving_of(eqn, ins)
        if outs is None or not all(_is_short(var) for var in eqn.outvars):
            return None
        known.update(zip(eqn.outvars, outs, strict=True))
    return [not isinstance(v, Literal) and known.get(v, False) for v in jaxpr.outvars]


def _is_short(var: Any) -> bool:
    """Return whether a variable is an array of real numbers that lies in registers."""
    real = np.issubdtype(dtype_of(var), np.floating)
    return bool(real and prod(shape_of(var)) <= MAX_IN_REGISTERS)


def _moving_of(eqn: JaxprEqn, ins: Sequence[bool]) -> list[bool] | None:
    name = eqn.primitive.name
    if name in CALLS:
        return _moving(called(eqn.params)[0], ins)
    linear = (
        name in _OF_ANY
        or (name == "mul" and not all(ins))
        or (name in _OF_FIRST and not any(ins[1:]))
        or name == "dynamic_update_slice"
    )
    if not linear or name != "cond":
        return [True] * len(eqn.outvars) if linear else None
    branches = [branch.jaxpr for branch in eqn.params["branches"]]
    if any(map(_has_loop, branches)):
        return None
    found = [_moving(branch, ins[1:]) for branch in branches]
    return [any(of) for of in zip(*found, strict=True)] if None not in found else None


def _has_loop(branch: Jaxpr) -> bool:
    """Return whether a branch may take long, also where it is not taken."""
    return any(
        eqn.primitive.name in {"scan", "while"}
        or (eqn.primitive.name in CALLS and _has_loop(called(eqn.params)[0]))
        for eqn in branch.eqns
    )


class _Map:
    """A linear map as it is written: its inputs, the graph of its outputs, the sums' factors.

    Factors of choices that are not taken must be finite, as reverse mode needs them, too.
    """

    def __init__(
        self, lower: Lowering, eqn: JaxprEqn, consts: Sequence[Value], rows: Sequence[Memory]
    ) -> None:
        body = eqn.params["jaxpr"]
        self.rows = [[Tangent(m.storage.kind, READ, {}, at) for at in _places(m)] for m in rows]
        given = [array_of(row, m.shape[1:]) for row, m in zip(self.rows, rows, strict=True)]
        lower.chooses = True
        outs = lower.run(body.jaxpr, body.consts, [*map(read_only, consts), *given])
        lower.chooses = False
        elements = [e for out in outs for e in lower.elements(out).ravel()]
        self.graph = Graph(elements, shared_cost=SHARED_COST / eqn.params["length"], finite=True)
        self.factors = factors_of(lower.e, self.graph)

    def read(self, rows: Sequence[Memory]) -> None:
        """Take other matrices."""
        for tangents, memory in zip(self.rows, rows, strict=True):
            for tangent, place in zip(tangents, _places(memory), strict=True):
                tangent.operands = place


def _places(matrix: Memory) -> list[tuple[Any, ...]]:
    """Return the places of a matrix's row, with the rows as columns of a tangent."""
    storage = matrix.storage
    row = replace(storage, strides=storage.strides[1:], column_stride=storage.strides[0])
    return [(row, *(constant(I64, i) for i in place)) for place in np.ndindex(matrix.shape[1:])]


def push_rows(lower: Lowering, eqn: JaxprEqn, operands: Sequence[Value]) -> list[Value] | None:
    """Write a scan that carries nothing and is linear in its rows; None for another one."""
    (count, carried), body, length = parts_of_scan(eqn), eqn.params["jaxpr"], eqn.params["length"]
    consts, given = operands[:count], operands[count:]
    rows = [v for v in given if isinstance(v, Memory) and kind_of(v) == OF_LANE]
    if carried or length in lower.lengths or not rows or len(rows) < len(given):
        return None
    if _moving(body.jaxpr, [False] * count + [True] * len(rows)) is None:
        return None
    if not all(map(_is_short, body.jaxpr.outvars)):
        return None
    lower.write_queued(before=True)
    made = lower.known((body.jaxpr, *consts), lambda: _Map(lower, eqn, consts, rows))
    made.read(rows)
    into = [lower.local(shape_of(v), type_of(dtype_of(v)), OF_LANE) for v in eqn.outvars]
    slots = [Tangent(m.storage.kind, READ, {}, at) for m in into for at in _places(m)]
    hand_on = list(map(lower.into, slots))
    ColumnLoop(lower.memory, made.graph, made.factors).write(hand_on, constant(I64, length))
    return list(into)


def sliced(
    lower: Lowering, array: Elements, starts: Sequence[ir.Value], sizes: Sequence[int]
) -> Elements:
    """Return a slice of tangents from places that are known when it runs."""
    found = []
    for place in np.ndindex(*sizes):
        there = _there(lower, np.ndindex(array.shape), place, starts)
        found.append(_sum(lower, [(flag, array[to]) for to, flag in there]))
    return array_of(found, sizes)


def updated(
    lower: Lowering, array: Elements, starts: Sequence[ir.Value], update: Elements
) -> Elements:
    """Return tangents with a slice of them replaced, from places known when it runs."""
    found = []
    for to in np.ndindex(array.shape):
        new, kept = [], constant(BOOL, 1)
        for place in np.ndindex(update.shape):
            for _, flag in _there(lower, [to], place, starts):
                new.append((flag, update[place]))
                kept = lower.b.and_(kept, lower.b.not_(flag))
        found.append(_sum(lower, [*new, (kept, array[to])]))
    return array_of(found, array.shape)


def _there(
    lower: Lowering,
    array: Iterable[tuple[int, ...]],
    place: tuple[int, ...],
    starts: Sequence[ir.Value],
) -> Iterator[tuple[tuple[int, ...], ir.Value]]:
    """Yield the places of an array that one of a slice may be, and whether it is."""
    for to in array:
        flag = constant(BOOL, 1)
        for i, j, start in zip(to, place, starts, strict=True):
            is_here = lower.b.icmp_signed("==", start, constant(I64, i - j))
            flag = lower.b.and_(flag, is_here)
        yield to, flag


def _sum(lower: Lowering, terms: Sequence[tuple[ir.Value, Element]]) -> Element:
    """Return the sum of the elements whose flags are true."""
    kind = next(base(e.type) if isinstance(e, ir.Value) else e.kind for _, e in terms)
    zero = constant(kind, 0.0)
    chosen = [apply(lower.e, "select_n", {}, flag, zero, element) for flag, element in terms]
    return reduce(lambda x, y: apply(lower.e, "add", {}, x, y), chosen)
