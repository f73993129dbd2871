"""The function around a jaxpr: where its arguments lie, and where each lane's results belong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jax.extend.core import Literal
from llvmlite import ir

from lanes.emitter import BOOL, I64, Emitter, constant, type_of
from lanes.lowering import Lowering
from lanes.values import Memory, Storage, Value

Length: TypeAlias = "int | str"
Lengths: TypeAlias = Mapping[str, int]

MAX_READ_AHEAD = 64
"""Numbers up to which an argument is read before anything is computed."""


@dataclass(frozen=True)
class Argument:
    """An array that a function takes, as one lane has it.

    Attributes
    ----------
    shape
        Its lengths; a name stands for one that is known when the program runs.
    dtype
        Of its numbers.
    lanes
        Whether each lane has its own: then it is given with the lanes along a last axis.
    apart
        Whether each lane's own lies together: then it is given with the lanes along a first axis,
        and not copied.
    moves
        Whether the function is differentiated by it: tangents are then given with the columns along
        a first axis, the same for all lanes.
    """

    shape: tuple[Length, ...]
    dtype: Any
    lanes: bool
    moves: bool = False
    apart: bool = False

    @staticmethod
    def of(leaf: Any, *, lanes: bool, moves: bool = False) -> Argument:
        """Return how an array is given: the lanes along its last axis, or shared by all."""
        shape = np.shape(leaf)[:-1] if lanes else np.shape(leaf)
        dtype = leaf.dtype if hasattr(leaf, "dtype") else np.result_type(leaf)
        return Argument(shape, dtype, lanes, moves)


class _Frame(NamedTuple):
    """Arguments of the kernel, and the place of the block of lanes that it computes.

    A block takes some columns for each of its lanes. ``segment`` is whose results a lane computes,
    ``turn`` which column is its first; there are ``columns``.
    """

    given: list[ir.Value]
    taken: list[ir.Value]
    lanes: ir.Value
    own_lanes: ir.Value
    columns: ir.Value
    first_lane: ir.Value
    own_lane: ir.Value
    segment: ir.Value
    turn: ir.Value


def module_text(
    closed: Any,
    width: int,
    *,
    arguments: Sequence[Argument],
    moving: Sequence[int],
    lengths: Lengths,
    outputs: Sequence[Any],
    moved: Sequence[int],
) -> str:
    """Return the module of a traced function, as text, for so many lanes at a time.

    Its function ``run`` takes tables of the addresses of arguments and results, the lengths,
    the segment and the turn of each lane, how many lanes there are, after how many blocks the
    arguments begin again, how many columns there are, how many a block takes, and from which
    block to which it is to compute.

    Parameters
    ----------
    arguments, moving
        Of the program; which arguments have tangents.
    lengths
        Name -> stand-in of each length that is an argument.
    outputs, moved
        Shapes of the results, those of the tangents behind the values', and which are tangents.

    Raises
    ------
    UnsupportedError
        Something has no rule.
    """
    module = ir.Module("lanes")
    emitter = Emitter(module, width)
    b = emitter.b
    bytes_of, whole = ir.IntType(8).as_pointer().as_pointer(), I64.as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [bytes_of, bytes_of, whole, whole, whole, *[I64] * 6])
    function = ir.Function(module, kind, "run")
    ins, outs, sizes, segments, turns, lanes, blocks, every, columns, begin, end = function.args
    entry, body = (function.append_basic_block(name) for name in ("entry", "begin"))
    stack = ir.IRBuilder(entry)
    b.position_at_end(body)

    def allocate(stored: ir.Type, count: int) -> ir.Value:
        memory = stack.alloca(stored, ir.Constant(ir.IntType(32), count))
        memory.align = 64
        return memory

    known = {
        stand_in: b.load(b.gep(sizes, [constant(I64, number)]))
        for number, stand_in in enumerate(lengths.values())
    }
    lower = Lowering(emitter, columns, known, allocate)
    given = [
        _pointer_in(b, ins, number, var.aval.dtype)
        for number, var in enumerate(closed.jaxpr.invars)
    ]
    taken = [_pointer_in(b, outs, number, shape.dtype) for number, shape in enumerate(outputs)]
    at_once = constant(I64, width)

    def compute(block: ir.Value) -> None:
        first_lane = b.mul(block, at_once)

        def of_lanes(table: ir.Value) -> ir.Value:
            place = b.bitcast(b.gep(table, [first_lane]), emitter.vector(I64).as_pointer())
            found = b.load(place)
            found.align = 8
            return found

        frame = _Frame(
            given,
            taken,
            lanes,
            b.mul(blocks, at_once),
            every,
            first_lane,
            b.mul(b.srem(block, blocks), at_once),
            of_lanes(segments),
            of_lanes(turns),
        )
        memories = _results(lower, frame, outputs, moved)
        bound = {
            var: memory
            for var, memory in zip(closed.jaxpr.outvars, memories, strict=True)
            if not isinstance(var, Literal)
        }
        taking = [*arguments, *(arguments[number] for number in moving)]
        values = _arguments(lower, frame, taking, closed.jaxpr.invars, len(arguments))
        results = lower.run(closed.jaxpr, closed.consts, values, bound)
        for result, memory in zip(results, memories, strict=True):
            if isinstance(result, Memory) and result.storage is memory.storage:
                continue  # a loop has laid it there
            lower.store_rows(memory, None, result)

    lower.count(begin, end, 1, compute)
    b.ret_void()
    stack.branch(body)
    return str(module)


def _arguments(
    lower: Lowering, frame: _Frame, taking: Sequence[Argument], variables: Sequence[Any], count: int
) -> list[Value]:
    """Return ``count`` arguments, and the tangents behind them: short ones in registers."""
    values: list[Value] = []
    for number, (argument, var) in enumerate(zip(taking, variables, strict=True)):
        shape, tangent = tuple(var.aval.shape), number >= count
        by_lane = argument.lanes or tangent
        row = (frame.lanes if tangent else frame.own_lanes) if by_lane else None
        apart = argument.apart and not tangent
        column, *strides = lower.row_major((0, *shape), None if apart else row)
        storage = Storage(
            frame.given[number],
            type_of(var.aval.dtype),
            tuple(strides),
            (column if apart else constant(I64, 1)) if by_lane else None,
            (frame.first_lane if tangent else frame.own_lane) if by_lane else None,
            column_stride=column if tangent else None,
            begins=lower.memory.begins([(frame.segment, column)]) if apart else None,
        )
        memory = Memory(storage, shape)
        values.append(lower.elements(memory) if prod(shape) <= MAX_READ_AHEAD else memory)
    return values


def _results(
    lower: Lowering, frame: _Frame, outputs: Sequence[Any], moved: Sequence[int]
) -> list[Memory]:
    """Return the memory of each result, where each lane writes its own part."""
    b = lower.b
    nowhere, zero = constant(I64, 0), lower.e.number(frame.turn, 0)
    is_first = lower.e.any_lane(b.icmp_signed("==", frame.turn, zero))
    memories = []
    for pointer, shape, moves in zip(frame.taken, outputs, moved, strict=True):
        own, *strides = lower.row_major((0, *shape.shape))
        parts = [(frame.segment, own)]
        if moves:
            parts = [(frame.segment, b.mul(frame.columns, own)), (frame.turn, own)]
        is_wanted = b.icmp_unsigned("!=", b.ptrtoint(pointer, I64), nowhere)
        storage = Storage(
            pointer,
            type_of(shape.dtype),
            tuple(strides),
            own,
            None,
            column_stride=own if moves else None,
            begins=lower.memory.begins(parts),
            writable=True,
            guard=is_wanted if moves else b.and_(is_first, is_wanted),
        )
        memories.append(Memory(storage, tuple(shape.shape)))
    return memories


def is_laid_by_loop(shape: Any, lengths: Lengths) -> bool:
    """Return whether an output's first axis is a loop's, whose length is an argument."""
    return bool(shape.shape) and shape.shape[0] in lengths.values()


def _pointer_in(b: ir.IRBuilder, table: ir.Value, number: int, dtype: Any) -> ir.Value:
    """Return an address out of a table, as that of numbers."""
    kind = type_of(dtype)
    stored = ir.IntType(8) if kind == BOOL else kind
    return b.bitcast(b.load(b.gep(table, [constant(I64, number)])), stored.as_pointer())
