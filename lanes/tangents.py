"""Tangents as sums of others times factors that all columns share, in as few terms as can be.

Derivatives are linear: a column is computed by a graph of sums, from tangents in memory to those
that are wanted. A node is eliminated where its terms, put in where it is read, cost no more than it
saves (vertex elimination; Griewank and Walther, Evaluating Derivatives, ch. 9); products of factors
are then computed once, for all columns. A choice between a sum and zero is that sum with chosen
factors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeGuard

from llvmlite import ir

from lanes.emitter import constant, is_bool
from lanes.values import Element, Tangent

Factor: TypeAlias = "float | ir.Value | _Operation"
MAX_CHOSEN_TERMS = 6
"""Terms up to which a choice is made for each of a sum's."""


@dataclass(eq=False)
class _Operation:
    """A primitive of factors: ``mul``, ``add``, ``div`` of 1.0, or ``select_n``."""

    name: str
    operands: tuple[Any, ...]


def _is(factor: Factor, name: str) -> TypeGuard[_Operation]:
    return isinstance(factor, _Operation) and factor.name == name


def _chosen_between(which: ir.Value, first: Factor, second: Factor) -> Factor:
    return _Operation("select_n", (which, first, second))


def _times(x: Factor, y: Factor) -> Factor:
    if isinstance(x, float) and isinstance(y, float):
        return x * y
    if isinstance(y, float):
        x, y = y, x
    if isinstance(x, float):
        if x in (0.0, 1.0):
            return y if x else x
        if _is(y, "mul") and isinstance(y.operands[0], float):
            return _times(x * y.operands[0], y.operands[1])
    if _is(x, "select_n"):
        x, y = y, x
    if _is(y, "select_n") and 0.0 in y.operands[1:]:
        which, *cases = y.operands
        return _Operation("select_n", (which, *(_times(x, case) for case in cases)))
    return _Operation("mul", (x, y))


def _plus(x: Factor, y: Factor) -> Factor:
    if isinstance(x, float) and isinstance(y, float):
        return x + y
    return _Operation("add", (x, y))


_SIGNS: Mapping[str, Sequence[float]] = {
    "add": (1.0, 1.0),
    "add_any": (1.0, 1.0),
    "sub": (1.0, -1.0),
    "neg": (-1.0,),
    "copy": (1.0,),
}
"""Primitive -> the signs of its operands, where it is a sum."""


def _is_sign(factor: Factor) -> bool:
    return isinstance(factor, float) and abs(factor) == 1.0


@dataclass(eq=False)
class Node:
    """A number of a tangent: a sum, or the result of another primitive.

    Attributes
    ----------
    of
        The tangent, or an LLVM value that all columns share.
    terms
        Of a sum: node -> factor. None for other primitives.
    operands
        Of other primitives.
    readers
        The nodes that it is read by.
    kept
        Whether it is not eliminated.
    finite
        Whether it surely is, if the tangents in memory are.
    changed
        The elimination that last changed its terms, its readers or theirs, by number.
    """

    of: Any
    terms: dict[Node, Factor] | None = None
    operands: tuple[Any, ...] = ()
    readers: dict[Node, None] = field(default_factory=dict)
    kept: bool = False
    finite: bool = False
    changed: int = 0

    @property
    def kind(self) -> ir.Type:
        """The type of one lane's number."""
        return self.of.kind if isinstance(self.of, Tangent) else self.of.type

    @property
    def is_read(self) -> bool:
        """Whether it is a tangent in memory."""
        return isinstance(self.of, Tangent) and self.terms is None and self.of.is_read

    @property
    def has_column_flags(self) -> bool:
        """Whether it lies in memory that tells in which columns it moves."""
        return self.is_read and self.of.operands[0].moves is not None

    @property
    def sum(self) -> dict[Node, Factor]:
        """The terms of a sum."""
        assert self.terms is not None
        return self.terms


def _cost(terms: Mapping[Node, Factor]) -> int:
    """Return in how many operations terms are summed: a product and a sum are one."""
    return max(len(terms) - any(map(_is_sign, terms.values())), 0)


def _number(value: ir.Value) -> Factor:
    """Return a factor, as a number where it is a constant."""
    if isinstance(value, ir.Constant):
        given: Any = value.constant
        each = given if isinstance(given, list | tuple) else [given]
        numbers: set[Any] = {getattr(x, "constant", x) for x in each}
        if len(numbers) == 1 and isinstance(number := numbers.pop(), int | float):
            return float(number)
    return value


_CARRIED = frozenset({"phi", "load"})
_SUMS = frozenset({"fadd", "fsub", "fmul", "fneg", "select", "shufflevector", "insertelement"})
"""Instructions whose results are finite where their operands are."""


class _Finite:
    """Which factors are finite if values in memory and carried by loops are.

    Quotients by other than constants, roots and library functions may not be.
    """

    def __init__(self) -> None:
        self._known: dict[int, Any] = {}
        """Those that are, by their numbers."""

    def __call__(self, factor: Factor) -> bool:
        left: list[Any] = [factor]
        seen: dict[int, Any] = {}
        while left:
            made = left.pop()
            if isinstance(made, float | ir.Constant) or id(made) in self._known:
                continue
            name = getattr(made, "opname", None)
            if id(made) in seen or name in _CARRIED:
                continue
            seen[id(made)] = made
            if isinstance(made, _Operation) and made.name != "div":
                left += made.operands[-2:]
            elif name in _SUMS:
                left += [of for of in made.operands if not is_bool(of)]
            elif name == "fdiv" and isinstance(_number(made.operands[1]), float):
                left.append(made.operands[0])
            else:
                return False
        self._known |= seen
        return True


class Graph:
    """The sums that a column computes.

    Parameters
    ----------
    outs
        Wanted elements.
    shared_cost
        Cost of an operation on factors, over that of one in each column.
    finite
        Whether all factors are known to be finite, those of choices that are not taken too.
    """

    def __init__(
        self, outs: Sequence[Element], *, shared_cost: float = 0.1, finite: bool = False
    ) -> None:
        self._shared_cost, self._all_finite = shared_cost, finite
        needed: dict[int, Tangent] = {}
        left = [x for x in outs if isinstance(x, Tangent)]
        while left:
            tangent = left.pop()
            if tangent.number not in needed:
                needed[tangent.number] = tangent
                left += [x for x in tangent.operands if isinstance(x, Tangent)]
        self.nodes: list[Node] = []
        self._plain: dict[int, Node] = {}
        self._known: dict[Any, Node] = {}
        self._found: dict[int, Node] = {}
        self._is_finite = _Finite()
        self._eliminations = 0
        for number in sorted(needed):
            self._found[number] = self._node(needed[number])
        self.outs = [self._of(x) for x in outs]
        for node in self.outs:
            node.kept = True
        self._drop_unread()
        self._eliminate()

    def _of(self, x: Element) -> Node:
        if isinstance(x, Tangent):
            return self._found[x.number]
        if id(x) not in self._plain:
            self._plain[id(x)] = Node(x, kept=True, finite=self._all_finite)
            self.nodes.append(self._plain[id(x)])
        return self._plain[id(x)]

    def _node(self, tangent: Tangent) -> Node:
        given = self._terms(tangent)
        if given is None:
            operands = tuple(self._of(x) if isinstance(x, Tangent) else x for x in tangent.operands)
            key: Any = (tangent.name, *map(id, operands))
            if key in self._known and (tangent.is_read or not tangent.params):
                return self._known[key]
            chosen = tangent.name == "select_n" and all(
                x.finite if isinstance(x, Node) else isinstance(x, ir.Constant)
                for x in operands[1:]
            )
            finite = self._all_finite or tangent.is_read or chosen
            node = Node(tangent, None, operands, kept=True, finite=finite)
            self._known[key] = node
            for operand in operands:
                if isinstance(operand, Node):
                    operand.readers[node] = None
        else:
            terms: dict[Node, Factor] = {}
            for x, factor in given:
                if _is_zero(x):
                    continue
                node = x if isinstance(x, Node) else self._of(x)
                if node.terms != {}:
                    _add(terms, node, factor)
            if len(terms) == 1 and 1.0 in terms.values():
                return next(iter(terms))
            key = (
                "sum",
                *sorted((id(n), f if isinstance(f, float) else id(f)) for n, f in terms.items()),
            )
            if key in self._known:
                return self._known[key]
            finite = self._all_finite or all(
                of.finite and self._is_finite(factor) for of, factor in terms.items()
            )
            node = Node(tangent, terms, finite=finite)
            self._known[key] = node
            for operand in terms:
                operand.readers[node] = None
        self.nodes.append(node)
        return node

    def _terms(self, tangent: Tangent) -> Sequence[tuple[Any, Factor]] | None:
        """Return the terms of a tangent that is a sum; else None."""
        name, operands = tangent.name, tangent.operands
        moving = [isinstance(x, Tangent) for x in operands]
        found: Sequence[tuple[Any, Factor]] | None = None
        if name == "select_n" and moving == [False, True, True]:
            found = self._chosen(*operands)
        elif name == "select_n" and _is_zero(operands[1 + moving[1]]):
            found = self._left_out(*operands)
        elif name in _SIGNS:
            found = list(zip(operands, _SIGNS[name], strict=True))
        elif name == "convert_element_type" and operands[0].kind == tangent.kind:
            found = [(operands[0], 1.0)]
        elif name == "mul" and not all(moving):
            x, y = operands if moving[0] else reversed(operands)
            found = [(x, _number(y))]
        elif name == "div" and not moving[1]:
            by = _number(operands[1])
            found = [
                (
                    operands[0],
                    1.0 / by if isinstance(by, float) and by else _Operation("div", (1.0, by)),
                )
            ]
        return found

    def _chosen(self, which: ir.Value, *either: Tangent) -> Sequence[tuple[Any, Factor]] | None:
        """Return a choice between multiples of one number as that number times a chosen factor.

        One between others stays a choice: the other one may be NaN.
        """
        parts: list[tuple[Node, Factor]] = []
        for node in map(self._of, either):
            single = node.terms is not None and len(node.terms) == 1
            parts += node.sum.items() if single else [(node, 1.0)]
        (of, factor), (other, own) = parts
        if of is other:
            return [(of, _chosen_between(which, factor, own))]
        if self._all_finite or (of.has_column_flags and other.has_column_flags):
            return [
                (of, _chosen_between(which, factor, 0.0)),
                (other, _chosen_between(which, 0.0, own)),
            ]
        return None

    def _left_out(self, which: ir.Value, *either: Element) -> Sequence[tuple[Any, Factor]] | None:
        """Return a choice between a sum and zero as that sum with factors that are chosen.

        Zero times NaN is NaN: the terms must be finite.
        """
        first_moves = isinstance(either[0], Tangent)
        left: list[tuple[Node, Factor]] = [(self._of(either[0 if first_moves else 1]), 1.0)]
        parts: dict[Node, Factor] = {}
        while left:
            node, factor = left.pop()
            if node.finite:
                _add(parts, node, factor)
            elif node.terms is None or len(left) + len(parts) > MAX_CHOSEN_TERMS:
                return None
            else:
                left += [(of, _times(factor, own)) for of, own in node.terms.items()]
        return [
            (of, _chosen_between(which, *((factor, 0.0) if first_moves else (0.0, factor))))
            for of, factor in parts.items()
        ]

    def _drop_unread(self) -> None:
        """Drop sums that choices have put in where they were read."""
        for node in reversed(self.nodes):
            if node.terms and not node.readers and not node.kept:
                for operand in node.sum:
                    operand.readers.pop(node)
                node.terms = {}

    def _eliminate(self) -> None:
        """Eliminate nodes, alone and together with those that the same nodes read.

        What was refused is tried again once it, or what reads it, has changed.
        """
        refused: dict[tuple[Node, ...], int] = {}

        def is_eliminated(*nodes: Node) -> bool:
            last = refused.get(nodes, -1)
            if all(node.changed <= last for node in nodes):
                return False
            if self._eliminate_nodes(nodes):
                return True
            refused[nodes] = self._eliminations
            return False

        changed = True
        while changed:
            changed = False
            for node in reversed(self.nodes):
                changed |= is_eliminated(node)
            together: dict[frozenset[Node], list[Node]] = {}
            for node in self.nodes:
                together.setdefault(frozenset(node.readers), []).append(node)
            for nodes in together.values():
                if len(nodes) > 1:
                    changed |= is_eliminated(*nodes)
        self.nodes = [n for n in self.nodes if n.kept or n.terms is None or n.readers]
        self._order()

    def _order(self) -> None:
        """Put terms that are computed late last in their sums."""
        known: dict[Node, int] = {}
        for node in self.nodes:
            if node.terms is None:
                given = [known[x] for x in node.operands if isinstance(x, Node)]
                known[node] = max(given, default=-1) + 1
                continue
            ready = 0
            rows = sorted(node.terms.items(), key=lambda row: (known[row[0]], row[1] != 1.0))
            for operand, _ in rows:
                ready = max(ready, known[operand]) + 1
            node.terms, known[node] = dict(rows), ready

    def _eliminate_nodes(self, nodes: Sequence[Node]) -> bool:
        """Put nodes' terms in where they are read, if that saves something."""
        nodes = [
            n
            for n in nodes
            if n.terms and n.readers and not n.kept and all(r.terms is not None for r in n.readers)
        ]
        own = set(nodes)
        readers = {
            reader: dict(reader.sum) for n in nodes for reader in n.readers if reader not in own
        }
        if not readers or any(own & set(n.readers) for n in nodes):
            return False
        change, shared = -sum(_cost(n.sum) for n in nodes), 0
        for reader, terms in readers.items():
            for node in nodes:
                if node not in terms:
                    continue
                factor = terms.pop(node)
                for operand, each in node.sum.items():
                    shared += (not _is_sign(each) and not _is_sign(factor)) + (operand in terms)
                    _add(terms, operand, _times(factor, each))
            change += _cost(terms) - _cost(reader.sum)
        if change + self._shared_cost * shared > 0:
            return False
        self._eliminations += 1
        touched = [*nodes, *readers]
        for node in nodes:
            for operand in node.sum:
                operand.readers.pop(node)
            touched += node.sum
            node.terms, node.readers = {}, {}
        for reader, terms in readers.items():
            for operand in reader.sum:
                operand.readers.pop(reader, None)
            touched += reader.sum
            reader.terms = terms
            for operand in terms:
                operand.readers[reader] = None
        for node in touched:
            node.changed = self._eliminations
        return True


def _is_zero(x: Any) -> bool:
    return isinstance(x, ir.Value) and _number(x) == 0.0


def _add(terms: dict[Node, Factor], node: Node, factor: Factor) -> None:
    total = _plus(terms[node], factor) if node in terms else factor
    if isinstance(total, float) and total == 0.0:
        terms.pop(node, None)
    else:
        terms[node] = total


class Factors:
    """Writes factors down before the columns are computed, each once."""

    def __init__(self, apply: Callable[..., ir.Value]) -> None:
        self._apply = apply
        self._known: dict[int, ir.Value] = {}

    def of(self, factor: Factor, kind: ir.Type) -> ir.Value:
        """Return a factor's value."""
        if isinstance(factor, float):
            return constant(kind, factor)
        if isinstance(factor, ir.Value):
            return factor
        if id(factor) not in self._known:
            operands = [self.of(x, kind) for x in factor.operands]
            self._known[id(factor)] = self._apply(factor.name, {}, *operands)
        return self._known[id(factor)]
