"""A loop over the columns of tangents, in which a graph of sums is computed.

What columns share is computed before it (`factors_of`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from functools import partial
from typing import Any

from llvmlite import ir

from lanes.emitter import CONTRACT, I64, LINEAR, Emitter, constant
from lanes.memory_access import MemoryAccess
from lanes.rules import apply
from lanes.tangents import Factor, Factors, Graph, Node
from lanes.values import Tangent

MIN_SKIPPED_SUMS = 2
"""Sums from which it is asked whether a number moves before it is added to them."""


def factors_of(emitter: Emitter, graph: Graph) -> dict[Any, ir.Value]:
    """Compute the factors of a graph's sums, which all columns share."""
    factors = Factors(partial(apply, emitter))
    return {
        (node, operand): factors.of(factor, node.kind)
        for node in graph.nodes
        if node.terms is not None
        for operand, factor in node.terms.items()
    }


class ColumnLoop:
    """Writes a loop that computes a graph column by column.

    Parameters
    ----------
    memory
        Reads tangents that lie in memory.
    graph, factors
        The sums, and their factors' values.
    """

    def __init__(self, memory: MemoryAccess, graph: Graph, factors: Mapping[Any, ir.Value]) -> None:
        self.memory, self.e, self.graph, self.factors = memory, memory.e, graph, factors

    def write(self, hand_on: Sequence[Callable[[ir.Value], None]], columns: ir.Value) -> None:
        """Write the loop over so many columns; it hands the graph's outputs on."""

        def of_column(number: ir.Value) -> None:
            self.memory.column, self.e.flags = number, LINEAR
            found = self._numbers()
            self.e.flags = CONTRACT
            for hand, node in zip(hand_on, self.graph.outs, strict=True):
                hand(found[node])
            self.memory.column = None

        self.e.count(constant(I64, 0), columns, 1, of_column)

    def _numbers(self) -> dict[Node, ir.Value]:
        """Compute the numbers of all nodes in one column."""
        found: dict[Node, ir.Value] = {}
        begun = self._begun()
        for node in self.graph.nodes:
            if node.terms is not None:
                found[node] = self._sum_of(node, found, *begun.get(node, ()))
            elif not isinstance(node.of, Tangent):
                found[node] = node.of
            elif node.is_read:
                found[node] = self.memory.read_tangent(node.of)
            else:
                given = (found[x] if isinstance(x, Node) else x for x in node.operands)
                found[node] = apply(self.e, node.of.name, node.of.params, *given)
        return found

    def _begun(self) -> dict[Node, tuple[ir.Value, Set[Node]]]:
        """Begin sums with the terms that move in few columns; return the sums and those terms.

        Where it does not move in a column, nothing is computed of it there.
        """
        begun: dict[Node, tuple[ir.Value, Set[Node]]] = {}
        for node in self.graph.nodes:
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
                        (self.memory.read_tangent(first.of), {first})
                        if ready
                        else (constant(self.e.vector(node.kind), 0.0), set())
                    )
            place = self.e.b.gep(node.of.operands[0].moves, [self.memory.column])
            moves = self.e.b.icmp_unsigned("!=", self.e.b.load(place), constant(ir.IntType(8), 0))
            before = self.e.b.block
            with self.e.b.if_then(moves):
                number, inside = self.memory.read_tangent(node.of), self.e.b.block
                totals = [
                    self._plus(
                        begun[reader][0], number, reader.sum[node], self.factors[reader, node]
                    )
                    for reader in sums
                ]
            for reader, total in zip(sums, totals, strict=True):
                old, held = begun[reader]
                new = self.e.b.phi(total.type)
                new.add_incoming(old, before)
                new.add_incoming(total, inside)
                begun[reader] = new, {*held, node}
        return begun

    def _sum_of(
        self,
        node: Node,
        numbers: Mapping[Node, ir.Value],
        total: ir.Value | None = None,
        held: Set[Node] = frozenset(),
    ) -> ir.Value:
        """Return a sum of numbers times factors, of which some are in a total."""
        for operand, factor in node.sum.items():
            if operand not in held:
                total = self._plus(total, numbers[operand], factor, self.factors[node, operand])
        return constant(node.kind, 0.0) if total is None else total

    def _plus(
        self, total: ir.Value | None, number: ir.Value, factor: Factor, value: ir.Value
    ) -> ir.Value:
        """Return a total and a number times a factor, which has a value."""
        if factor == -1.0 and total is not None:
            return apply(self.e, "sub", {}, total, number)
        part = number if factor == 1.0 else apply(self.e, "mul", {}, number, value)
        return part if total is None else apply(self.e, "add", {}, total, part)
