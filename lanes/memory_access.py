"""How numbers of lanes are read from memory, and written to it.

Lanes of an element lie beside each other, or each lane's numbers lie together; then as many numbers
as lanes are read or written at once and transposed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import reduce
from math import gcd, prod

from llvmlite import ir

from lanes.emitter import BOOL, I64, Emitter, bytes_of, constant, mangled
from lanes.machine import register_bytes
from lanes.values import Index, Memory, Storage, Tangent, UnsupportedError, base, is_vector

LINE_BYTES = 64
"""bytes of a line of the cache."""
MAX_COLUMNS = 15
"""Columns that a block of lanes takes at most; odd, for numbers an even number of lines apart
meets in a few sets of the cache."""


class MemoryAccess:
    """Writes instructions that read memory and write to it.

    Parameters
    ----------
    emitter
        Writes instructions.
    allocate
        Returns memory on the stack for so many numbers of every lane.
    """

    def __init__(self, emitter: Emitter, allocate: Callable[[ir.Type, int], ir.Value]) -> None:
        self.e, self.allocate = emitter, allocate
        self.column: ir.Value | None = None
        """The number of the column that is computed."""

    @property
    def b(self) -> ir.IRBuilder:
        """Where instructions are written."""
        return self.e.b

    def read(self, storage: Storage, index: Index) -> ir.Value:
        """Return a number at an index, of the column that is computed where it is a tangent."""
        if any(map(is_vector, index)):
            if storage.begins:
                raise UnsupportedError("an index of each lane's own where lanes lie apart")
            return self._gathered(storage, index)
        if storage.begins:
            return self.read_row(storage, index, 1)[0]
        place = self._place(storage, index)
        return self._read_at(storage, place, wide=storage.lane_stride is not None)

    def read_tangent(self, tangent: Tangent) -> ir.Value:
        """Return a tangent's number that lies in memory, of the column that is computed."""
        storage, *index = tangent.operands
        return self.read(storage, index)

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
                row.align = bytes_of(storage.kind)
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
                    step = self.e.product_of(storage.lane_stride, constant(I64, lane))
                    place = self.b.add(place, step)
                one = self._read_at(storage, place, wide=False)
                result = self.b.insert_element(result, one, number)
            return result

        def together() -> ir.Value:
            return self.e.splat(self.read(storage, first))

        return self.e.either(self.e.any_lane(differ), one_by_one, together)

    def _place(self, storage: Storage, index: Index) -> ir.Value:
        place = constant(I64, 0)
        for i, stride in zip(index, storage.strides, strict=True):
            place = self.e.sum_of(place, self.e.product_of(self.e.as_index(i), stride))
        if storage.first_lane is not None and not storage.begins:
            assert storage.lane_stride is not None
            place = self.e.sum_of(place, self.e.product_of(storage.first_lane, storage.lane_stride))
        if storage.column_stride is not None:
            assert self.column is not None
            place = self.b.add(place, self.e.product_of(storage.column_stride, self.column))
        return place

    def _read_at(self, storage: Storage, place: ir.Value, *, wide: bool) -> ir.Value:
        pointer = self.b.gep(storage.pointer, [place])
        stored = storage.pointer.type.pointee
        if wide:
            pointer = self.b.bitcast(pointer, self.e.vector(stored).as_pointer())
        value = self.b.load(pointer)
        value.align = bytes_of(stored)
        if storage.kind != BOOL:
            return value
        return self.b.icmp_unsigned("!=", value, self.e.number(value, 0))

    def write(self, storage: Storage, index: Index, value: ir.Value) -> None:
        """Write a number at an index, of the column that is computed where it is a tangent."""
        place = self._place(storage, index)
        stored = storage.pointer.type.pointee
        if storage.kind == BOOL:
            value = self.b.zext(value, self.e.vector(stored) if is_vector(value) else stored)
        if storage.lane_stride is None:
            if is_vector(value):
                raise UnsupportedError("lanes' own values where all are to share one")
            self.b.store(value, self.b.gep(storage.pointer, [place])).align = bytes_of(stored)
            return
        value = self.e.splat(value)
        pointer = self.b.bitcast(self.b.gep(storage.pointer, [place]), value.type.as_pointer())
        self.b.store(value, pointer).align = bytes_of(stored)

    def lay_side_by_side(self, storage: Storage, first: ir.Value, parts: list[ir.Value]) -> None:
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
        pointer = self.allocate(I64, self.e.width)
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
            store.align = LINE_BYTES if whole_lines else bytes_of(base(row.type))
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
        width, lengths = self.e.width, [constant(I64, n) for n in (rows, *shape)]
        own = replace(
            storage,
            pointer=self.allocate(
                stored,
                rows * size * width * (1 if storage.column_stride is None else MAX_COLUMNS),
            ),
            strides=self.e.strides(lengths, constant(I64, width)),
            lane_stride=constant(I64, 1),
            column_stride=storage.column_stride and constant(I64, rows * size * width),
            begins=None,
            guard=None,
            writes=[0],
        )
        return Memory(own, (rows, *shape))

    def lay_rows(
        self, memory: Memory, rows: Memory, first: ir.Value, count: ir.Value, columns: ir.Value
    ) -> None:
        """Write so many rows that were collected where a first one belongs."""
        storage, collected = memory.storage, rows.storage
        size = constant(I64, collected.strides[0].constant // self.e.width)
        into = self.b.gep(storage.pointer, [self.e.product_of(first, storage.strides[0])])
        length, begins = self.e.product_of(count, size), storage.begins

        def lay(into: ir.Value, rows: ir.Value) -> None:
            self.b.call(self._laying(into.type), [into, begins, rows, length])

        def of_column(number: ir.Value) -> None:
            lay(
                self.b.gep(into, [self.e.product_of(storage.column_stride, number)]),
                self.b.gep(collected.pointer, [self.e.product_of(collected.column_stride, number)]),
            )

        with nullcontext() if storage.guard is None else self.b.if_then(storage.guard):
            if storage.column_stride is None:
                lay(into, collected.pointer)
            else:
                self.e.count(constant(I64, 0), columns, 1, of_column)

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
            self.e.count(
                constant(I64, 0),
                whole,
                together,
                lambda place: lay(place, together, whole_lines=lines),
            )

        if together * bytes_of(stored) == LINE_BYTES:
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
        self.e.count(whole, count, 1, lambda place: lay(place, 1))
        self.b.ret_void()
        self.e.b = outside
        return function

    def _side_by_side(self, stored: ir.Type) -> int:
        """Return how many numbers of one lane are written at once."""
        return min(self.e.width, register_bytes() // bytes_of(stored))

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
