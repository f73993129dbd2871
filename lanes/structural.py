"""Primitives that move elements of arrays, or gather them into others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from math import prod

import numpy as np
from jax.extend.core import JaxprEqn
from llvmlite import ir

from lanes.emitter import I64, constant, converted, type_of
from lanes.linear import sliced, updated
from lanes.lowering import STRUCTURAL, Lowering, Rule, shape_of
from lanes.rules import apply
from lanes.values import (
    OF_COLUMN,
    Deferred,
    Element,
    Elements,
    Index,
    Memory,
    UnsupportedError,
    Value,
    array_of,
    is_vector,
    kind_of,
)


def _broadcast_in_dim(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    shape, kept = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    value = operands[0] if lower.is_long(shape) else lower.elements(operands[0])

    def at(index: Index) -> Element:
        own = [
            constant(I64, 0) if length == 1 else index[axis]
            for axis, length in zip(kept, value.shape, strict=True)
        ]
        return lower.at(value, own)

    return lower.deferred(shape, at, (value,))


def _reshape(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    (value,), shape = operands, shape_of(eqn.outvars[0])
    if not lower.is_long(shape):
        return lower.elements(value).reshape(shape)
    if [n for n in shape if n != 1] != [n for n in value.shape if n != 1]:
        raise UnsupportedError(f"reshape of {value.shape} to {shape}")

    def at(index: Index) -> Element:
        own = iter([i for i, n in zip(index, shape, strict=True) if n != 1])
        return lower.at(value, [constant(I64, 0) if n == 1 else next(own) for n in value.shape])

    return Deferred(tuple(shape), at, (value,))


def _transpose(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    (value,), order = operands, eqn.params["permutation"]
    if not isinstance(value, Memory) or not lower.is_long(value.shape):
        return lower.elements(value).transpose(order)
    strides = tuple(value.storage.strides[axis] for axis in order)
    turned = replace(value.storage, strides=strides, writable=False)
    return Memory(turned, tuple(value.shape[axis] for axis in order), value.version)


def _concatenate(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    axis, shape = eqn.params["dimension"], shape_of(eqn.outvars[0])
    if not lower.is_long(shape):
        return np.concatenate([lower.elements(o) for o in operands], axis=axis)
    firsts = np.cumsum([0, *(o.shape[axis] for o in operands)]).tolist()

    def at(index: Index) -> Element:
        """Read every part at the place nearest to the one asked for, and choose."""
        number, chosen = lower.e.as_index(index[axis]), None
        for operand, first in zip(operands, firsts, strict=False):
            own = lower.b.sub(number, lower.e.number(number, first))
            own = lower.start_within(own, operand.shape[axis], 1)
            read = lower.at(operand, [*index[:axis], own, *index[axis + 1 :]])
            if chosen is None:
                chosen = read
                continue
            behind = lower.b.icmp_signed(">=", number, lower.e.number(number, first))
            chosen = apply(lower.e, "select_n", {}, behind, chosen, read)
        return chosen

    return Deferred(shape, at, tuple(operands))


def _slice(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    (value,), p = operands, eqn.params
    strides = p["strides"] or (1,) * len(value.shape)

    def at(index: Index) -> Element:
        moved = [
            lower.e.sum_of(
                constant(I64, start), lower.e.product_of(lower.e.as_index(i), constant(I64, stride))
            )
            for i, start, stride in zip(index, p["start_indices"], strides, strict=True)
        ]
        return lower.at(value, moved)

    return lower.deferred(shape_of(eqn.outvars[0]), at, (value,))


def _unstack(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> list[Value]:
    (value,), axis = operands, eqn.params["axis"]

    def at(number: int) -> Callable[[Index], Element]:
        return lambda index: lower.at(value, [*index[:axis], constant(I64, number), *index[axis:]])

    return [
        lower.deferred(shape_of(out), at(number), (value,))
        for number, out in enumerate(eqn.outvars)
    ]


def _pad(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    given, filling = lower.elements(operands[0]), lower.elements(operands[1])[()]
    shape = shape_of(eqn.outvars[0])
    padded = array_of([filling] * prod(shape), shape)
    for place in np.ndindex(given.shape):
        to = [
            low + i * (interior + 1)
            for i, (low, _, interior) in zip(place, eqn.params["padding_config"], strict=True)
        ]
        if all(0 <= i < n for i, n in zip(to, shape, strict=True)):
            padded[tuple(to)] = given[place]
    return padded


def _iota(lower: Lowering, eqn: JaxprEqn, _: list[Value]) -> Value:
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    kind = type_of(eqn.params["dtype"])

    def at(index: Index) -> Element:
        return converted(lower.e, lower.e.as_index(index[axis]), kind)

    if lower.is_long(shape):
        return Deferred(tuple(shape), at)
    numbers = [constant(kind, place[axis]) for place in np.ndindex(*shape)]
    return array_of(numbers, shape)


def _empty(_: Lowering, eqn: JaxprEqn, __: list[Value]) -> Value:
    return array_of([constant(type_of(eqn.params["dtype"]), 0)], ())  # as XLA has it


def _reduce(name: str) -> Rule:
    def rule(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
        given, axes = lower.elements(operands[0]), eqn.params["axes"]
        kept = [axis for axis in range(given.ndim) if axis not in axes]
        shape = [given.shape[axis] for axis in kept]
        rows = given.transpose([*kept, *axes]).reshape(prod(shape), -1)
        if rows.shape[1] == 0:
            raise UnsupportedError(f"{eqn.primitive.name} over nothing")
        return array_of(
            [reduce(lambda x, y: apply(lower.e, name, {}, x, y), list(row)) for row in rows], shape
        )

    return rule


def _dot_general(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    (left_sum, right_sum), (left_batch, right_batch) = eqn.params["dimension_numbers"]
    left, right = map(lower.elements, operands)

    def rows(array: Elements, batch: Sequence[int], summed: Sequence[int]) -> Elements:
        free = [a for a in range(array.ndim) if a not in (*batch, *summed)]
        lengths = [prod(array.shape[a] for a in group) for group in (batch, free, summed)]
        return array.transpose([*batch, *free, *summed]).reshape(lengths)

    first, second = rows(left, left_batch, left_sum), rows(right, right_batch, right_sum)

    def dot(x: Elements, y: Elements) -> Element:
        products = [apply(lower.e, "mul", {}, a, b) for a, b in zip(x, y, strict=True)]
        return reduce(lambda a, b: apply(lower.e, "add", {}, a, b), products)

    found = [dot(x, y) for xs, ys in zip(first, second, strict=True) for x in xs for y in ys]
    return array_of(found, shape_of(eqn.outvars[0]))


def _dynamic_slice(lower: Lowering, eqn: JaxprEqn, operands: list[Value]) -> Value:
    value, sizes = operands[0], eqn.params["slice_sizes"]
    starts = [
        lower.start_within(lower.elements(s)[()], length, size)
        for s, length, size in zip(operands[1:], value.shape, sizes, strict=True)
    ]
    if isinstance(value, np.ndarray) and not all(isinstance(s, ir.Constant) for s in starts):
        if lower.chooses and kind_of(value) & OF_COLUMN:
            return sliced(lower, value, starts, sizes)
        value = lower.readable(value)
    if isinstance(value, Memory) and value.storage.begins and prod(sizes[:-1]) == 1:
        return array_of(lower.memory.read_row(value.storage, starts, sizes[-1]), sizes)
    found = [
        lower.at(
            value, [lower.e.sum_of(constant(I64, i), s) for i, s in zip(place, starts, strict=True)]
        )
        for place in np.ndindex(*sizes)
    ]
    return array_of(found, sizes)


def _dynamic_update_slice(lower: Lowering, _: JaxprEqn, operands: list[Value]) -> Value:
    value, update = operands[0], lower.elements(operands[1])
    starts = [
        lower.start_within(lower.elements(s)[()], length, size)
        for s, length, size in zip(operands[2:], value.shape, update.shape, strict=True)
    ]
    if isinstance(value, np.ndarray) and all(isinstance(s, ir.Constant) for s in starts):
        changed = value.copy()
        for place in np.ndindex(update.shape):
            to = tuple(i + s.constant for i, s in zip(place, starts, strict=True))
            changed[to] = update[place]
        return changed
    if lower.chooses and (kind_of(value) | kind_of(update)) & OF_COLUMN:
        return updated(lower, lower.elements(value), starts, update)
    if not isinstance(value, Memory) or not value.storage.writable:
        value = lower.copied_to_memory(value, kind_of(update))
    if any(map(is_vector, starts)):
        raise UnsupportedError("a change in place at an index of each lane's own")
    if value.version != value.storage.version:
        raise UnsupportedError("an array that is changed after it was changed in place")
    places = []
    for place in np.ndindex(update.shape):
        at = [lower.e.sum_of(constant(I64, i), s) for i, s in zip(place, starts, strict=True)]
        places.append((at, update[place]))
    lower.store(value, places)
    value.storage.version += 1
    return Memory(value.storage, value.shape, value.storage.version)


STRUCTURAL.update(
    {
        "broadcast_in_dim": _broadcast_in_dim,
        "reshape": _reshape,
        "squeeze": _reshape,
        "expand_dims": _reshape,
        "transpose": _transpose,
        "concatenate": _concatenate,
        "stack": lambda lower, eqn, operands: np.stack(
            [lower.elements(o) for o in operands], axis=eqn.params.get("axis", 0)
        ),
        "slice": _slice,
        "split": lambda lower, eqn, operands: list[Value](
            np.split(
                lower.elements(operands[0]),
                np.cumsum(eqn.params["sizes"])[:-1],
                axis=eqn.params["axis"],
            )
        ),
        "unstack": _unstack,
        "rev": lambda lower, eqn, operands: np.flip(
            lower.elements(operands[0]), eqn.params["dimensions"]
        ),
        "pad": _pad,
        "iota": _iota,
        "empty2": _empty,
        "reduce_sum": _reduce("add"),
        "reduce_max": _reduce("max"),
        "reduce_min": _reduce("min"),
        "reduce_prod": _reduce("mul"),
        "reduce_or": _reduce("or"),
        "reduce_and": _reduce("and"),
        "dot_general": _dot_general,
        "dynamic_slice": _dynamic_slice,
        "dynamic_update_slice": _dynamic_update_slice,
    }
)
