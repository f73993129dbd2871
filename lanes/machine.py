"""LLVM on this machine: modules into object code, cached on disk by content, and keys for it.

A function that jax traces is determined by the code that is run, by the layout of its arguments and
by the values that it closes over. A program whose digest is known is not traced again. So a digest
covers everything, or there is none: source files by content, values by content and never by how
they print.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import logging
import os
import sys
import tempfile
import types
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any

import jax
import jaxtyping
import llvmlite
import llvmlite.binding as llvm
import numpy as np

logger = logging.getLogger(__name__)

MAX_CODE_BYTES = 256 * 2**20
"""bytes of object code that are kept; the longest unused goes first."""
_BYTES_OF_DIGEST = 32
UNOPTIMISED = "LANES_UNOPTIMISED"
"""An environment variable: where it is set, LLVM optimises nothing: kernels build in half the
time, run more slowly, fuse no product with a sum, and one kernel serves few lanes and many."""

_SCHEDULERS = ("fast", "default")
"""How LLVM orders the instructions that it selects where nothing is optimised, and where it is.

To order them by default takes half of the time in which a large kernel that is not optimised is
emitted; LLVM's "linearize" orders some wrongly. A process that optimises all never sets it: LLVM
ends one that sets an option that its version does not know."""

_lock = Lock()
_selected: list[int] = []
"""The level for which instructions are selected, once a kernel was not optimised."""
_folder: list[Path] = []


def keep_code_in(folder: Path | None) -> None:
    """Keep object code in a folder; None keeps none.

    Whoever can write there can run code as this user: it must be the user's own.
    """
    _folder[:] = [] if folder is None else [folder]


def optimises() -> bool:
    """Return whether LLVM optimises."""
    return not os.environ.get(UNOPTIMISED)


def _level() -> int:
    """Return how much LLVM optimises, as its -O says."""
    return 2 if optimises() else 0


@cache
def _target_machine(level: int) -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features()
    flat = features.flatten() + (",-prefer-256-bit" if features.get("avx512f") else "")
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=flat, opt=level, reloc="pic"
    )


@cache
def register_bytes() -> int:
    """Return how wide this processor's vector registers are."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 64
    return 32 if features.get("avx2") else 16


def _machine_name() -> str:
    level = _level()
    triple = _target_machine(level).triple
    features = sorted(name for name, has in llvm.get_host_cpu_features().items() if has)
    versions = (llvmlite.__version__, *llvm.llvm_version_info)
    return repr(
        (versions, triple, llvm.get_host_cpu_name(), features, level, _SCHEDULERS[bool(level)])
    )


def _optimise(module: Any, machine: Any) -> None:
    """Simplify each function as LLVM's -O1 does; other passes find nothing here.

    Lanes are vectors already; loops are long and gain nothing from being unrolled. -O2, which looks
    for stores that are written over, takes half as long again, for code that is as fast.
    """
    options = llvm.create_pipeline_tuning_options(speed_level=1)
    options.loop_unrolling = options.loop_vectorization = options.slp_vectorization = False
    builder = llvm.create_pass_builder(machine, options)
    passes = builder.getFunctionPassManager()
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)


def _compiled(text: str) -> bytes:
    level = _level()
    machine = _target_machine(level)
    module = llvm.parse_assembly(text)
    if level:
        _optimise(module, machine)
    with _lock:
        if _selected != [level] and (_selected or not level):
            _selected[:] = [level]
            llvm.set_option("", f"-pre-RA-sched={_SCHEDULERS[bool(level)]}")
        code: bytes = machine.emit_object(module)
    return code


def load_or_make(key: str, made: Callable[[], bytes]) -> bytes:
    """Return the content for a key on this machine, from the cache or made now and cached.

    What another process is making is waited for.
    """
    path = _path_of(key)
    if path is None:
        return made()
    content = _read(path)
    if content is None:
        with _made_once(path):
            content = _read(path)
            if content is None:
                content = made()
                _write(path, content)
    return content


def is_kept(key: str) -> bool:
    """Return whether the cache has content for a key on this machine."""
    path = _path_of(key)
    return path is not None and path.exists()


def _path_of(key: str) -> Path | None:
    """Return the file with the content for a key; None where nothing is kept."""
    if not _folder:
        return None
    digest = hashlib.sha256(f"{_machine_name()}\n{key}".encode()).hexdigest()
    return _folder[0] / f"{digest}.o"


@contextmanager
def _made_once(path: Path) -> Iterator[None]:
    """Wait for other processes that make a file; where locks are unknown, it may be made twice."""
    lock = path.with_suffix(".lock")
    with ExitStack() as held:
        with suppress(ImportError, OSError):
            import fcntl  # noqa: PLC0415 (not on Windows)

            path.parent.mkdir(parents=True, exist_ok=True)
            file = held.enter_context(lock.open("w"))
            fcntl.flock(file, fcntl.LOCK_EX)
            held.callback(lock.unlink, missing_ok=True)
        yield


def object_code(text: str) -> bytes:
    """Return the object code of a module's text, compiled or from the cache."""
    return load_or_make(text, lambda: _compiled(text))


def _read(path: Path) -> bytes | None:
    """Return the content of a file behind its digest; None if it is missing or damaged."""
    try:
        held = path.read_bytes()
        os.utime(path)
    except OSError:
        return None
    digest, code = held[:_BYTES_OF_DIGEST], held[_BYTES_OF_DIGEST:]
    if hashlib.sha256(code).digest() != digest:
        logger.debug("%s is damaged and is compiled again", path)
        return None
    return code


def _write(path: Path, code: bytes) -> None:
    """Keep code behind its digest, whole or not at all; a full disk is no reason to fail."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".code-")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(code).digest() + code)
            Path(name).replace(path)
        except OSError:
            Path(name).unlink(missing_ok=True)
            raise
        _bound(path.parent)


def _bound(folder: Path) -> None:
    """Remove the least recently used files, down to `MAX_CODE_BYTES` bytes.

    Those too that a process began to write and, killed, left.
    """
    found = []
    for path in (*folder.glob("*.o"), *folder.glob(".code-*")):
        with suppress(OSError):
            state = path.stat()
            found.append((state.st_mtime, state.st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= MAX_CODE_BYTES:
            break
        with suppress(OSError):
            path.unlink()
            total -= size


@cache
def _linker() -> Any:
    return llvm.create_lljit_compiler(_target_machine(_level()))


class LoadedFunction:
    """A function in memory, there as long as this is."""

    def __init__(self, code: bytes, function: str) -> None:
        with _lock:
            number = hashlib.sha256(code).hexdigest() + f"-{id(self):x}"
            self._library = (
                llvm.JITLibraryBuilder()
                .add_object_img(code)
                .add_current_process()
                .export_symbol(function)
                .link(_linker(), number)
            )
        self.address: int = self._library[function]


TRACED_BY = ("jax", "jaxlib", "equinox", "numpy")
"""Libraries whose versions decide what is traced."""
_CHECKS_SHAPES = inspect.getsourcefile(jaxtyping.jaxtyped)
"""Where functions are wrapped that do what they did, their arguments' shapes checked."""


class UnknownError(TypeError):
    """A value has no digest; its message names what has none."""


def digest_of(value: Any, packages: tuple[str, ...]) -> str:
    """Return a digest of a value and of the source files of packages, those of this one included.

    Parameters
    ----------
    value
        Of numbers, texts, arrays, containers, dataclasses, and of classes and functions of these
        packages, of the standard library and of `TRACED_BY`.
    packages
        Whose code is run while a function is traced.

    Raises
    ------
    UnknownError
        There is something else in it.
    """
    packages = ("lanes", *packages)
    parts = (_encoded(value, packages), _sources(packages), str(jax.config.jax_enable_x64))  # type: ignore[attr-defined]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _encoded(value: Any, packages: tuple[str, ...]) -> str:
    def inside(part: Any) -> str:
        return _encoded(part, packages)

    if isinstance(value, dict):
        content = ", ".join(f"{inside(k)}: {inside(each)}" for k, each in value.items())
    elif isinstance(value, tuple | list):
        content = ", ".join(map(inside, value))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        content = inside([(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)])
    else:
        content = _of_one(value, packages)
    return f"{_named(type(value), packages)}({content})"


def _named(code: Any, packages: tuple[str, ...]) -> str:
    """Return the name of a class or function, whose source is part of the digest."""
    if isinstance(code, types.FunctionType) and code.__code__.co_filename == _CHECKS_SHAPES:
        code = inspect.unwrap(code)
    where, name = (getattr(code, key, None) or "<>" for key in ("__module__", "__qualname__"))
    top = where.partition(".")[0]
    known = top in (*packages, *TRACED_BY) or top in sys.stdlib_module_names
    # of a class, these are descriptors of its objects
    of_object = not isinstance(code, type) and (
        not isinstance(getattr(code, "__self__", None), type(None) | types.ModuleType)
        or getattr(code, "__closure__", None)
    )
    if not known or "<" in name or of_object:
        raise UnknownError(f"{where}.{name}")
    return f"{where}.{name}"


def _of_one(value: Any, packages: tuple[str, ...]) -> str:
    """Return a text that identifies a value without parts among those of its type."""
    if value is None or isinstance(value, bool | int | str):
        content = repr(value)
    elif isinstance(value, float):
        content = value.hex()
    elif isinstance(value, np.dtype):
        content = str(value.str)
    elif isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        content = f"{array.dtype.str} {array.shape} {array.tobytes().hex()}"
    else:
        content = _named(value, packages)
    return content


@cache
def _sources(packages: tuple[str, ...]) -> str:
    """Return a digest of all source files of packages, and of the libraries' versions."""
    digest = hashlib.sha256(repr((sys.version, [version(name) for name in TRACED_BY])).encode())
    for name in packages:
        folder = Path(import_module(name).__path__[0])
        for path in sorted(folder.rglob("*.py")):
            text = path.read_bytes()
            digest.update(f"{name} {path.relative_to(folder)} {len(text)}\n".encode() + text)
    return digest.hexdigest()
