"""Loops and conditions: loops stay loops, a condition that all lanes share is a branch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from itertools import compress
from math import prod
from operator import or_
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn
from llvmlite import ir

from lanes.dependence import dependent, dependent_in_scan, dependent_in_while, parts_of_scan
from lanes.emitter import I64, constant, is_bool, type_of
from lanes.linear import push_rows
from lanes.lowering import (
    CONTROL,
    MAX_CARRIED_IN_REGISTERS,
    Lowering,
    dtype_of,
    read_only,
    shape_of,
)
from lanes.values import (
    OF_COLUMN,
    OF_LANE,
    Elements,
    Memory,
    Tangent,
    UnsupportedError,
    Value,
    array_of,
    is_vector,
    kind_of,
    parts_of,
)

Bound = Mapping[Any, Memory]


class _Carry:
    """Values that a loop carries: LLVM values, and arrays that it changes in memory."""

    def __init__(
        self,
        lower: Lowering,
        values: Sequence[Value],
        kinds: Sequence[int],
        read: Sequence[Value] = (),
    ) -> None:
        """Lay values out, each of its kind.

        Values that the loop also reads as they were before it, ``read``, are carried as copies.
        """
        self.lower, self.kinds = lower, list(kinds)
        self._taken = {id(v.storage.pointer) for v in read if isinstance(v, Memory)}
        laid = [self._laid(*each) for each in zip(values, self.kinds, strict=True)]
        self.values = [
            array_of(
                [lower.slot(e.kind) if isinstance(e, Tangent) else e for e in v.ravel()], v.shape
            )
            if isinstance(v, np.ndarray)
            else v
            for v in laid
        ]
        self._move(laid)

    def _move(self, given: Sequence[Value]) -> None:
        """Compute tangents into where they are carried."""
        outs = []
        for value, new in zip(self.values, given, strict=True):
            if isinstance(value, np.ndarray):
                assert isinstance(new, np.ndarray)
                for slot, element in zip(value.ravel(), new.ravel(), strict=True):
                    if isinstance(slot, Tangent) and slot is not element:
                        outs.append((element, self.lower.into(slot)))
        self.lower.flush(outs)

    def _laid(self, value: Value, kind: int) -> Elements | Memory:
        if isinstance(value, Memory) and value.storage.writable:
            alike = not kind & ~kind_of(value) and value.version == value.storage.version
            if alike and id(value.storage.pointer) not in self._taken:
                self._taken.add(id(value.storage.pointer))
                return value
        if prod(value.shape) > MAX_CARRIED_IN_REGISTERS:
            return self.lower.copied_to_memory(value, kind)
        return self.lower.in_registers(value, kind)

    def parts(self, values: Sequence[Value]) -> list[ir.Value]:
        """Return the LLVM values among carried values; arrays in memory have none."""
        return [x for v in values if isinstance(v, np.ndarray) for x in parts_of(v.ravel())]

    def with_llvm_values(self, parts: Sequence[ir.Value]) -> list[Value]:
        """Return the carried values with other LLVM values, in the order of `parts`.

        Tangents lie in memory.
        """
        left = iter(parts)
        return [
            Memory(value.storage, value.shape, value.storage.version)
            if isinstance(value, Memory)
            else array_of(
                [e if isinstance(e, Tangent) else next(left) for e in value.ravel()], value.shape
            )
            for value in self.values
        ]

    def next_turn(self, outs: Sequence[Value]) -> list[Value]:
        """Return the outputs of one turn as the inputs of the next."""
        following: list[Value] = []
        for value, out, kind in zip(self.values, outs, self.kinds, strict=True):
            if isinstance(value, Memory):
                if not isinstance(out, Memory) or out.storage is not value.storage:
                    self.lower.store_rows(value, None, self.lower.elements(out))
                    value.storage.version += 1
                following.append(value)
            else:
                following.append(self.lower.in_registers(out, kind))
        self._move(following)
        return following

    def loop(
        self,
        goes_on: Callable[[list[Value]], ir.Value],
        turn: Callable[[list[Value]], Sequence[Value]],
    ) -> list[Value]:
        """Write a loop; return the carried values after it."""
        slots = (e for v in self.values if isinstance(v, np.ndarray) for e in v.ravel())
        self.lower.carried.append({e.operands[0] for e in slots if isinstance(e, Tangent)})
        nodes = self.lower.e.loop(
            self.parts(self.values),
            lambda nodes: goes_on(self.with_llvm_values(nodes)),
            lambda nodes: self.parts(turn(self.with_llvm_values(nodes))),
        )
        self.lower.carried.pop()
        return self.with_llvm_values(nodes)


def _row(lower: Lowering, value: Value, number: ir.Value) -> Value:
    places = np.ndindex(value.shape[1:])
    found = [lower.at(value, [number, *(constant(I64, i) for i in place)]) for place in places]
    return array_of(found, value.shape[1:])


def _laid_before(lower: Lowering, value: Value, *, indexed: bool) -> Value:
    """Return an operand of a loop, in memory if it is long or read by row; for reading only."""
    if (
        isinstance(value, np.ndarray)
        and value.size
        and (value.size > MAX_CARRIED_IN_REGISTERS or indexed)
    ):
        value = lower.readable(value)
    return read_only(value)


def _scan(lower: Lowering, eqn: JaxprEqn, operands: list[Value], bound: Bound) -> list[Value]:
    if (pushed := push_rows(lower, eqn, operands)) is not None:
        return pushed
    p, b = eqn.params, lower.b
    (consts, carried), length, body = parts_of_scan(eqn), p["length"], p["jaxpr"]
    once = length == 1
    if not once:
        operands = lower.with_tangents_in_memory(operands, consts)
        lower.write_queued(before=True)
    fixed = [_laid_before(lower, v, indexed=False) for v in operands[:consts]]
    rows = [_laid_before(lower, v, indexed=not once) for v in operands[consts + carried :]]
    given = [*fixed, *operands[consts : consts + carried], *rows]
    kinds = dependent_in_scan(eqn, [*map(kind_of, given)])
    into = [
        bound[var] if var in bound else lower.local(shape_of(var), type_of(dtype_of(var)), kind)
        for var, kind in zip(eqn.outvars[carried:], kinds[carried:], strict=True)
    ]

    # short rows are collected, and several of them laid at once
    collected = (
        into
        if once or p["reverse"]
        else [lower.memory.rows_of(memory) or memory for memory in into]
    )
    together = sorted({few.shape[0] for few in collected if few not in into})

    def lay(end: ir.Value, rows: int, count: ir.Value) -> None:
        for memory, few in zip(into, collected, strict=True):
            if few is not memory and few.shape[0] == rows:
                lower.memory.lay_rows(memory, few, b.sub(end, count), count, lower.columns)

    def turn(number: ir.Value, carry: Sequence[Value]) -> list[Value]:
        place = number
        if p["reverse"]:
            place = b.sub(b.sub(lower.size(length), constant(I64, 1)), number)
        now = [_row(lower, v, place) for v in rows]
        outs = lower.run(body.jaxpr, body.consts, [*fixed, *carry, *now])
        whole = [few is memory for memory, few in zip(into, collected, strict=True)]
        with lower.keeping_alive(outs):
            single = (
                lower.with_tangents_in_memory(list(compress(outs[carried:], whole)))
                if any(whole)
                else []
            )
            for memory, out in zip(compress(into, whole), single, strict=True):
                lower.store_rows(memory, place, out)
        for few, out in zip(collected, outs[carried:], strict=True):
            if few not in into:
                lower.store_rows(few, b.urem(number, constant(I64, few.shape[0])), out)
        return outs[:carried]

    def lay_full(number: ir.Value) -> None:
        after = b.add(number, constant(I64, 1))
        for count in together:
            rest = b.urem(after, constant(I64, count))
            with b.if_then(b.icmp_signed("==", rest, constant(I64, 0))):
                lay(after, count, constant(I64, count))

    start = operands[consts : consts + carried]
    if once:
        ends = turn(constant(I64, 0), start)
        with lower.keeping_alive(ends):
            lower.write_queued()
        return [*ends, *into]
    first, size = array_of([constant(I64, 0)], ()), lower.size(length)
    carry = _Carry(lower, [first, *start], [0, *kinds[:carried]], [*fixed, *rows])

    def again(inside: list[Value]) -> list[Value]:
        number = lower.elements(inside[0])[()]
        outs = turn(number, inside[1:])
        following = carry.next_turn([array_of([b.add(number, constant(I64, 1))], ()), *outs])
        lay_full(number)
        return following

    _, *end = carry.loop(
        lambda inside: b.icmp_signed("<", lower.elements(inside[0])[()], size), again
    )
    for count in together:
        lay(size, count, b.urem(size, constant(I64, count)))
    return [*end, *into]


def _while(lower: Lowering, eqn: JaxprEqn, operands: list[Value], _: Bound) -> list[Value]:
    p = eqn.params
    conds, consts = p["cond_nconsts"], p["body_nconsts"]
    operands = lower.with_tangents_in_memory(operands, conds + consts)
    lower.write_queued(before=True)
    operands = [
        *(_laid_before(lower, v, indexed=False) for v in operands[: conds + consts]),
        *operands[conds + consts :],
    ]
    of_cond, of_body = operands[:conds], operands[conds : conds + consts]
    kinds = dependent_in_while(p, [*map(kind_of, operands)])
    carry = _Carry(lower, operands[conds + consts :], kinds, operands[: conds + consts])
    going: list[Value] = []

    def goes_on(inside: list[Value]) -> ir.Value:
        going[:] = lower.run(p["cond_jaxpr"].jaxpr, p["cond_jaxpr"].consts, [*of_cond, *inside])
        flag = lower.elements(going[0])[()]
        if any(isinstance(value, Memory) for value in inside) and is_vector(flag):
            what = "a loop that each lane ends for itself and that carries an array"
            raise UnsupportedError(what)
        return lower.e.any_lane(flag)

    def turn(inside: list[Value]) -> list[Value]:
        outs = lower.run(p["body_jaxpr"].jaxpr, p["body_jaxpr"].consts, [*of_body, *inside])
        if not kind_of(going[0]):
            return carry.next_turn(outs)
        # lanes that have ended stay as they are
        return carry.next_turn(
            [
                lower.elementwise("select_n", {}, [going[0], old, new], new.shape)
                for old, new in zip(inside, outs, strict=True)
            ]
        )

    return carry.loop(goes_on, turn)


def _cond(lower: Lowering, eqn: JaxprEqn, operands: list[Value], _: Bound) -> list[Value]:
    branches = eqn.params["branches"]
    which = lower.elements(operands[0])[()]
    rest = operands[1:]
    if lower.chooses and any(kind_of(v) & OF_COLUMN for v in rest):
        found = [lower.run(branch.jaxpr, branch.consts, rest) for branch in branches]
        flags = [_is_number(lower, which, n, len(branches)) for n in range(1, len(branches))]
        return [
            reduce(partial(_chosen, lower), zip(flags, others, strict=True), first)
            for first, *others in zip(*found, strict=True)
        ]
    if is_vector(which) or not isinstance(which, ir.Constant):
        rest = lower.with_tangents_in_memory(rest)
    if is_vector(which):  # a change in place by one lane would be a change for all
        rest = [_laid_before(lower, v, indexed=False) for v in rest]
    kinds = [OF_LANE * is_vector(which)] * len(eqn.outvars)
    for branch in branches:
        kinds = list(map(or_, kinds, dependent(branch.jaxpr, [*map(kind_of, rest)])))

    def result_of(branch: Any) -> list[Value]:
        outs = lower.run(branch.jaxpr, branch.consts, rest)
        return [
            out
            if isinstance(out, Memory) and out.storage.writable
            else lower.in_registers(out, kind)
            for out, kind in zip(outs, kinds, strict=True)
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


def _chosen(lower: Lowering, old: Value, instead: tuple[ir.Value, Value]) -> Value:
    flag, new = instead
    return lower.elementwise("select_n", {}, [array_of([flag], ()), old, new], old.shape)


def _branched(
    lower: Lowering,
    flag: ir.Value,
    yes: Callable[[], list[Value]],
    no: Callable[[], list[Value]],
) -> list[Value]:
    """Compute one of two lists of values of the same kinds, by a branch."""
    b = lower.b
    lower.write_queued(before=True)
    before = [storage.version for storage in lower.storages]
    ends: list[_End] = []
    begins = [b.append_basic_block(name) for name in ("yes", "no")]
    b.cbranch(flag, *begins)
    for begin, compute in zip(begins, (yes, no), strict=True):
        for storage, version in zip(lower.storages, before, strict=False):
            storage.version = version
        b.position_at_end(begin)
        found = compute()
        with lower.keeping_alive(found):
            lower.write_queued()
        ends.append(_End(found, b.block, [s.version for s in lower.storages]))
    stays = [
        isinstance(x, Memory) and isinstance(y, Memory) and x.storage is y.storage
        for x, y in zip(ends[0].values, ends[1].values, strict=True)
    ]
    for end in ends:
        for storage, version in zip(lower.storages, end.versions, strict=False):
            storage.version = version
        b.position_at_end(end.block)
        end.values = [
            value if stay else lower.elements(value)
            for value, stay in zip(end.values, stays, strict=True)
        ]
        end.block = b.block
    taken: set[int] = set()
    merged: list[Any] = [
        x if stay else _slots_after(lower, x, y, taken)
        for x, y, stay in zip(ends[0].values, ends[1].values, stays, strict=True)
    ]
    after = b.append_basic_block("after")
    for end in ends:
        b.position_at_end(end.block)
        outs = [
            (element, lower.into(to))
            for into, value, stay in zip(merged, end.values, stays, strict=True)
            if isinstance(value, np.ndarray) and not stay
            for to, element in zip(into.ravel(), value.ravel(), strict=True)
            if isinstance(to, Tangent) and to is not element
        ]
        lower.flush(outs)
        b.branch(after)
        end.block = b.block
    b.position_at_end(after)
    for storage, *versions in zip(lower.storages, ends[0].versions, ends[1].versions, strict=False):
        storage.version = max(versions)
    return [
        _merged(lower, first, second, ends, into)
        for first, second, into in zip(ends[0].values, ends[1].values, merged, strict=True)
    ]


def _slots_after(lower: Lowering, x: Any, y: Any, taken: set[int]) -> Elements:
    pairs = zip(x.ravel(), y.ravel(), strict=True)
    return array_of([_slot_after(lower, *pair, taken) for pair in pairs], x.shape)


def _slot_after(lower: Lowering, x: Any, y: Any, taken: set[int]) -> Any:
    """Return where a tangent of either branch lies; else nothing.

    A tangent that a loop carries is changed in place, if it is not read again.
    """
    if x is y or not isinstance(x, Tangent):
        return x if x is y else None
    for slot in (x, y):
        storage = slot.operands[0]
        if (
            slot.is_read
            and lower.carried
            and storage in lower.carried[-1]
            and id(storage) not in taken
            and not lower.is_read_again(slot)
        ):
            taken.add(id(storage))
            return slot
    return lower.slot(x.kind)


@dataclass
class _End:
    """Results of a branch, the block in which it ends, and the versions of memory there."""

    values: list[Value]
    block: ir.Block
    versions: list[int]


def _merged(lower: Lowering, first: Value, second: Value, ends: Sequence[_End], into: Any) -> Value:
    """Return the value of one branch or the other, where both have ended."""
    if isinstance(first, Memory):
        return Memory(first.storage, first.shape, first.storage.version)
    assert isinstance(first, np.ndarray)
    assert isinstance(second, np.ndarray)
    nodes = []
    for x, y, known in zip(first.ravel(), second.ravel(), into.ravel(), strict=True):
        if known is not None:
            nodes.append(known)
            continue
        node = lower.b.phi(x.type)
        for value, end in zip((x, y), ends, strict=True):
            node.add_incoming(value, end.block)
        nodes.append(node)
    return array_of(nodes, first.shape)


def _selected(
    lower: Lowering,
    which: ir.Value,
    branches: Sequence[Any],
    result_of: Callable[[Any], list[Value]],
) -> list[Value]:
    """Compute the first branch, each other one where a lane asks for it, and select."""
    chosen = lower.with_tangents_in_memory(result_of(branches[0]))
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


CONTROL.update({"scan": _scan, "while": _while, "cond": _cond})
