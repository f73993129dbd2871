"""What writes LLVM instructions: constants, vectors of lanes, indices, loops and branches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import jax
import numpy as np
from llvmlite import ir

from lanes.values import UnsupportedError, base, is_vector

CONTRACT = ("contract",)
"""A product may be fused with a sum. Nothing else of fast-math is safe for values: in another
order terms cancel no more, and without NaN and infinity the test for a crash is folded away."""
LINEAR = ("contract", "reassoc", "nsz")
"""Of derivatives, which are products and sums of others: these may be factored and reordered."""

BOOL, I32, I64 = (ir.IntType(bits) for bits in (1, 32, 64))
TYPES: Mapping[np.dtype[Any], ir.Type] = {
    np.dtype(np.float64): ir.DoubleType(),
    np.dtype(np.float32): ir.FloatType(),
    np.dtype(np.int64): ir.IntType(64),
    np.dtype(np.int32): ir.IntType(32),
    np.dtype(np.uint64): ir.IntType(64),
    np.dtype(np.uint32): ir.IntType(32),
    np.dtype(np.bool_): BOOL,
    np.dtype(jax.dtypes.float0): BOOL,  # the tangent of an integer: never read
}


def type_of(dtype: Any) -> ir.Type:
    """Return the LLVM type of a number.

    Raises
    ------
    UnsupportedError
        There is none.
    """
    try:
        return TYPES[np.dtype(dtype)]
    except (KeyError, TypeError):
        raise UnsupportedError(f"numbers of type {dtype}") from None


def is_float(value: ir.Value) -> bool:
    """Return whether a value is a real number."""
    return isinstance(base(value.type), ir.FloatType | ir.DoubleType)


def is_bool(value: ir.Value) -> bool:
    """Return whether a value is a truth value."""
    return bool(base(value.type) == BOOL)


def constant(kind: ir.Type, number: float | int | bool) -> ir.Constant:
    """Return a number as a constant of a scalar or vector type."""
    if isinstance(base(kind), ir.IntType):
        return _constant(kind, int(number), "")
    plain = float(number)
    return _constant(kind, plain, "" if plain else repr(plain))


@cache
def _constant(kind: ir.Type, number: float, _: str) -> ir.Constant:
    """Return a constant, made and written once; the text tells -0 from 0."""
    return ir.Constant(kind, [number] * kind.count if isinstance(kind, ir.VectorType) else number)


class Emitter:
    """Writes instructions that several rules need."""

    def __init__(self, module: ir.Module, width: int) -> None:
        self.module, self.width = module, width
        self.b = ir.IRBuilder()
        self.flags: tuple[str, ...] = CONTRACT
        """Fast-math flags of sums, products and quotients."""
        self._splats: dict[tuple[ir.Block, ir.Value], ir.Value] = {}

    def vector(self, kind: ir.Type) -> ir.VectorType:
        """Return the type of a number for every lane."""
        return ir.VectorType(base(kind), self.width)

    def splat(self, value: ir.Value) -> ir.Value:
        """Return a value that all lanes share as a vector."""
        if is_vector(value):
            return value
        kind = self.vector(value.type)
        if isinstance(value, ir.Constant):
            return constant(kind, value.constant)
        where = self.b.block, value
        if where not in self._splats:
            undefined = ir.Constant(kind, ir.Undefined)
            first = self.b.insert_element(undefined, value, constant(ir.IntType(32), 0))
            zeros = constant(ir.VectorType(ir.IntType(32), self.width), 0)
            self._splats[where] = self.b.shuffle_vector(first, undefined, zeros)
        return self._splats[where]

    def alike(self, *values: ir.Value) -> tuple[ir.Value, ...]:
        """Return values all as vectors, if one is."""
        if any(map(is_vector, values)):
            return tuple(map(self.splat, values))
        return values

    def intrinsic(self, name: str, *operands: ir.Value) -> ir.Value:
        """Call an LLVM intrinsic overloaded by its operands' type."""
        kind = operands[0].type
        of_operands = ir.FunctionType(kind, [o.type for o in operands])
        function = self.declared(f"llvm.{name}.{mangled(kind)}", of_operands)
        fast = CONTRACT if is_float(operands[0]) else ()
        return self.b.call(function, operands, fastmath=fast)

    def fetch(self, pointer: ir.Value) -> None:
        """Ask for the memory at an address, which will be written to and need not exist."""
        whole, byte = ir.IntType(32), ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, whole, whole, whole])
        how = (constant(whole, n) for n in (1, 3, 1))  # to write, into the nearest cache, data
        function = self.declared("llvm.prefetch.p0", kind)
        self.b.call(function, [self.b.bitcast(pointer, byte), *how])

    def declared(self, name: str, kind: ir.FunctionType) -> ir.Function:
        """Return a function of a name, declared once."""
        known = self.module.globals.get(name)
        return known if known is not None else ir.Function(self.module, kind, name)

    def libm(self, name: str, *operands: ir.Value) -> ir.Value:
        """Call a function of the C library, lane by lane."""
        scalar = base(operands[0].type)
        symbol = name if isinstance(scalar, ir.DoubleType) else f"{name}f"
        function = self.declared(symbol, ir.FunctionType(scalar, [scalar] * len(operands)))
        return self.by_lane(lambda *lanes: self.b.call(function, lanes), *operands)

    def by_lane(self, function: Callable[..., ir.Value], *operands: ir.Value) -> ir.Value:
        """Apply a function of scalars to each lane."""
        if not is_vector(operands[0]):
            return function(*operands)
        result = None
        for lane in range(self.width):
            place = ir.Constant(ir.IntType(32), lane)
            value = function(*(self.b.extract_element(o, place) for o in operands))
            if result is None:
                result = ir.Constant(self.vector(value.type), ir.Undefined)
            result = self.b.insert_element(result, value, place)
        return result

    def any_lane(self, flag: ir.Value) -> ir.Value:
        """Return whether a truth value holds in any lane."""
        if not is_vector(flag):
            return flag
        bits = ir.IntType(self.width)
        return self.b.icmp_unsigned("!=", self.b.bitcast(flag, bits), ir.Constant(bits, 0))

    def number(self, like: ir.Value, value: float | int | bool) -> ir.Constant:
        """Return a constant of another value's type."""
        return constant(like.type, value)

    def select(self, flag: ir.Value, yes: ir.Value, no: ir.Value) -> ir.Value:
        """Choose; a shared flag chooses between vectors whole."""
        yes, no = self.alike(yes, no)
        if yes is no:
            return yes
        if is_vector(flag):
            flag, yes, no = self.alike(flag, yes, no)
        return self.b.select(flag, yes, no)

    def isnan(self, x: ir.Value) -> ir.Value:
        """Return whether a number is none."""
        return self.b.fcmp_unordered("uno", x, x)

    # indices

    def as_index(self, number: ir.Value) -> ir.Value:
        """Return a whole number as an index."""
        return converted(self, number, I64)

    def product_of(self, first: ir.Value, second: ir.Value) -> ir.Value:
        """Return a product of two indices, a constant if both are."""
        if isinstance(first, ir.Constant) and isinstance(second, ir.Constant):
            return constant(I64, first.constant * second.constant)
        return self.b.mul(first, second)

    def sum_of(self, first: ir.Value, second: ir.Value) -> ir.Value:
        """Return a sum of two indices, a constant if both are."""
        if isinstance(first, ir.Constant):
            if first.constant == 0:
                return second
            if isinstance(second, ir.Constant):
                return constant(I64, first.constant + second.constant)
        return self.b.add(first, second)

    def strides(
        self, lengths: Sequence[ir.Value], unit: ir.Value | None = None
    ) -> tuple[ir.Value, ...]:
        """Return the strides of an array whose last axis has a stride of ``unit``, or one."""
        stride = constant(I64, 1) if unit is None else unit
        found: list[ir.Value] = []
        for length in reversed(lengths):
            found.insert(0, stride)
            stride = self.product_of(stride, length)
        return tuple(found)

    # loops and branches

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

    def count(
        self, begin: ir.Value, end: ir.Value, step: int, body: Callable[[ir.Value], None]
    ) -> None:
        """Write a loop over numbers from one to before another."""

        def turn(carried: Sequence[ir.Value]) -> list[ir.Value]:
            body(carried[0])
            return [self.b.add(carried[0], constant(I64, step))]

        self.loop([begin], lambda carried: self.b.icmp_signed("<", carried[0], end), turn)


def mangled(kind: ir.Type) -> str:
    """Return a type as the names of intrinsics have it."""
    scalar = base(kind)
    if isinstance(scalar, ir.IntType):
        name = f"i{scalar.width}"
    else:
        name = "f64" if isinstance(scalar, ir.DoubleType) else "f32"
    return f"v{kind.count}{name}" if isinstance(kind, ir.VectorType) else name


def converted(e: Emitter, x: ir.Value, to: ir.Type) -> ir.Value:
    """Return a number in another type; a real number becomes whole as in XLA, saturating."""
    scalar = base(x.type)
    kind = e.vector(to) if is_vector(x) else to
    if scalar == to:
        found = x
    elif isinstance(to, ir.FloatType | ir.DoubleType):
        if is_float(x):
            cast = e.b.fpext if isinstance(to, ir.DoubleType) else e.b.fptrunc
        else:
            cast = e.b.uitofp if is_bool(x) else e.b.sitofp
        found = cast(x, kind)
    elif to == BOOL:
        compare = e.b.fcmp_unordered if is_float(x) else e.b.icmp_signed
        found = compare("!=", x, e.number(x, 0))
    elif is_float(x):
        name = f"llvm.fptosi.sat.{mangled(kind)}.{mangled(x.type)}"
        found = e.b.call(e.declared(name, ir.FunctionType(kind, [x.type])), [x])
    elif is_bool(x):
        found = e.b.zext(x, kind)
    else:
        found = (e.b.sext if to.width > scalar.width else e.b.trunc)(x, kind)
    return found


def bytes_of(kind: ir.Type) -> int:
    """Return how many bytes a number takes."""
    if isinstance(kind, ir.IntType):
        return int(kind.width) // 8
    return 8 if isinstance(kind, ir.DoubleType) else 4
