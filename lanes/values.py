"""Values of the variables of a jaxpr: elements in registers, or an array elsewhere.

An array of a few numbers is a NumPy array of `Element`. An element is an LLVM value, scalar if all
lanes share it and a vector if each has its own, or a `Tangent`. Reshaping, slicing or stacking such
arrays costs no instruction.

Longer arrays, and those whose length is an argument, are read element by element: `Memory` holds
them, `Deferred` computes each when it is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import count
from operator import or_
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

Element: TypeAlias = Any
"""An `ir.Value` or a `Tangent`."""
Elements: TypeAlias = NDArray[np.object_]
Index: TypeAlias = Sequence[ir.Value]


class UnsupportedError(NotImplementedError):
    """A function holds something that no rule covers; its message names it."""


def array_of(elements: Sequence[Element], shape: Sequence[int]) -> Elements:
    """Return elements in row-major order as an array of a shape."""
    array = np.empty(len(elements), object)
    for number, element in enumerate(elements):
        array[number] = element
    return array.reshape(tuple(shape))


def is_vector(value: ir.Value) -> bool:
    """Return whether each lane has its own."""
    return isinstance(value.type, ir.VectorType)


def base(kind: ir.Type) -> ir.Type:
    """Return the type of one lane's number."""
    return kind.element if isinstance(kind, ir.VectorType) else kind


OF_LANE, OF_COLUMN = 1, 2
"""Bits of an array's kind: each lane has its own, each column of a tangent has."""


def parts_of(elements: Iterable[Element]) -> list[ir.Value]:
    """Return the elements that are LLVM values."""
    return [e for e in elements if not isinstance(e, Tangent)]


def kind_of(value: Value) -> int:
    """Return the bits of an array's kind."""
    if isinstance(value, Memory):
        storage = value.storage
        by_lane, by_column = storage.lane_stride is not None, storage.column_stride is not None
    elif isinstance(value, Deferred):
        return reduce(or_, map(kind_of, value.sources), 0)
    else:
        elements = value.ravel().tolist()
        by_column = any(isinstance(e, Tangent) for e in elements)
        by_lane = by_column or any(map(is_vector, parts_of(elements)))
    return OF_LANE * by_lane | OF_COLUMN * by_column


@dataclass(eq=False)
class Tangent:
    """One number of a tangent: how each column of it is computed.

    A block of lanes takes its columns one after the other: a loop over them computes many numbers
    at once, where some are needed. Until then they are as here.
    """

    kind: ir.Type
    """Of one lane's number in one column."""
    name: str
    """A primitive; `READ` reads memory."""
    params: Mapping[str, Any]
    operands: tuple[Element, ...]
    number: int = field(default_factory=count().__next__)
    """Of those that were written down before."""

    @property
    def is_read(self) -> bool:
        """Whether it lies in memory."""
        return self.name == READ


READ = "read"
"""The name of a tangent in memory: its operands are a storage and an index."""


@dataclass(eq=False)
class Storage:
    """Memory behind an array; every write makes older views of it stale."""

    pointer: ir.Value
    """To the first number of lane 0 in column 0."""
    kind: ir.Type
    """Of a number while it is computed with; truth values are bytes in memory."""
    strides: tuple[ir.Value, ...]
    """Numbers from one index to the next, axis by axis."""
    lane_stride: ir.Value | None
    """Numbers from one lane to the next; None where lanes share the array."""
    first_lane: ir.Value | None
    """Number of the block's first lane."""
    column_stride: ir.Value | None = None
    """Numbers from one column to the next; None where it is no tangent."""
    begins: ir.Value | None = None
    """To where the numbers of each lane of the block begin, of an output or an argument whose lanes
    lie apart. None where the lanes of an element lie beside each other."""
    writable: bool = False
    guard: ir.Value | None = None
    """When it is written to; None for always."""
    moves: ir.Value | None = None
    """To a byte a column, which is zero where a tangent's number is zero in every lane; None where
    that is not known."""
    writes: list[int] = field(default_factory=lambda: [0])
    """How often it was written to; shared with others of the same memory."""

    @property
    def version(self) -> int:
        """How often it was written to."""
        return self.writes[0]

    @version.setter
    def version(self, number: int) -> None:
        self.writes[0] = number


@dataclass(frozen=True, eq=False)
class Memory:
    """An array in memory, as it is after so many writes."""

    storage: Storage
    shape: tuple[int, ...]
    version: int = 0


@dataclass(frozen=True, eq=False)
class Deferred:
    """An array whose elements are computed where they are read."""

    shape: tuple[int, ...]
    at: Callable[[Index], Element] = field(repr=False)
    sources: tuple[Any, ...] = ()
    """Arrays that it is computed from."""


Array: TypeAlias = "Memory | Deferred"
Value: TypeAlias = "Elements | Memory | Deferred"
