"""Loops and conditions: loops stay loops, a condition that all lanes share is a branch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import prod
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn
from llvmlite import ir

from lanes.dependence import dependent, dependent_in_scan, dependent_in_while
from lanes.lowering import CONTROL, I64, SPILLED, Lowering, dtype_of, shape_of
from lanes.rules import constant, is_bool, type_of
from lanes.values import (
    Deferred,
    Element,
    Memory,
    UnsupportedError,
    Value,
    array_of,
    is_vector,
)

Bound = Mapping[Any, Memory]


def _parts(value: Value) -> list[ir.Value]:
    """Return the LLVM values that an array in registers consists of."""
    assert isinstance(value, np.ndarray)
    return [x for e in value.ravel() for x in (e if isinstance(e, tuple) else (e,))]


def _is_lanes(value: Value) -> bool:
    if isinstance(value, Memory):
        return value.storage.lane_stride is not None
    if isinstance(value, Deferred):
        return any(map(_is_lanes, value.sources))
    return any(map(is_vector, _parts(value)))


def _is_tangent(value: Value) -> bool:
    if isinstance(value, Memory):
        return value.storage.column_stride is not None
    if isinstance(value, Deferred):
        return any(map(_is_tangent, value.sources))
    return any(isinstance(e, tuple) for e in value.ravel())


def _flags(found: Sequence[int]) -> list[bool]:
    return list(map(bool, found))


def _rebuilt(value: Value, parts: Sequence[ir.Value]) -> Value:
    """Return an array in registers with other LLVM values, in the order of `_parts`."""
    assert isinstance(value, np.ndarray)
    left, elements = iter(parts), []
    for e in value.ravel():
        new: Element = tuple(next(left) for _ in e) if isinstance(e, tuple) else next(left)
        elements.append(new)
    return array_of(elements, value.shape)


class _Carry:
    """Values that a loop carries, as the φ-nodes of its head."""

    def __init__(
        self,
        lower: Lowering,
        values: Sequence[Value],
        kinds: Sequence[tuple[bool, bool]],
        read: Sequence[Value] = (),
    ) -> None:
        """Lay values out, each of every lane or not and with columns or not.

        What the loop also reads as it was before, ``read``, is carried as a copy.
        """
        self.lower, self.kinds = lower, list(kinds)
        self._taken = {id(v.storage.pointer) for v in read if isinstance(v, Memory)}
        self.values = [
            self._laid(value, lane=lane, column=column)
            for value, (lane, column) in zip(values, self.kinds, strict=True)
        ]
        self.nodes: list[list[ir.PhiInstr]] = []

    def _laid(self, value: Value, *, lane: bool, column: bool) -> Value:
        lower = self.lower
        if isinstance(value, Memory) and value.storage.writable:
            same = _is_lanes(value) or not lane, _is_tangent(value) or not column
            if all(same) and id(value.storage.pointer) not in self._taken:
                self._taken.add(id(value.storage.pointer))
                return value
        if prod(value.shape) > SPILLED:
            return lower.spilled(value, lane=lane, column=column)
        return self._promoted(value, lane=lane, column=column)

    def _promoted(self, given: Value, *, lane: bool, column: bool) -> Value:
        elements = self.lower.elements(given)
        promoted = [self.lower.promoted(e, lane=lane, column=column) for e in elements.ravel()]
        return array_of(promoted, elements.shape)

    def enter(self, before: ir.Block) -> list[Value]:
        """Write the φ-nodes; return what the body is given."""
        b = self.lower.b
        inside: list[Value] = []
        for value in self.values:
            if isinstance(value, Memory):
                self.nodes.append([])
                inside.append(value)
                continue
            nodes = []
            for part in _parts(value):
                node = b.phi(part.type)
                node.add_incoming(part, before)
                nodes.append(node)
            self.nodes.append(nodes)
            inside.append(_rebuilt(value, nodes))
        return inside

    def again(self, outs: Sequence[Value]) -> list[Value]:
        """Return what the body gives as what it is given, before the jump back is written."""
        following: list[Value] = []
        for value, out, (lane, column) in zip(self.values, outs, self.kinds, strict=True):
            if isinstance(value, Memory):
                if not isinstance(out, Memory) or out.storage is not value.storage:
                    self.lower.store_rows(value, None, self.lower.elements(out))
                    value.storage.version += 1
                following.append(value)
            else:
                following.append(self._promoted(out, lane=lane, column=column))
        return following

    def close(self, following: Sequence[Value], end: ir.Block) -> list[Value]:
        """Complete the φ-nodes; return the carried values after the loop."""
        results: list[Value] = []
        for value, nodes, out in zip(self.values, self.nodes, following, strict=True):
            if isinstance(value, Memory):
                results.append(Memory(value.storage, value.shape, value.storage.version))
                continue
            for node, part in zip(nodes, _parts(out), strict=True):
                node.add_incoming(part, end)
            results.append(_rebuilt(value, nodes))
        return results


def _row(lower: Lowering, value: Value, number: ir.Value) -> Value:
    places = np.ndindex(value.shape[1:])
    found = [lower.at(value, [number, *(constant(I64, i) for i in place)]) for place in places]
    return array_of(found, value.shape[1:])


def _laid_before(lower: Lowering, value: Value, *, indexed: bool) -> Value:
    """Return what a loop reads, in memory where it is long or read row by row; for reading only."""
    if isinstance(value, np.ndarray) and value.size and (value.size > SPILLED or indexed):
        value = lower.readable(value)
    if isinstance(value, Memory) and value.storage.writable:
        if value.version != value.storage.version:
            raise UnsupportedError("an array that is read after it was changed in place")
        return Memory(replace(value.storage, writable=False), value.shape, value.version)
    return value


def _scan(lower: Lowering, eqn: JaxprEqn, operands: list[Value], bound: Bound) -> list[Value]:
    p, b = eqn.params, lower.b
    consts, carried, length = p["num_consts"], p["num_carry"], p["length"]
    body = p["jaxpr"]
    once = length == 1
    fixed = [_laid_before(lower, v, indexed=False) for v in operands[:consts]]
    rows = [_laid_before(lower, v, indexed=not once) for v in operands[consts + carried :]]
    given = [*fixed, *operands[consts : consts + carried], *rows]
    lanes = _flags(dependent_in_scan(p, [_is_lanes(v) for v in given]))
    columns = _flags(dependent_in_scan(p, [_is_tangent(v) for v in given]))
    into = [
        bound[var]
        if var in bound
        else lower.local(shape_of(var), type_of(dtype_of(var)), lane=lane, column=column)
        for var, lane, column in zip(
            eqn.outvars[carried:], lanes[carried:], columns[carried:], strict=True
        )
    ]

    # short rows are collected, and several of them laid at once
    collected = (
        into if once or p["reverse"] else [lower.rows_of(memory) or memory for memory in into]
    )
    together = sorted({few.shape[0] for few in collected if few not in into})

    def lay(end: ir.Value, rows: int, count: ir.Value) -> None:
        for memory, few in zip(into, collected, strict=True):
            if few is not memory and few.shape[0] == rows:
                lower.lay_rows(memory, few, b.sub(end, count), count)

    def turn(number: ir.Value, carry: Sequence[Value]) -> list[Value]:
        place = number
        if p["reverse"]:
            place = b.sub(b.sub(lower.size(length), constant(I64, 1)), number)
        now = [_row(lower, v, place) for v in rows]
        outs = lower.run(body.jaxpr, body.consts, [*fixed, *carry, *now])
        for memory, few, out in zip(into, collected, outs[carried:], strict=True):
            at = place if few is memory else b.urem(number, constant(I64, few.shape[0]))
            lower.store_rows(few, at, out)
        after = b.add(number, constant(I64, 1))
        for count in together:
            rest = b.urem(after, constant(I64, count))
            with b.if_then(b.icmp_signed("==", rest, constant(I64, 0))):
                lay(after, count, constant(I64, count))
        return outs[:carried]

    start = operands[consts : consts + carried]
    if once:
        return [*turn(constant(I64, 0), start), *into]
    kinds = list(zip(lanes[:carried], columns[:carried], strict=True))
    carry = _Carry(lower, start, kinds, [*fixed, *rows])
    size = lower.size(length)
    end = _counted(lower, size, carry, turn)
    for count in together:
        lay(size, count, b.urem(size, constant(I64, count)))
    return [*end, *into]


def _counted(
    lower: Lowering,
    length: ir.Value,
    carry: _Carry,
    turn: Callable[[ir.Value, Sequence[Value]], Sequence[Value]],
) -> list[Value]:
    """Write a loop of so many turns."""
    b = lower.b
    before, head = b.block, b.function.append_basic_block("loop")
    body, after = (b.function.append_basic_block(name) for name in ("turn", "after"))
    b.branch(head)
    b.position_at_end(head)
    number = b.phi(I64)
    number.add_incoming(constant(I64, 0), before)
    inside = carry.enter(before)
    b.cbranch(b.icmp_signed("<", number, length), body, after)
    b.position_at_end(body)
    following = carry.again(turn(number, inside))
    number.add_incoming(b.add(number, constant(I64, 1)), b.block)
    results = carry.close(following, b.block)
    b.branch(head)
    b.position_at_end(after)
    return results


def _while(lower: Lowering, eqn: JaxprEqn, operands: list[Value], _: Bound) -> list[Value]:
    p, b = eqn.params, lower.b
    conds, consts = p["cond_nconsts"], p["body_nconsts"]
    operands = [
        *(_laid_before(lower, v, indexed=False) for v in operands[: conds + consts]),
        *operands[conds + consts :],
    ]
    of_cond, of_body = operands[:conds], operands[conds : conds + consts]
    lanes = _flags(dependent_in_while(p, [_is_lanes(v) for v in operands]))
    columns = _flags(dependent_in_while(p, [_is_tangent(v) for v in operands]))
    kinds = list(zip(lanes, columns, strict=True))
    carry = _Carry(lower, operands[conds + consts :], kinds, operands[: conds + consts])
    before, head = b.block, b.function.append_basic_block("while")
    body, after = (b.function.append_basic_block(name) for name in ("turn", "after"))
    b.branch(head)
    b.position_at_end(head)
    inside = carry.enter(before)
    goes_on = lower.run(p["cond_jaxpr"].jaxpr, p["cond_jaxpr"].consts, [*of_cond, *inside])
    flag = lower.elements(goes_on[0])[()]
    if any(isinstance(value, Memory) for value in inside) and is_vector(flag):
        raise UnsupportedError("a loop that each lane ends for itself and that carries an array")
    b.cbranch(lower.e.any_lane(flag), body, after)
    b.position_at_end(body)
    outs = lower.run(p["body_jaxpr"].jaxpr, p["body_jaxpr"].consts, [*of_body, *inside])
    following = carry.again(outs)
    if is_vector(flag):  # lanes that have ended stay as they are
        following = [
            lower.elementwise("select_n", {}, [goes_on[0], old, new], new.shape)
            for old, new in zip(inside, following, strict=True)
        ]
        following = carry.again(following)
    results = carry.close(following, b.block)
    b.branch(head)
    b.position_at_end(after)
    return results


def _cond(lower: Lowering, eqn: JaxprEqn, operands: list[Value], _: Bound) -> list[Value]:
    branches = eqn.params["branches"]
    which = lower.elements(operands[0])[()]
    rest = operands[1:]
    if is_vector(which):  # what one lane changes in place would change for all
        rest = [_laid_before(lower, v, indexed=False) for v in rest]
    lanes = [False] * len(eqn.outvars)
    columns = [False] * len(eqn.outvars)
    for branch in branches:
        by_lane = _flags(dependent(branch.jaxpr, [_is_lanes(v) for v in rest]))
        by_column = _flags(dependent(branch.jaxpr, [_is_tangent(v) for v in rest]))
        lanes = [a or b for a, b in zip(lanes, by_lane, strict=True)]
        columns = [a or b for a, b in zip(columns, by_column, strict=True)]
    lanes = [lane or is_vector(which) for lane in lanes]
    kinds = list(zip(lanes, columns, strict=True))

    def result_of(branch: Any) -> list[Value]:
        outs = lower.run(branch.jaxpr, branch.consts, rest)
        return [
            _uniform(lower, out, lane=k[0], column=k[1]) for out, k in zip(outs, kinds, strict=True)
        ]

    if isinstance(which, ir.Constant) and not is_vector(which):
        return result_of(branches[min(max(int(which.constant), 0), len(branches) - 1)])
    if is_vector(which):
        return _selected(lower, which, branches, result_of)
    flags = [_is_number(lower, which, n, len(branches)) for n in range(len(branches) - 1)]

    def chosen_from(number: int) -> list[Value]:
        if number == len(flags):
            return result_of(branches[number])
        return _branched(
            lower,
            flags[number],
            lambda: result_of(branches[number]),
            lambda: chosen_from(number + 1),
        )

    return chosen_from(0)


def _branched(
    lower: Lowering,
    flag: ir.Value,
    yes: Callable[[], list[Value]],
    no: Callable[[], list[Value]],
) -> list[Value]:
    """Compute one of two lists of values of the same kinds, by a branch."""
    b = lower.b
    blocks = [b.function.append_basic_block(name) for name in ("yes", "no", "end")]
    b.cbranch(flag, *blocks[:2])
    before = [storage.version for storage in lower.storages]
    ends: list[_End] = []
    for block, compute in zip(blocks[:2], (yes, no), strict=True):
        for storage, version in zip(lower.storages, before, strict=False):
            storage.version = version
        b.position_at_end(block)
        found = compute()
        ends.append(_End(found, b.block, [storage.version for storage in lower.storages]))
    stays = [
        isinstance(x, Memory) and isinstance(y, Memory) and x.storage is y.storage
        for x, y in zip(ends[0].values, ends[1].values, strict=True)
    ]
    for end in ends:
        b.position_at_end(end.block)
        for storage, version in zip(lower.storages, end.versions, strict=False):
            storage.version = version
        for number, (value, stay) in enumerate(zip(end.values, stays, strict=True)):
            if not stay:
                end.values[number] = lower.elements(value)
        b.branch(blocks[2])
    for storage, *versions in zip(lower.storages, ends[0].versions, ends[1].versions, strict=False):
        storage.version = max(versions)
    b.position_at_end(blocks[2])
    return [
        _merged(lower, first, second, ends)
        for first, second in zip(ends[0].values, ends[1].values, strict=True)
    ]


@dataclass
class _End:
    """What a branch comes to, the block in which it ends, and how often memory was written to."""

    values: list[Value]
    block: ir.Block
    versions: list[int]


def _merged(lower: Lowering, first: Value, second: Value, ends: Sequence[_End]) -> Value:
    """Return the value of one branch or the other, where both have ended."""
    if isinstance(first, Memory):
        return Memory(first.storage, first.shape, first.storage.version)
    nodes = []
    for x, y in zip(_parts(first), _parts(second), strict=True):
        if x is y:
            nodes.append(x)
            continue
        node = lower.b.phi(x.type)
        for value, end in zip((x, y), ends, strict=True):
            node.add_incoming(value, end.block)
        nodes.append(node)
    return _rebuilt(first, nodes)


def _selected(
    lower: Lowering,
    which: ir.Value,
    branches: Sequence[Any],
    result_of: Callable[[Any], list[Value]],
) -> list[Value]:
    """Compute the first branch, each other one where a lane asks for it, and select."""
    chosen = result_of(branches[0])
    for number, branch in enumerate(branches[1:], start=1):
        flag = _is_number(lower, which, number, len(branches))

        def instead(branch: Any = branch, flag: ir.Value = flag, old: Any = chosen) -> list[Value]:
            new = result_of(branch)
            flags = array_of([flag], ())
            return [
                lower.elementwise("select_n", {}, [flags, o, n], o.shape)
                for o, n in zip(old, new, strict=True)
            ]

        chosen = _branched(lower, lower.e.any_lane(flag), instead, partial(list, chosen))
    return chosen


def _is_number(lower: Lowering, which: ir.Value, number: int, count: int) -> ir.Value:
    """Return whether an index, limited to so many branches, is a number."""
    if is_bool(which):
        return which if number else lower.b.not_(which)
    bound = lower.e.number(which, number)
    if number == 0:
        return lower.b.icmp_signed("<=", which, bound)
    return lower.b.icmp_signed(">=" if number == count - 1 else "==", which, bound)


def _uniform(lower: Lowering, value: Value, *, lane: bool, column: bool) -> Value:
    if isinstance(value, Memory) and value.storage.writable:
        return value
    elements = lower.elements(value)
    return array_of(
        [lower.promoted(e, lane=lane, column=column) for e in elements.ravel()], elements.shape
    )


CONTROL.update({"scan": _scan, "while": _while, "cond": _cond})
