"""A function of one lane as a program for many: built once, run in blocks on several threads."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from itertools import compress, pairwise
from math import lcm, prod
from threading import Lock
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval
from jax.tree_util import PyTreeDef, default_registry
from numpy.typing import NDArray

import lanes.control
import lanes.structural  # noqa: F401 (both fill in rules)
from lanes.dependence import dependent
from lanes.layout import Argument, Lengths, is_laid_by_loop, module_text
from lanes.machine import (
    LoadedFunction,
    UnknownError,
    digest_of,
    is_kept,
    keep_code_in,
    load_or_make,
    object_code,
    optimises,
    register_bytes,
)
from lanes.memory_access import LINE_BYTES, MAX_COLUMNS
from lanes.values import UnsupportedError

__all__ = ["Argument", "Program", "ProgramResults", "joined", "keep_code_in", "program_of"]

logger = logging.getLogger(__name__)

_STAND_INS = (
    1_000_003, 1_000_033, 1_000_037, 1_000_039, 1_000_081, 1_000_099, 1_000_117, 1_000_121,
    1_000_133, 1_000_151, 1_000_159, 1_000_171, 1_000_183, 1_000_187, 1_000_193, 1_000_199,
)  # fmt: skip
"""Lengths under which a function is traced; no number of a program is likely to be one of them."""
BUILD_EVENT = "/lanes/build_duration"
"""The event of `jax.monitoring` at the end of building a kernel, once it is traced."""
FALLBACK_EVENT = "/lanes/fallback"
"""The event of a program that has no kernel, with the reason."""
TASKS_PER_CORE = 4
"""Pieces of work a core: their sizes differ."""
MAX_EMPTY_LANES = 0.15
"""Share of lanes left empty from which blocks take several turns of columns."""
MAX_REPEATED_BYTES = 2**27
"""bytes of arguments up to which they are laid out once for every pass."""
MAX_LANES_COPIED_SINGLY = 64
"""Lanes up to which they are copied one after the other."""
CACHE_BYTES = 2**18
"""bytes that are laid out at a time."""
MIN_STEPS_OF_TWO_VECTORS = 2**22
"""Lanes times turns from which a block without columns is two vectors wide, where LLVM optimises:
one computes while one waits. Fewer take less time than another kernel's compilation."""
FEW_LANES_BYTES = 32
"""bytes of a vector for few lanes: in wider ones, empty lanes would take memory and time."""
COLUMNS_OF_VALUES = 3
"""Columns that take as long as the values and the factors that columns share."""
MAX_BLOCKS_ON_ONE_THREAD = 512
"""Blocks without a loop that are computed sooner than another thread begins."""


@dataclass(frozen=True)
class ProgramResults:
    """Results of a program.

    Attributes
    ----------
    values
        The function's outputs, a pytree; leaves (lanes, \\*shape).
    columns
        Their derivatives along the Q tangents, leaves (lanes, \\*shape, Q). Those of an output
        whose first axis is a loop's are left as they were laid, (lanes, Q, turns, \\*rest): see
        `joined`. None for an output that does not move, and if nothing moves.
    """

    values: Any
    columns: Any


def joined(columns: NDArray[Any]) -> NDArray[Any]:
    """Return derivatives that lie one after the other, (lanes, Q, ...), side by side."""
    return np.moveaxis(columns, 1, -1)


Function: TypeAlias = Callable[[Any, Lengths], Any]


def program_of(
    function: Callable[..., Any], arguments: Any, *static: Hashable, **options: Any
) -> Program:
    """Return a program, the same one wherever the same is asked for.

    Parameters
    ----------
    function
        As of `Program`, of all that is static before the arguments and lengths.
    arguments
        As of `Program`.
    options
        Those of `Program`, hashable.
    """
    leaves, structure = jax.tree.flatten(arguments, is_leaf=lambda a: isinstance(a, Argument))
    return _program_of(function, tuple(leaves), structure, static, tuple(options.items()))


@lru_cache(maxsize=128)
def _program_of(
    function: Callable[..., Any],
    leaves: tuple[Argument, ...],
    structure: Any,
    static: tuple[Hashable, ...],
    options: tuple[tuple[str, Any], ...],
) -> Program:
    arguments = jax.tree.unflatten(structure, leaves)
    program = Program(partial(function, *static), arguments, **dict(options))
    program.made_by = partial(program_of, **dict(options)), (function, arguments, *static)
    return program


class Program:
    """A function of one lane, compiled for many.

    Parameters
    ----------
    function
        Takes a pytree of arrays, as one lane has them, and the lengths by name; returns a pytree of
        arrays. It must be traceable and forward-differentiable by jax.
    arguments
        Pytree of `Argument`, of the structure that ``function`` takes.
    name
        For messages.
    made_of
        All that the function is made of besides its arguments' layout and the code of
        ``packages``: a program that is kept is then not traced again. None traces it.
    packages
        Whose code it runs.
    few_lanes
        Whether vectors are at most `FEW_LANES_BYTES` wide, as lanes do not fill wider ones.
    """

    def __init__(
        self,
        function: Function,
        arguments: Any,
        *,
        name: str = "",
        made_of: Any = None,
        packages: tuple[str, ...] = (),
        few_lanes: bool = False,
    ) -> None:
        self.function, self.name = function, name or getattr(function, "__name__", "function")
        leaves, structure = jax.tree.flatten(
            arguments, is_leaf=lambda leaf: isinstance(leaf, Argument)
        )
        self.structure: Any = structure
        # in the precision that jax computes in
        self.arguments: tuple[Argument, ...] = tuple(
            replace(a, dtype=jax.dtypes.canonicalize_dtype(a.dtype)) for a in leaves
        )
        self.moving = tuple(number for number, a in enumerate(leaves) if a.moves)
        names = {length for a in leaves for length in a.shape if isinstance(length, str)}
        self.names = tuple(sorted(names))
        widest = FEW_LANES_BYTES if few_lanes else register_bytes()
        self.vector_bytes = min(register_bytes(), widest)
        self._kernels: dict[int, _Compiled | None] = {}
        self._builds = Lock()
        #: Of `program_of`: what makes it again in another process, and its arguments.
        self.made_by: tuple[Callable[..., Program], tuple[Any, ...]] | None = None
        self.key: str | None = None
        if made_of is not None:
            with suppress(UnknownError):
                self.key = digest_of((made_of, arguments), packages)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what `program_of` was given, without kernels."""
        if self.made_by is None:
            raise TypeError(f"{self.name} is a program of this process alone")
        return self.made_by

    def _with_tangents(self, lengths: Lengths) -> Callable[..., Any]:
        """Return the function of flat arguments and tangents, or of arguments alone."""

        def flown(*leaves: Any) -> Any:
            return self.function(jax.tree.unflatten(self.structure, leaves), lengths)

        def with_tangents(leaves: Sequence[Any], tangents: Sequence[Any]) -> Any:
            def of_moving(*moved: Any) -> Any:
                whole = list(leaves)
                for number, leaf in zip(self.moving, moved, strict=True):
                    whole[number] = leaf
                return flown(*whole)

            given = [leaves[number] for number in self.moving]
            found, moved = jax.jvp(of_moving, given, list(tangents))
            # integers and truth values have no derivative
            return found, jax.tree.map(
                lambda t: jnp.zeros(()) if t.dtype == jax.dtypes.float0 else t, moved
            )

        if not self.moving:
            return lambda leaves, _: flown(*leaves)
        return with_tangents

    @cached_property
    def _traced(self) -> tuple[Any, Any, dict[str, int]]:
        """The jaxpr, the structure of its outputs, and the stand-ins of lengths."""
        lengths = self.stand_ins
        given = [
            jax.ShapeDtypeStruct(
                [lengths[n] if isinstance(n, str) else n for n in a.shape], a.dtype
            )
            for a in self.arguments
        ]
        tangents = [given[number] for number in self.moving]
        closed, shapes = jax.make_jaxpr(self._with_tangents(lengths), return_shape=True)(
            given, tangents
        )
        return closed, shapes, lengths

    @property
    def stand_ins(self) -> dict[str, int]:
        """Name -> the number that stands for each length while it is traced."""
        return dict(zip((*self.names, "turns"), _STAND_INS, strict=False))

    def build(self) -> None:
        """Have the kernel for few lanes, on disk if such are kept."""
        self._kernel()

    @property
    def is_kept(self) -> bool:
        """Whether the kernel for few lanes is on disk, from where other processes have it."""
        return self.key is not None and is_kept(self._key_of(1))

    def _key_of(self, vectors: int) -> str:
        return f"{self.key} {self._width(vectors)}"

    def _width(self, vectors: int) -> int:
        """Return how many lanes blocks of so many vectors have."""
        widest = max(
            (
                np.dtype(a.dtype).itemsize
                for a in self.arguments
                if np.issubdtype(a.dtype, np.floating)
            ),
            default=8,
        )
        return max(vectors * self.vector_bytes // widest, 1)

    def _kernel(self, steps: int = 1) -> _Compiled | None:
        """Return the kernel for so many lanes times turns; None where something has no rule."""
        vectors = 2 if steps >= MIN_STEPS_OF_TWO_VECTORS and not self.moving and optimises() else 1
        with self._builds:
            if vectors not in self._kernels:
                self._kernels[vectors] = None
                try:
                    self._kernels[vectors] = _Compiled(self, vectors)
                except UnsupportedError as missing:
                    logger.debug("%s runs through XLA: no rule for %s", self.name, missing)
                    what = f"{self.name}: no rule for {missing}"
                    jax.monitoring.record_event_duration_secs(FALLBACK_EVENT, 0.0, fun_name=what)
            return self._kernels[vectors]

    @property
    def is_kernel(self) -> bool:
        """Whether it runs as a kernel; else through XLA."""
        return self._kernel() is not None

    def __call__(
        self,
        values: Any,
        tangents: Any = None,
        *,
        lanes: int,
        turns: int = 0,
        wanted: Any = None,
    ) -> ProgramResults:
        """Run.

        Parameters
        ----------
        values
            Pytree of arrays: (\\*shape, lanes) where each lane has its own, (lanes, \\*shape) where
            those lie apart, else (\\*shape).
        tangents
            Of the arguments that move, in the order of their leaves: (Q, \\*shape) each. None,
            or Q = 0, computes values alone.
        lanes
            How many there are.
        turns
            The length named ``turns``, of loops.
        wanted
            Pytree of truth values, one an output, with those of the columns behind the values' if
            there are tangents: None stands for one that is not. All by default.
        """
        leaves = [
            np.asarray(leaf, a.dtype)
            for leaf, a in zip(self.structure.flatten_up_to(values), self.arguments, strict=True)
        ]
        if tangents and not len(tangents[0]):
            tangents = None
        moved = [np.asarray(t, float) for t in (tangents or [])]
        lengths = self._lengths(leaves, turns)
        kernel = self._kernel(lanes * max(turns, 1))
        if kernel is None:
            return self.by_xla(values, tangents, turns=turns)
        return kernel.run(leaves, moved, lengths, lanes, wanted)

    def _lengths(self, leaves: Sequence[NDArray[Any]], turns: int) -> dict[str, int]:
        lengths = {"turns": turns}
        for leaf, argument in zip(leaves, self.arguments, strict=True):
            for axis, length in enumerate(argument.shape):
                if isinstance(length, str):
                    own = leaf.shape[axis + argument.apart]
                    given = lengths.setdefault(length, own)
                    if given != own:
                        raise ValueError(f"{length} is {given} and {own}")
        return lengths

    def by_xla(self, values: Any, tangents: Any = None, *, turns: int = 0) -> ProgramResults:
        """Compute the same through `jax.vmap` and XLA; tests compare kernels with it."""
        leaves = [jnp.asarray(leaf) for leaf in self.structure.flatten_up_to(values)]
        lengths = self._lengths([np.asarray(leaf) for leaf in leaves], turns)
        if tangents and not len(tangents[0]):
            tangents = None
        run = self._xla(tuple(sorted(lengths.items())))
        if not self.moving:
            return ProgramResults(jax.tree.map(np.asarray, run(leaves, [])), None)
        shape = {number: self.arguments[number].shape for number in self.moving}
        moved = tangents or [np.zeros((1, *shape[number])) for number in self.moving]
        found, columns = run(leaves, [jnp.asarray(t) for t in moved])
        if not tangents:
            return ProgramResults(jax.tree.map(np.asarray, found), None)
        _, (shapes, _), stand_ins = self._traced

        def laid(leaf: Any, shape: Any) -> NDArray[Any]:
            return np.moveaxis(np.asarray(leaf), 0, 1 if is_laid_by_loop(shape, stand_ins) else -1)

        return ProgramResults(jax.tree.map(np.asarray, found), jax.tree.map(laid, columns, shapes))

    def _xla(self, lengths: tuple[tuple[str, int], ...]) -> Callable[..., Any]:
        known: dict[Any, Callable[..., Any]] = self.__dict__.setdefault("_programs", {})
        if lengths not in known:
            axes = [(0 if a.apart else -1) if a.lanes else None for a in self.arguments]
            with_tangents = self._with_tangents(dict(lengths))
            by_lane = jax.vmap(with_tangents, in_axes=(axes, None))
            if self.moving:
                out = (None, 0)
                by_lane = jax.vmap(by_lane, in_axes=(None, 0), out_axes=out)
            known[lengths] = jax.jit(by_lane)
        return known[lengths]


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="lanes")


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


class _Compiled:
    """The kernel of a program, for blocks of lanes so many vectors wide."""

    def __init__(self, program: Program, vectors: int) -> None:
        self.program, self.lengths = program, program.stand_ins
        self.width = program._width(vectors)
        self.structure: Any
        self.outputs: list[jax.ShapeDtypeStruct]
        self.moved: list[bool]
        if program.key is None:
            self.structure, self.outputs, self.moved, code = self._build()
        else:
            kept = load_or_make(program._key_of(vectors), self._to_keep)
            head, _, code = kept.partition(b"\n")
            known = json.loads(head)
            self.structure = PyTreeDef.deserialize_using_proto(
                default_registry, bytes.fromhex(known["structure"])
            )
            self.outputs = [
                jax.ShapeDtypeStruct(tuple(shape), dtype) for shape, dtype in known["outputs"]
            ]
            self.moved = known["moved"]
        #: of the values alone
        self._values = self.structure.children()[0] if program.moving else self.structure
        self.code = LoadedFunction(code, "run")
        void, whole = ctypes.c_void_p, ctypes.c_int64
        self.function = ctypes.CFUNCTYPE(None, *[void] * 5, *[whole] * 6)(self.code.address)

    def _build(self) -> tuple[Any, list[jax.ShapeDtypeStruct], list[bool], bytes]:
        """Return the structure and shapes of the outputs, which of them move, and object code."""
        program = self.program
        closed, shapes, lengths = program._traced
        outputs, structure = jax.tree.flatten(shapes)
        flags = [False] * len(program.arguments) + [True] * len(program.moving)
        moved = [bool(moves) for moves in dependent(closed.jaxpr, flags)]
        kept = _kept(program, moved)
        # unread results of loops are not lowered and need no rule
        jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, kept, instantiate=True)
        began = time.perf_counter()
        text = module_text(
            closed.replace(jaxpr=jaxpr),
            self.width,
            arguments=program.arguments,
            moving=program.moving,
            lengths=lengths,
            outputs=list(compress(outputs, kept)),
            moved=list(compress(moved, kept)),
        )
        code = object_code(text)
        spent = time.perf_counter() - began
        jax.monitoring.record_event_duration_secs(BUILD_EVENT, spent, fun_name=program.name)
        # tens of megabytes that a kernel has no use for
        program.__dict__.pop("_traced", None)
        return structure, outputs, moved, code

    def _to_keep(self) -> bytes:
        """Return the object code behind a line that describes its outputs."""
        structure, outputs, moved, code = self._build()
        head = {
            "structure": structure.serialize_using_proto().hex(),
            "outputs": [(shape.shape, str(shape.dtype)) for shape in outputs],
            "moved": moved,
        }
        return json.dumps(head).encode() + b"\n" + code

    def run(
        self,
        leaves: Sequence[NDArray[Any]],
        tangents: Sequence[NDArray[Any]],
        lengths: Mapping[str, int],
        lanes: int,
        wanted: Any = None,
    ) -> ProgramResults:
        """Compute all lanes and columns."""
        program, width = self.program, self.width
        count = len(tangents[0]) if tangents else 0
        columns = max(count, 1)
        tables = sum(
            leaf.nbytes
            for leaf, a in zip(leaves, program.arguments, strict=True)
            if a.lanes and not a.apart
        )
        own_lanes, each, blocks = min(
            (
                _block_layout(lanes, width, columns, each, tables)
                for each in range(1, MAX_COLUMNS + 1)
            ),
            key=lambda laid: (-(-laid[2] // _cores()) * (COLUMNS_OF_VALUES + laid[1]), laid[2]),
        )
        place = np.arange(blocks * width)
        # lanes and columns that fill a block repeat others
        segment = np.minimum(place % own_lanes, lanes - 1)
        turn = np.minimum(place // own_lanes * each, columns - each)
        own_blocks = min(lcm(own_lanes, width) // width, blocks)
        taken = segment[: own_blocks * width]
        given = [
            _side_by_side(leaf, taken, lanes)
            if a.lanes and not a.apart
            else np.ascontiguousarray(leaf)
            for leaf, a in zip(leaves, program.arguments, strict=True)
        ]
        begins = turn[::own_lanes] + np.arange(each)[:, None]
        for number, t in zip(program.moving if tangents else (), tangents, strict=True):
            rows = np.moveaxis(t.astype(program.arguments[number].dtype)[begins], 1, -1)
            repeated = np.repeat(rows, own_lanes, axis=-1)[..., : len(place)]
            given.append(np.ascontiguousarray(repeated))
        sizes = {stand_in: lengths[name] for name, stand_in in self.lengths.items()}
        structure = self.structure if tangents else self._values
        asked = [True] * structure.num_leaves if wanted is None else structure.flatten_up_to(wanted)
        asked += [False] * (len(self.outputs) - len(asked))
        found: list[Any] = []
        for shape, moved, is_wanted in zip(self.outputs, self.moved, asked, strict=True):
            if not is_wanted:
                found.append(None)
                continue
            own = tuple(sizes.get(n, n) for n in shape.shape)
            if moved:
                own = (columns, *own)
            found.append(_on_whole_lines((lanes, *own), shape.dtype))
        ins = _addresses(given, len(program.arguments) + len(program.moving))
        outs = _addresses(list(compress(found, _kept(program, self.moved))))
        values = (ctypes.c_int64 * max(len(self.lengths), 1))(
            *[lengths[name] for name in self.lengths]
        )
        turn = np.ascontiguousarray(turn)

        def work(task: tuple[int, int]) -> None:
            self.function(
                ins,
                outs,
                values,
                segment.ctypes.data,
                turn.ctypes.data,
                len(place),
                own_blocks,
                count,
                min(each, count),
                *task,
            )

        pieces = (
            min(blocks, TASKS_PER_CORE * _cores())
            if lengths["turns"] or blocks > MAX_BLOCKS_ON_ONE_THREAD
            else 1
        )
        bounds = [blocks * number // pieces for number in range(pieces + 1)]
        tasks = list(pairwise(bounds))
        if len(tasks) == 1:
            work(tasks[0])
        else:
            list(_threads().map(work, tasks))
        half = self._values.num_leaves
        results = jax.tree.unflatten(self._values, found[:half])
        if not tangents:
            return ProgramResults(results, None)
        by_column = [
            None
            if not moved or array is None
            else array
            if is_laid_by_loop(shape, self.lengths)
            else joined(array)
            for array, moved, shape in zip(
                found[half:], self.moved[half:], self.outputs[half:], strict=True
            )
        ]
        return ProgramResults(results, jax.tree.unflatten(self._values, by_column))


def _on_whole_lines(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Return an uninitialised array that begins with a line of the cache."""
    size = prod(shape) * np.dtype(dtype).itemsize
    memory = np.empty(size + LINE_BYTES, np.uint8)
    first = -memory.ctypes.data % LINE_BYTES
    found: NDArray[Any] = memory[first : first + size].view(dtype).reshape(shape)
    return found


def _block_layout(
    lanes: int, width: int, columns: int, each: int, tables: int
) -> tuple[int, int, int]:
    """Return after how many lanes the next columns begin, how many a block takes, and its number.

    Each lane takes some columns over what is its own: few segments fill a block with several turns
    of columns, many have a block for themselves and another one for each turn.
    """
    each = min(each, columns)
    turns = -(-columns // each)
    own = -(-lanes // width) * width
    if turns > 1 and own - lanes > MAX_EMPTY_LANES * lanes and tables * turns <= MAX_REPEATED_BYTES:
        own = lanes
    return own, each, -(-own * turns // width)


def _side_by_side(leaf: NDArray[Any], taken: NDArray[np.intp], lanes: int) -> NDArray[Any]:
    """Return an array whose last axis holds the lanes of all blocks."""
    if len(taken) == lanes:
        return np.ascontiguousarray(leaf)
    if lanes > MAX_LANES_COPIED_SINGLY or leaf.ndim == 1:
        return np.ascontiguousarray(leaf[..., taken])
    laid = np.empty((*leaf.shape[:-1], len(taken)), leaf.dtype)
    rows = max(CACHE_BYTES // max(laid[:1].nbytes, 1), 1)
    for first in range(0, len(laid), rows):
        some = slice(first, first + rows)
        for place, lane in enumerate(taken.tolist()):
            laid[some, ..., place] = leaf[some, ..., lane]
    return laid


def _kept(program: Program, moved: Sequence[bool]) -> list[bool]:
    """Return which results a kernel computes: values, and tangents that move."""
    values = len(moved) // 2 if program.moving else len(moved)
    return [True] * values + list(moved[values:])


def _addresses(arrays: Sequence[NDArray[Any] | None], count: int = 1) -> Any:
    """Return a table of addresses, of ``count`` at least; the others lead nowhere."""
    pointers = [None if a is None else a.ctypes.data for a in arrays]
    return (ctypes.c_void_p * max(len(arrays), count, 1))(*pointers)
