"""A jaxpr written as instructions.

`lanes.rules` has the elementwise primitives, `lanes.structural` those that move elements,
`lanes.control` loops and conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import product
from math import prod
from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from llvmlite import ir

from lanes.columns import ColumnLoop, factors_of
from lanes.dependence import CALLS, called
from lanes.emitter import BOOL, I64, Emitter, constant, converted, type_of
from lanes.memory_access import MAX_COLUMNS, MemoryAccess
from lanes.rules import ELEMENTWISE, SIGNLESS, apply
from lanes.tangents import Graph
from lanes.values import (
    OF_COLUMN,
    OF_LANE,
    READ,
    Deferred,
    Element,
    Elements,
    Index,
    Memory,
    Storage,
    Tangent,
    UnsupportedError,
    Value,
    array_of,
    base,
    is_vector,
    kind_of,
)

Made = TypeVar("Made")
MAX_IN_REGISTERS = 512
"""Elements up to which an array may lie in registers."""
MAX_CARRIED_IN_REGISTERS = 24
"""Elements above which an array that enters a loop is laid in memory."""


class Lowering:
    """Writes one function; holds the state that all primitives share.

    Parameters
    ----------
    emitter
        Writes instructions.
    columns
        How many columns of tangents a block of lanes takes, an argument of the function.
    lengths
        Stand-in of a length -> the length, an argument of the function.
    allocate
        Returns memory on the stack for so many numbers of every lane.
    """

    def __init__(
        self,
        emitter: Emitter,
        columns: ir.Value,
        lengths: Mapping[int, ir.Value],
        allocate: Callable[[ir.Type, int], ir.Value],
    ) -> None:
        self.e, self.columns, self.lengths = emitter, columns, lengths
        self.memory = MemoryAccess(emitter, allocate)
        self._alive: list[dict[Any, Value]] = []
        """Values that are read later, by each jaxpr under way."""
        self.carried: list[set[Storage]] = []
        """Where the loops that are under way carry tangents."""
        self._queue: list[tuple[Element, Tangent]] = []
        """Tangents to be written, with the place of each, by the next loop over columns."""
        self._pending: dict[int, list[Tangent]] = {}
        """Reads of memory that may change before they are computed."""
        self.storages: list[Storage] = []
        """All that is written to."""
        self.chooses = False
        """Whether choices between tangents are sums, and not branches."""
        self._known: list[dict[tuple[int, ...], tuple[Any, Any]]] = []
        """What each jaxpr under way keeps, with what it is made of, by the latter's identities."""

    @property
    def b(self) -> ir.IRBuilder:
        """Where instructions are written."""
        return self.e.b

    # jaxprs

    def run(
        self,
        jaxpr: Jaxpr,
        consts: Sequence[Any],
        arguments: Sequence[Value],
        bound: Mapping[Any, Memory] | None = None,
    ) -> list[Value]:
        """Write a jaxpr; return its outputs.

        ``bound``: variable -> the memory in which a loop is to lay its rows for it.
        """
        bound = bound or {}
        values: dict[Any, Value] = dict(
            zip(jaxpr.constvars, map(self.literal, consts), strict=True)
        )
        values.update(zip(jaxpr.invars, arguments, strict=True))
        self._alive.append(values)
        self._known.append({})
        for eqn, last in zip(jaxpr.eqns, _last_reads(jaxpr), strict=True):
            operands = [self._read(values, var) for var in eqn.invars]
            for var in last:
                values.pop(var, None)
            outs = self._equation(eqn, operands, bound)
            values.update(zip(eqn.outvars, outs, strict=True))
        self._alive.pop()
        self._known.pop()
        return [self._read(values, var) for var in jaxpr.outvars]

    def known(self, of: Sequence[Any], make: Callable[[], Made]) -> Made:
        """Return what is written once for the same values, where it is known already."""
        parts = [x for v in of for x in (v.ravel() if isinstance(v, np.ndarray) else [v])]
        key = tuple(map(id, parts))
        for frame in self._known:
            if key in frame:
                found: Made = frame[key][1]
                return found
        made = make()
        self._known[-1][key] = parts, made
        return made

    def is_read_again(self, slot: Tangent) -> bool:
        """Return whether a number in memory, as it is now, is asked for later."""
        storage = slot.operands[0]
        return any(node.operands[0] is storage for node in self._held().values())

    def _held(self) -> dict[int, Tangent]:
        """Return the tangents that are read later, and their operands, by number."""
        left: list[Any] = [v for values in self._alive for v in values.values()]
        seen: dict[int, Tangent] = {}
        while left:
            value = left.pop()
            if isinstance(value, Deferred):
                left += value.sources
            elif isinstance(value, np.ndarray):
                left += [x for x in value.ravel() if isinstance(x, Tangent)]
            elif isinstance(value, Tangent) and value.number not in seen:
                seen[value.number] = value
                left += [x for x in value.operands if isinstance(x, Tangent)]
        return seen

    def _read(self, values: Mapping[Any, Value], var: Any) -> Value:
        if isinstance(var, Literal):
            return self.literal(np.asarray(var.val, dtype_of(var)))
        return values[var]

    def literal(self, number: Any) -> Value:
        """Return a constant; the stand-in of a length is that length."""
        if isinstance(number, np.ndarray) and number.dtype == object:
            return number
        if isinstance(number, Memory | Deferred):
            return number
        array = np.asarray(number)
        kind = type_of(array.dtype)
        if array.dtype == jax.dtypes.float0:
            array = np.zeros(array.shape, bool)
        if array.size > MAX_IN_REGISTERS:
            return self._laid_out(array, kind)
        return array_of([self._number(kind, x) for x in array.ravel().tolist()], array.shape)

    def _number(self, kind: ir.Type, number: Any) -> ir.Value:
        if isinstance(kind, ir.IntType) and kind != BOOL and number in self.lengths:
            return converted(self.e, self.lengths[number], kind)
        return constant(kind, number)

    def _laid_out(self, array: np.ndarray[Any, Any], kind: ir.Type) -> Memory:
        """Return a long constant as a part of the program."""
        if kind == BOOL:
            raise UnsupportedError("a long constant of truth values")
        laid = ir.ArrayType(kind, array.size)
        name = f"constant.{len(self.e.module.globals)}"
        variable = ir.GlobalVariable(self.e.module, laid, name)
        variable.initializer, variable.global_constant = (
            ir.Constant(laid, array.ravel().tolist()),
            True,
        )
        pointer = self.b.bitcast(variable, kind.as_pointer())
        return Memory(Storage(pointer, kind, self.row_major(array.shape), None, None), array.shape)

    def _equation(
        self, eqn: JaxprEqn, operands: list[Value], bound: Mapping[Any, Memory]
    ) -> list[Value]:
        name = eqn.primitive.name
        if name in CALLS:
            jaxpr, consts = called(eqn.params)
            inner = {
                into: bound[outer]
                for into, outer in zip(jaxpr.outvars, eqn.outvars, strict=True)
                if outer in bound and not isinstance(into, Literal)
            }
            return self.run(jaxpr, consts, operands, inner)
        if name not in SIGNLESS and any(map(_is_unsigned, (*eqn.invars, *eqn.outvars))):
            raise UnsupportedError(f"{name} of numbers without a sign")
        if name in CONTROL:
            return CONTROL[name](self, eqn, operands, bound)
        if name == "optimization_barrier":
            return operands
        if name in ELEMENTWISE:
            return [self.elementwise(name, eqn.params, operands, shape_of(eqn.outvars[0]))]
        if name in STRUCTURAL:
            out = STRUCTURAL[name](self, eqn, operands)
            return out if isinstance(out, list) else [out]
        raise UnsupportedError(f"primitive {name}")

    # elements

    def elementwise(
        self, name: str, params: Mapping[str, Any], operands: Sequence[Value], shape: Sequence[int]
    ) -> Value:
        """Apply a rule to arrays, whose elements are computed now or when they are read."""

        def of(*elements: Element) -> Element:
            return apply(self.e, name, params, *elements)

        if self.is_long(shape):
            arrays = [self.elements(o)[()] if not o.shape else o for o in operands]

            def read(array: Any, index: Index) -> Element:
                if not hasattr(array, "shape"):
                    return array
                zero = constant(I64, 0)
                own = [
                    zero if length == 1 else i for i, length in zip(index, array.shape, strict=True)
                ]
                return self.at(array, own)

            def at(index: Index) -> Element:
                return of(*(read(array, index) for array in arrays))

            return Deferred(tuple(shape), at, tuple(operands))
        shape = tuple(shape)
        given = [self.elements(o) for o in operands]
        spread = [o if o.shape == shape else np.broadcast_to(o, shape) for o in given]
        return array_of(list(map(of, *(o.ravel().tolist() for o in spread))), shape)

    def is_long(self, shape: Sequence[int]) -> bool:
        """Return whether an array of a shape does not lie in registers."""
        return prod(shape) > MAX_IN_REGISTERS

    def deferred(
        self, shape: Sequence[int], at: Callable[[Index], Element], sources: Sequence[Value]
    ) -> Value:
        """Return an array whose elements are computed where they are read; now, if it is short."""
        deferred = Deferred(tuple(shape), at, tuple(sources))
        return deferred if self.is_long(shape) else self.elements(deferred)

    def elements(self, value: Value) -> Elements:
        """Return an array in registers, read now."""
        if isinstance(value, np.ndarray):
            return value
        if self.is_long(value.shape):
            raise UnsupportedError(f"an array of shape {value.shape} as a whole")
        places = product(*map(range, value.shape))
        found = [self.at(value, [constant(I64, i) for i in place]) for place in places]
        return array_of(found, value.shape)

    def size(self, length: int) -> ir.Value:
        """Return a length, that of a stand-in if it is one."""
        return self.lengths.get(length) or constant(I64, length)

    def in_registers(self, value: Value, kind: int) -> Elements:
        """Return an array in registers, of every lane and of every column if it is to be."""

        def of(element: Element) -> Element:
            if isinstance(element, Tangent):
                return element
            wide = self.e.splat(element) if kind & OF_LANE else element
            return Tangent(base(wide.type), "copy", {}, (wide,)) if kind & OF_COLUMN else wide

        elements = self.elements(value)
        return array_of([of(e) for e in elements.ravel()], elements.shape)

    # tangents

    def flush(
        self,
        outs: Sequence[tuple[Element, Callable[[ir.Value], None]]],
        changed: Set[int] = frozenset(),
    ) -> None:
        """Compute tangents' numbers, column by column, and hand them on.

        Queued tangents are written in the same loop. Reads of memory that changes so, or is
        ``changed`` next, are copied before if they are needed later.
        """
        changed = changed | {id(to.operands[0]) for _, to in self._queue}
        held = self._held() if changed & self._pending.keys() else {}
        kept = []
        for storage in changed:
            for node in self._pending.pop(storage, []):
                if node.number in held:
                    slot = self.slot(node.kind)
                    kept.append((node, slot))
        outs = [*((node, self.into(slot)) for node, slot in kept), *outs]
        outs = [*((element, self.into(to)) for element, to in self._queue), *outs]
        self._queue = []
        if not outs:
            return
        graph = Graph([x for x, _ in outs])
        hand_on = [hand_on for _, hand_on in outs]
        ColumnLoop(self.memory, graph, factors_of(self.e, graph)).write(hand_on, self.columns)
        for node, slot in kept:
            node.operands = slot.operands

    def write_queued(self, *, before: bool = False) -> None:
        """Write queued tangents; before loops and branches, copy reads that they may change."""
        self.flush([], changed=set(self._pending) if before else set())

    @contextmanager
    def keeping_alive(self, values: Sequence[Value]) -> Iterator[None]:
        """Know that values are asked for later."""
        self._alive.append(dict(enumerate(values)))
        yield
        self._alive.pop()

    def slot(self, kind: ir.Type, *, flags_columns: bool = False) -> Tangent:
        """Return a tangent's number that lies in memory of its own; it tells where it moves."""
        storage = self.local((), kind, OF_LANE | OF_COLUMN).storage
        storage.writable = False
        if flags_columns:
            storage.moves = self.memory.allocate(ir.IntType(8), MAX_COLUMNS)
        return Tangent(kind, READ, {}, (storage,))

    def into(self, slot: Tangent) -> Callable[[ir.Value], None]:
        """Return a function that writes one column of a tangent into its memory."""
        storage, *index = slot.operands

        def write(value: ir.Value) -> None:
            self.memory.write(storage, index, value)
            if storage.moves is not None:
                differs = self.b.fcmp_unordered("!=", value, self.e.number(value, 0.0))
                moves = self.b.zext(self.e.any_lane(differs), ir.IntType(8))
                self.b.store(moves, self.b.gep(storage.moves, [self.memory.column]))

        return write

    def with_tangents_in_memory(self, values: Sequence[Value], fixed: int = 0) -> list[Value]:
        """Return arrays whose tangents lie in memory: those that do not are computed now.

        The first so many stay as they are while others change, and tell in which columns they move.
        """
        known: dict[int, Tangent] = {}
        outs = []

        def of(element: Element, *, flags_columns: bool) -> Element:
            if not isinstance(element, Tangent):
                return element
            has_flags = element.is_read and element.operands[0].moves is not None
            if element.is_read and not element.operands[0].writable and has_flags >= flags_columns:
                return element
            if element.number not in known:
                known[element.number] = self.slot(element.kind, flags_columns=flags_columns)
                outs.append((element, self.into(known[element.number])))
            return known[element.number]

        found = [
            array_of([of(e, flags_columns=place < fixed) for e in v.ravel()], v.shape)
            if isinstance(v, np.ndarray)
            else v
            for place, v in enumerate(values)
        ]
        self.flush(outs)
        return found

    # memory

    def row_major(self, shape: Sequence[int], unit: ir.Value | None = None) -> tuple[ir.Value, ...]:
        """Return the strides of an array whose last axis has a stride of ``unit``, or one."""
        return self.e.strides([self.size(length) for length in shape], unit)

    def at(self, array: Value, index: Index) -> Element:
        """Return one element of an array."""
        if isinstance(array, Deferred):
            return array.at(index)
        if isinstance(array, Memory):
            return self._load(array, index)
        if all(isinstance(i, ir.Constant) for i in index):
            return array[tuple(i.constant for i in index)]
        return self._load(self.readable(array), index)

    def _load(self, memory: Memory, index: Index) -> Element:
        storage = memory.storage
        if memory.version != storage.version:
            raise UnsupportedError("an array that is read after it was changed in place")
        if storage.column_stride is None:
            return self.memory.read(storage, index)
        if any(to.operands[0] is storage for _, to in self._queue):
            self.write_queued()
        node = Tangent(storage.kind, READ, {}, (storage, *index))
        if storage.writable:
            self._pending.setdefault(id(storage), []).append(node)
        return node

    def store(self, memory: Memory, given: Sequence[tuple[Index, Element]]) -> None:
        """Write elements."""
        storage = memory.storage
        assert storage.writable
        if storage.column_stride is not None:
            self._queue += [
                (element, Tangent(storage.kind, READ, {}, (storage, *index)))
                for index, element in given
            ]
            return
        for index, element in given:
            if isinstance(element, Tangent):
                raise UnsupportedError("a tangent where none is expected")
            self.memory.write(storage, index, element)

    def store_rows(self, memory: Memory, number: ir.Value | None, rows: Value) -> None:
        """Write an array, or one row of it, if the memory's guard says so."""
        storage, first = memory.storage, constant(I64, 0)
        guard, own = storage.guard, storage.strides if number is None else storage.strides[1:]
        if guard is not None:
            self.write_queued()
        if storage.begins and number is not None:
            first = self.e.product_of(number, storage.strides[0])
        with nullcontext() if guard is None else self.b.if_then(guard):
            if storage.begins and not isinstance(rows, np.ndarray) and self.is_long(rows.shape):

                def row(index: Index) -> None:
                    part = array_of(
                        [
                            self.at(rows, [*index, *(constant(I64, i) for i in place)])
                            for place in np.ndindex(rows.shape[1:])
                        ],
                        rows.shape[1:],
                    )
                    self._scatter(
                        storage, self.e.sum_of(first, self.e.product_of(index[0], own[0])), part
                    )

                self.for_each(rows.shape[:1], row)
                return
            given = self.elements(rows)
            if storage.begins:
                self._scatter(storage, first, given)
                return
            places = []
            for place in np.ndindex(given.shape):
                index = [constant(I64, i) for i in place]
                places.append((index if number is None else [number, *index], given[place]))
            self.store(memory, places)
            if guard is not None:
                self.write_queued()

    def _scatter(self, storage: Storage, first: ir.Value, given: Elements) -> None:
        """Write numbers of an output that lie side by side, from ``first``, in each lane's part."""
        elements = given.ravel().tolist()
        if storage.column_stride is None:
            if any(isinstance(e, Tangent) for e in elements):
                raise UnsupportedError("a tangent where none is expected")
            self.memory.lay_side_by_side(storage, first, elements)
            return
        parts: list[ir.Value] = []

        def lay(value: ir.Value) -> None:
            parts.append(value)
            if len(parts) == len(elements):
                assert self.memory.column is not None
                step = self.e.product_of(storage.column_stride, self.memory.column)
                self.memory.lay_side_by_side(storage, self.e.sum_of(first, step), parts)

        self.flush([(e, lay) for e in elements])

    def local(self, shape: tuple[int, ...], number: ir.Type, kind: int) -> Memory:
        """Return memory on the stack, uninitialised, for numbers of a type."""
        if any(length in self.lengths for length in shape):
            raise UnsupportedError(f"an array of shape {shape} that is no output")
        assert not (self.chooses and kind & OF_COLUMN)  # there are more rows than columns
        count, stored = prod(shape), ir.IntType(8) if number == BOOL else number
        width = self.e.width if kind & OF_LANE else 1
        total = count * width * (MAX_COLUMNS if kind & OF_COLUMN else 1)
        unit = constant(I64, width)
        storage = Storage(
            pointer=self.memory.allocate(stored, total),
            kind=number,
            strides=self.row_major(shape, unit),
            lane_stride=constant(I64, 1) if kind & OF_LANE else None,
            first_lane=None,
            column_stride=constant(I64, count * width) if kind & OF_COLUMN else None,
            writable=True,
        )
        self.storages.append(storage)
        return Memory(storage, shape)

    def readable(self, elements: Elements) -> Memory:
        """Return an array in registers as memory that is only read: constants as the program's."""
        flat = elements.ravel().tolist()
        if all(isinstance(e, ir.Constant) and not is_vector(e) and e.type != BOOL for e in flat):
            numbers = np.array([e.constant for e in flat]).reshape(elements.shape)
            return self._laid_out(numbers, flat[0].type)
        return self.copied_to_memory(elements)

    def copied_to_memory(self, value: Value, kind: int = 0) -> Memory:
        """Return a copy of an array in memory on the stack."""
        if not isinstance(value, np.ndarray):
            return self._copied(value, kind)
        memory = self.local(value.shape, _type_in(value), kind | kind_of(value))
        self.store_rows(memory, None, value)
        return memory

    def _copied(self, value: Memory | Deferred, kind: int) -> Memory:
        """Return memory that a loop fills with an array's elements."""
        copies: list[Memory] = []

        def copy(index: Index) -> None:
            element = array_of([self.at(value, index)], ())
            if not copies:
                own = self.local(value.shape, _type_in(element), kind | kind_of(element))
                copies.append(own)
            self.store(copies[0], [(index, element[()])])

        self.for_each(value.shape, copy)
        return copies[0]

    def for_each(self, shape: Sequence[int], body: Callable[[Index], None]) -> None:
        """Write a loop over all indices of an array."""

        def at(number: ir.Value) -> None:
            index: list[ir.Value] = []
            for length in reversed(shape):
                index.insert(0, self.b.urem(number, constant(I64, length)))
                number = self.b.udiv(number, constant(I64, length))
            body(index)

        self.count(constant(I64, 0), constant(I64, prod(shape)), 1, at)

    def count(
        self, begin: ir.Value, end: ir.Value, step: int, body: Callable[[ir.Value], None]
    ) -> None:
        """Write a loop over numbers from one to before another."""
        self.write_queued()

        def turn(number: ir.Value) -> None:
            body(number)
            self.write_queued()

        self.e.count(begin, end, step, turn)

    def start_within(self, start: ir.Value, length: int, size: int) -> ir.Value:
        """Return where a slice begins, moved so that it lies in its array."""
        start = self.e.as_index(start)
        if isinstance(start, ir.Constant) and length not in self.lengths:
            return constant(I64, min(max(start.constant, 0), length - size))
        last = self.b.sub(self.size(length), constant(I64, size))
        lowest = self.e.number(start, 0)
        start = self.e.select(self.b.icmp_signed("<", start, lowest), lowest, start)
        start, last = self.e.alike(start, last)
        return self.e.select(self.b.icmp_signed(">", start, last), last, start)


def read_only(value: Value) -> Value:
    """Return an array, in memory one that is not written to."""
    if not isinstance(value, Memory) or not value.storage.writable:
        return value
    if value.version != value.storage.version:
        raise UnsupportedError("an array that is read after it was changed in place")
    return Memory(replace(value.storage, writable=False), value.shape, value.version)


def _last_reads(jaxpr: Jaxpr) -> list[list[Any]]:
    """Return for each equation which variables are read there for the last time."""
    later = {var for var in jaxpr.outvars if not isinstance(var, Literal)}
    found: list[list[Any]] = []
    for eqn in reversed(jaxpr.eqns):
        own = {var for var in eqn.invars if not isinstance(var, Literal)} - later
        later |= own
        found.append(list(own))
    return found[::-1]


def shape_of(var: Any) -> tuple[int, ...]:
    """Return the shape of a variable of a jaxpr."""
    return tuple(var.aval.shape)


def dtype_of(var: Any) -> Any:
    """Return the type of a variable's numbers."""
    return var.aval.dtype


def _is_unsigned(var: Any) -> bool:
    return getattr(getattr(var.aval, "dtype", None), "kind", "") == "u"


def _type_in(elements: Elements) -> ir.Type:
    """Return the type of an array's numbers."""
    first = elements.ravel()[0]
    return first.kind if isinstance(first, Tangent) else base(first.type)


Rule: TypeAlias = Callable[["Lowering", JaxprEqn, list[Value]], "Value | list[Value]"]
STRUCTURAL: dict[str, Rule] = {}
"""Primitives that move elements or gather them, which `lanes.structural` fills in."""
CONTROL: dict[str, Callable[..., list[Value]]] = {}
"""Loops and conditions, which `lanes.control` fills in."""
