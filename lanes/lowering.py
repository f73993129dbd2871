"""A jaxpr written as instructions, and how they read and write memory.

`lanes.rules` has the elementwise primitives, `lanes.structural` those that move elements,
`lanes.control` loops and conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import reduce
from itertools import product
from math import gcd, prod
from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from llvmlite import ir

from lanes.dependence import CALLS, called
from lanes.machine import register_bytes
from lanes.rules import (
    BOOL,
    CONTRACT,
    ELEMENTWISE,
    LINEAR,
    SIGNLESS,
    Emitter,
    constant,
    converted,
    mangled,
    type_of,
)
from lanes.tangents import Factor, Factors, Graph, Node
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

I64 = ir.IntType(64)
Made = TypeVar("Made")
LINE_BYTES = 64
"""bytes of a line of the cache."""
MAX_IN_REGISTERS = 512
"""Elements up to which an array may lie in registers."""
MAX_COLUMNS = 15
"""Columns that a block of lanes takes at most; odd, for numbers an even number of lines apart
meets in a few sets of the cache."""
MIN_SKIPPED_SUMS = 2
"""Sums from which it is asked whether a number moves before it is added to them."""
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
        self.e, self.columns, self.lengths, self._allocate = emitter, columns, lengths, allocate
        self._column: ir.Value | None = None
        """The number of the column that is computed."""
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
            return self.apply(name, params, *elements)

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

    def apply(self, name: str, params: Mapping[str, Any], *elements: Element) -> Element:
        """Apply a rule to elements, column by column where one is a tangent."""
        rule = ELEMENTWISE[name]
        moving = [x for x in elements if isinstance(x, Tangent)]
        if moving:
            to = name == "convert_element_type"
            kind = type_of(params["new_dtype"]) if to else moving[0].kind
            return Tangent(kind, name, params, elements)
        own = (
            1 if name == "select_n" else 0
        )  # the condition may be of another width than the choices
        return rule(self.e, params, *elements[:own], *self.e.alike(*elements[own:]))

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

    def as_index(self, number: ir.Value) -> ir.Value:
        """Return a whole number as an index."""
        return converted(self.e, number, I64)

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
        self.each_column(graph, self.factors_of(graph), hand_on, self.columns)
        for node, slot in kept:
            node.operands = slot.operands

    def factors_of(self, graph: Graph) -> dict[Any, ir.Value]:
        """Compute the factors of a graph's sums, which all columns share."""
        factors = Factors(self.apply)
        return {
            (node, operand): factors.of(factor, node.kind)
            for node in graph.nodes
            if node.terms is not None
            for operand, factor in node.terms.items()
        }

    def each_column(
        self,
        graph: Graph,
        factors: Mapping[Any, ir.Value],
        hand_on: Sequence[Callable[[ir.Value], None]],
        columns: ir.Value,
    ) -> None:
        """Write a loop that computes a graph column by column, and hands its outputs on."""

        def of_column(number: ir.Value) -> None:
            found: dict[Node, ir.Value] = {}
            self._column, self.e.flags = number, LINEAR
            begun = self._begun(graph, factors)
            for node in graph.nodes:
                if node.terms is not None:
                    found[node] = self._sum_of(node, factors, found, *begun.get(node, ()))
                elif not isinstance(node.of, Tangent):
                    found[node] = node.of
                elif node.is_read:
                    found[node] = self._number_of(node)
                else:
                    given = (found[x] if isinstance(x, Node) else x for x in node.operands)
                    found[node] = self.apply(node.of.name, node.of.params, *given)
            self.e.flags = CONTRACT
            for hand, node in zip(hand_on, graph.outs, strict=True):
                hand(found[node])
            self._column = None

        self.count(constant(I64, 0), columns, 1, of_column)

    def _begun(
        self, graph: Graph, factors: Mapping[Any, ir.Value]
    ) -> dict[Node, tuple[ir.Value, Set[Node]]]:
        """Begin sums with the terms that move in few columns; return the sums and those terms.

        Where it does not move in a column, nothing is computed of it there.
        """
        begun: dict[Node, tuple[ir.Value, Set[Node]]] = {}
        for node in graph.nodes:
            sums = [reader for reader in node.readers if reader.terms is not None]
            if not node.has_column_flags or len(sums) < MIN_SKIPPED_SUMS:
                continue
            for reader in sums:
                if reader not in begun:
                    first = next(iter(reader.sum))
                    ready = (
                        reader.sum[first] == 1.0 and first.is_read and not first.has_column_flags
                    )
                    begun[reader] = (
                        (self._number_of(first), {first})
                        if ready
                        else (constant(self.e.vector(node.kind), 0.0), set())
                    )
            place = self.b.gep(node.of.operands[0].moves, [self._column])
            moves = self.b.icmp_unsigned("!=", self.b.load(place), constant(ir.IntType(8), 0))
            before = self.b.block
            with self.b.if_then(moves):
                number, inside = self._number_of(node), self.b.block
                totals = [
                    self._plus(begun[reader][0], number, reader.sum[node], factors[reader, node])
                    for reader in sums
                ]
            for reader, total in zip(sums, totals, strict=True):
                old, held = begun[reader]
                new = self.b.phi(total.type)
                new.add_incoming(old, before)
                new.add_incoming(total, inside)
                begun[reader] = new, {*held, node}
        return begun

    def _number_of(self, node: Node) -> ir.Value:
        """Return a tangent's number that lies in memory."""
        storage, *index = node.of.operands
        return self._read_number(storage, index)

    def _sum_of(
        self,
        node: Node,
        factors: Mapping[Any, ir.Value],
        numbers: Mapping[Node, ir.Value],
        total: ir.Value | None = None,
        held: Set[Node] = frozenset(),
    ) -> ir.Value:
        """Return a sum of numbers times factors, of which some are in a total."""
        for operand, factor in node.sum.items():
            if operand not in held:
                total = self._plus(total, numbers[operand], factor, factors[node, operand])
        return constant(node.kind, 0.0) if total is None else total

    def _plus(
        self, total: ir.Value | None, number: ir.Value, factor: Factor, value: ir.Value
    ) -> ir.Value:
        """Return a total and a number times a factor, which has a value."""
        if factor == -1.0 and total is not None:
            return self.apply("sub", {}, total, number)
        part = number if factor == 1.0 else self.apply("mul", {}, number, value)
        return part if total is None else self.apply("add", {}, total, part)

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
            storage.moves = self._allocate(ir.IntType(8), MAX_COLUMNS)
        return Tangent(kind, READ, {}, (storage,))

    def into(self, slot: Tangent) -> Callable[[ir.Value], None]:
        """Return a function that writes one column of a tangent into its memory."""
        storage, *index = slot.operands

        def write(value: ir.Value) -> None:
            self._write_number(storage, index, value)
            if storage.moves is not None:
                differs = self.b.fcmp_unordered("!=", value, self.e.number(value, 0.0))
                moves = self.b.zext(self.e.any_lane(differs), ir.IntType(8))
                self.b.store(moves, self.b.gep(storage.moves, [self._column]))

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
        stride = constant(I64, 1) if unit is None else unit
        strides: list[ir.Value] = []
        for length in reversed(shape):
            strides.insert(0, stride)
            stride = self.product_of(stride, self.size(length))
        return tuple(strides)

    def product_of(self, first: ir.Value, second: ir.Value) -> ir.Value:
        """Return a product of two indices, a constant if both are."""
        if isinstance(first, ir.Constant) and isinstance(second, ir.Constant):
            return constant(I64, first.constant * second.constant)
        return self.b.mul(first, second)

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
            return self._read_number(storage, index)
        if any(to.operands[0] is storage for _, to in self._queue):
            self.write_queued()
        node = Tangent(storage.kind, READ, {}, (storage, *index))
        if storage.writable:
            self._pending.setdefault(id(storage), []).append(node)
        return node

    def _read_number(self, storage: Storage, index: Index) -> ir.Value:
        if any(map(is_vector, index)):
            if storage.begins:
                raise UnsupportedError("an index of each lane's own where lanes lie apart")
            return self._gathered(storage, index)
        if storage.begins:
            return self.read_row(storage, index, 1)[0]
        place = self._place(storage, index)
        return self._read_at(storage, place, wide=storage.lane_stride is not None)

    def read_row(self, storage: Storage, index: Index, count: int) -> list[ir.Value]:
        """Read so many numbers that lie side by side in each lane's part."""
        place, width = self._place(storage, index), self.e.width
        lanes = self._parts(storage, place)
        found: list[ir.Value] = []
        whole = count // width * width if storage.kind != BOOL else 0
        for begin in range(0, whole, width):
            rows = []
            for lane in lanes:
                pointer = self.b.gep(lane, [constant(I64, begin)])
                row = self.b.load(self.b.bitcast(pointer, self.e.vector(storage.kind).as_pointer()))
                row.align = _bytes(storage.kind)
                rows.append(row)
            found += self._transposed(rows)
        for number in range(whole, count):
            element = ir.Constant(self.e.vector(storage.kind), ir.Undefined)
            for lane_number, lane in enumerate(lanes):
                one = self._read_at(
                    replace(storage, pointer=lane), constant(I64, number), wide=False
                )
                element = self.b.insert_element(element, one, constant(ir.IntType(32), lane_number))
            found.append(element)
        return found

    def _gathered(self, storage: Storage, index: Index) -> ir.Value:
        """Read at an index of each lane's own; where all are the same, at once."""
        index = [self.e.splat(i) for i in index]
        first = [self.b.extract_element(i, constant(ir.IntType(32), 0)) for i in index]
        differ = None
        for each, one in zip(index, first, strict=True):
            apart = self.b.icmp_signed("!=", each, self.e.splat(one))
            differ = apart if differ is None else self.b.or_(differ, apart)
        assert differ is not None

        def one_by_one() -> ir.Value:
            result = ir.Constant(self.e.vector(storage.kind), ir.Undefined)
            for lane in range(self.e.width):
                number = constant(ir.IntType(32), lane)
                own = [self.b.extract_element(i, number) for i in index]
                place = self._place(storage, own)
                if storage.lane_stride is not None:
                    step = self.product_of(storage.lane_stride, constant(I64, lane))
                    place = self.b.add(place, step)
                one = self._read_at(storage, place, wide=False)
                result = self.b.insert_element(result, one, number)
            return result

        def together() -> ir.Value:
            return self.e.splat(self._read_number(storage, first))

        return self.either(self.e.any_lane(differ), one_by_one, together)

    def either(
        self, flag: ir.Value, yes: Callable[[], ir.Value], no: Callable[[], ir.Value]
    ) -> ir.Value:
        """Compute one of two values, by a branch."""
        found = []
        with self.b.if_else(flag) as branches:
            for branch, compute in zip(branches, (yes, no), strict=True):
                with branch:
                    found.append((compute(), self.b.block))
        phi = self.b.phi(found[0][0].type)
        for value, block in found:
            phi.add_incoming(value, block)
        return phi

    def _place(self, storage: Storage, index: Index) -> ir.Value:
        place = constant(I64, 0)
        for i, stride in zip(index, storage.strides, strict=True):
            place = self.sum_of(place, self.product_of(self.as_index(i), stride))
        if storage.first_lane is not None and not storage.begins:
            assert storage.lane_stride is not None
            place = self.sum_of(place, self.product_of(storage.first_lane, storage.lane_stride))
        if storage.column_stride is not None:
            assert self._column is not None
            place = self.b.add(place, self.product_of(storage.column_stride, self._column))
        return place

    def sum_of(self, first: ir.Value, second: ir.Value) -> ir.Value:
        """Return a sum of two indices, a constant if both are."""
        if isinstance(first, ir.Constant):
            if first.constant == 0:
                return second
            if isinstance(second, ir.Constant):
                return constant(I64, first.constant + second.constant)
        return self.b.add(first, second)

    def _read_at(self, storage: Storage, place: ir.Value, *, wide: bool) -> ir.Value:
        pointer = self.b.gep(storage.pointer, [place])
        stored = storage.pointer.type.pointee
        if wide:
            pointer = self.b.bitcast(pointer, self.e.vector(stored).as_pointer())
        value = self.b.load(pointer)
        value.align = _bytes(stored)
        if storage.kind != BOOL:
            return value
        return self.b.icmp_unsigned("!=", value, self.e.number(value, 0))

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
            self._write_number(storage, index, element)

    def _write_number(self, storage: Storage, index: Index, value: ir.Value) -> None:
        place = self._place(storage, index)
        stored = storage.pointer.type.pointee
        if storage.kind == BOOL:
            value = self.b.zext(value, self.e.vector(stored) if is_vector(value) else stored)
        if storage.lane_stride is None:
            if is_vector(value):
                raise UnsupportedError("lanes' own values where all are to share one")
            self.b.store(value, self.b.gep(storage.pointer, [place])).align = _bytes(stored)
            return
        value = self.e.splat(value)
        pointer = self.b.bitcast(self.b.gep(storage.pointer, [place]), value.type.as_pointer())
        self.b.store(value, pointer).align = _bytes(stored)

    def store_rows(self, memory: Memory, number: ir.Value | None, rows: Value) -> None:
        """Write an array, or one row of it, if the memory's guard says so."""
        storage, first = memory.storage, constant(I64, 0)
        guard, own = storage.guard, storage.strides if number is None else storage.strides[1:]
        if guard is not None:
            self.write_queued()
        if storage.begins and number is not None:
            first = self.product_of(number, storage.strides[0])
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
                        storage, self.sum_of(first, self.product_of(index[0], own[0])), part
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
            self._lay_all(storage, first, elements)
            return
        parts: list[ir.Value] = []

        def lay(value: ir.Value) -> None:
            parts.append(value)
            if len(parts) == len(elements):
                assert self._column is not None
                step = self.product_of(storage.column_stride, self._column)
                self._lay_all(storage, self.sum_of(first, step), parts)

        self.flush([(e, lay) for e in elements])

    def _lay_all(self, storage: Storage, first: ir.Value, parts: list[ir.Value]) -> None:
        """Write numbers side by side in each lane's part."""
        stored, width = storage.pointer.type.pointee, self.e.width
        if storage.kind == BOOL:
            parts = [self.b.zext(p, self.e.vector(stored)) for p in map(self.e.splat, parts)]
        vectors = [self.e.splat(part) for part in parts]
        lanes, begin = self._parts(storage, first), 0
        while begin < len(vectors):
            count = 1 << (min(width, len(vectors) - begin).bit_length() - 1)
            self._lay(vectors[begin : begin + count], lanes, constant(I64, begin))
            begin += count

    def begins(self, parts: Sequence[tuple[ir.Value, ir.Value]]) -> ir.Value:
        """Return where each lane's part begins: numbers of each lane, times steps, summed up."""
        begin = reduce(self.b.add, (self.b.mul(n, self.e.splat(step)) for n, step in parts))
        pointer = self._allocate(I64, self.e.width)
        self.b.store(begin, self.b.bitcast(pointer, begin.type.as_pointer())).align = 8
        return pointer

    def _parts(self, storage: Storage, place: ir.Value) -> list[ir.Value]:
        """Return where in each lane's part a place lies."""
        return self._in_lanes(self.b.gep(storage.pointer, [place]), storage.begins)

    def _in_lanes(self, pointer: ir.Value, begins: ir.Value | None) -> list[ir.Value]:
        places = (self.b.gep(begins, [constant(I64, lane)]) for lane in range(self.e.width))
        return [self.b.gep(pointer, [self.b.load(place)]) for place in places]

    def _lay(
        self,
        vectors: list[ir.Value],
        lanes: Sequence[ir.Value],
        place: ir.Value,
        *,
        whole_lines: bool = False,
    ) -> None:
        """Write numbers, a power of two of them, side by side in each lane's part.

        Whole lines of the cache go to memory past it. Otherwise, where as many follow, their
        memory is asked for.
        """
        count, turned = len(vectors), self._transposed(vectors)
        for number, lane in enumerate(lanes):
            row = self._some_lanes(turned[number % count], number - number % count, count)
            begin = self.b.gep(lane, [place])
            store = self.b.store(row, self.b.bitcast(begin, row.type.as_pointer()))
            store.align = LINE_BYTES if whole_lines else _bytes(base(row.type))
            if whole_lines:
                once = self.e.module.add_metadata([constant(ir.IntType(32), 1)])
                store.set_metadata("nontemporal", once)
            elif count > 1:
                self.e.fetch(self.b.gep(begin, [constant(I64, 2 * count - 1)]))

    def rows_of(self, memory: Memory) -> Memory | None:
        """Return memory for some rows of an output, to be laid at once; None for one at a time.

        Short rows of lanes that lie apart would be written number by number.
        """
        storage, shape = memory.storage, memory.shape[1:]
        stored, size = storage.pointer.type.pointee, prod(shape)
        together = self._side_by_side(stored)
        rows = together // gcd(size, together)
        if storage.begins is None or rows == 1 or size > 2 * together:
            return None
        width = self.e.width
        own = replace(
            storage,
            pointer=self._allocate(
                stored,
                rows * size * width * (1 if storage.column_stride is None else MAX_COLUMNS),
            ),
            strides=self.row_major((rows, *shape), constant(I64, width)),
            lane_stride=constant(I64, 1),
            column_stride=storage.column_stride and constant(I64, rows * size * width),
            begins=None,
            guard=None,
            writes=[0],
        )
        return Memory(own, (rows, *shape))

    def lay_rows(self, memory: Memory, rows: Memory, first: ir.Value, count: ir.Value) -> None:
        """Write so many rows that were collected where a first one belongs."""
        storage, collected = memory.storage, rows.storage
        size = constant(I64, collected.strides[0].constant // self.e.width)
        into = self.b.gep(storage.pointer, [self.product_of(first, storage.strides[0])])
        length, begins = self.product_of(count, size), storage.begins

        def lay(into: ir.Value, rows: ir.Value) -> None:
            self.b.call(self._laying(into.type), [into, begins, rows, length])

        def of_column(number: ir.Value) -> None:
            lay(
                self.b.gep(into, [self.product_of(storage.column_stride, number)]),
                self.b.gep(collected.pointer, [self.product_of(collected.column_stride, number)]),
            )

        with nullcontext() if storage.guard is None else self.b.if_then(storage.guard):
            if storage.column_stride is None:
                lay(into, collected.pointer)
            else:
                self.count(constant(I64, 0), self.columns, 1, of_column)

    def _laying(self, kind: ir.Type) -> ir.Function:
        """Return the function that writes so many vectors side by side in each lane's part."""
        stored, types = kind.pointee, [kind, I64.as_pointer(), kind, I64]
        function = self.e.declared(f"lay.{mangled(stored)}", ir.FunctionType(ir.VoidType(), types))
        if not function.is_declaration:
            return function
        function.linkage = "internal"
        function.attributes.add("noinline")
        into, begins, rows, count = function.args
        outside, self.e.b = self.b, ir.IRBuilder(function.append_basic_block())
        lanes = self._in_lanes(into, begins)
        vectors = self.b.bitcast(rows, self.e.vector(stored).as_pointer())

        def lay(place: ir.Value, number: int, *, whole_lines: bool = False) -> None:
            each = (self.b.add(place, constant(I64, i)) for i in range(number))
            rows = [self.b.load(self.b.gep(vectors, [i])) for i in each]
            self._lay(rows, lanes, place, whole_lines=whole_lines)

        together = self._side_by_side(stored)
        whole = self.b.and_(count, constant(I64, -together))

        def lay_whole(*, lines: bool) -> None:
            self.count(
                constant(I64, 0),
                whole,
                together,
                lambda place: lay(place, together, whole_lines=lines),
            )

        if together * _bytes(stored) == LINE_BYTES:
            places = reduce(self.b.or_, (self.b.ptrtoint(lane, I64) for lane in lanes))
            within = self.b.and_(places, constant(I64, LINE_BYTES - 1))
            aligned = self.b.icmp_unsigned("==", within, constant(I64, 0))
            with self.b.if_else(aligned) as (yes, no):
                with yes:
                    lay_whole(lines=True)
                with no:
                    lay_whole(lines=False)
        else:
            lay_whole(lines=False)
        self.count(whole, count, 1, lambda place: lay(place, 1))
        self.b.ret_void()
        self.e.b = outside
        return function

    def _side_by_side(self, stored: ir.Type) -> int:
        """Return how many numbers of one lane are written at once."""
        return min(self.e.width, register_bytes() // _bytes(stored))

    def _some_lanes(self, row: ir.Value, first: int, count: int) -> ir.Value:
        """Return neighbouring lanes of a vector; one lane as a number."""
        index = ir.IntType(32)
        if count == 1:
            return self.b.extract_element(row, constant(index, first))
        lanes = ir.Constant(ir.VectorType(index, count), list(range(first, first + count)))
        return self.b.shuffle_vector(row, row, lanes)

    def _transposed(self, rows: list[ir.Value]) -> list[ir.Value]:
        """Return vectors, a power of two of them, each square of so many lanes transposed."""
        width, half = self.e.width, len(rows) // 2
        while half:
            turned = list(rows)
            for i in range(len(rows)):
                if i & half:
                    continue
                # lanes whose number has this bit change places between the two
                low = [j if not j & half else width + j - half for j in range(width)]
                high = [j + half if not j & half else width + j for j in range(width)]
                for to, mask in ((i, low), (i + half, high)):
                    lanes = ir.Constant(ir.VectorType(ir.IntType(32), width), mask)
                    turned[to] = self.b.shuffle_vector(rows[i], rows[i + half], lanes)
            rows, half = turned, half // 2
        return rows

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
            pointer=self._allocate(stored, total),
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

        def turn(carried: Sequence[ir.Value]) -> list[ir.Value]:
            body(carried[0])
            self.write_queued()
            return [self.b.add(carried[0], constant(I64, step))]

        self.loop([begin], lambda carried: self.b.icmp_signed("<", carried[0], end), turn)

    def loop(
        self,
        begin: Sequence[ir.Value],
        goes_on: Callable[[Sequence[ir.Value]], ir.Value],
        turn: Callable[[Sequence[ir.Value]], Sequence[ir.Value]],
    ) -> list[ir.Value]:
        """Write a loop that carries values, its head's φ-nodes; return them as it leaves them."""
        b, nodes = self.b, []
        before, head = b.block, b.append_basic_block("loop")
        inside, after = (b.append_basic_block(name) for name in ("turn", "after"))
        b.branch(head)
        b.position_at_end(head)
        for value in begin:
            nodes.append(b.phi(value.type))
            nodes[-1].add_incoming(value, before)
        b.cbranch(goes_on(nodes), inside, after)
        b.position_at_end(inside)
        following = turn(nodes)
        for node, value in zip(nodes, following, strict=True):
            node.add_incoming(value, b.block)
        b.branch(head)
        b.position_at_end(after)
        return nodes

    def start_within(self, start: ir.Value, length: int, size: int) -> ir.Value:
        """Return where a slice begins, moved so that it lies in its array."""
        start = self.as_index(start)
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


def _bytes(kind: ir.Type) -> int:
    if isinstance(kind, ir.IntType):
        return int(kind.width) // 8
    return 8 if isinstance(kind, ir.DoubleType) else 4


Rule: TypeAlias = Callable[["Lowering", JaxprEqn, list[Value]], "Value | list[Value]"]
STRUCTURAL: dict[str, Rule] = {}
"""Primitives that move elements or gather them, which `lanes.structural` fills in."""
CONTROL: dict[str, Callable[..., list[Value]]] = {}
"""Loops and conditions, which `lanes.control` fills in."""
