"""LLVM on this machine: modules into object code, cached on disk by content."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import llvmlite
import llvmlite.binding as llvm

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


def _optimise(module: Any, machine: Any, level: int) -> None:
    """Simplify each function; passes over whole modules and for vectorising find nothing here.

    Lanes are vectors already; loops are long and gain nothing from being unrolled. To look for
    loads that a loop's next turn repeats took a third of the time of a large kernel.
    """
    options = llvm.create_pipeline_tuning_options(speed_level=level)
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
        _optimise(module, machine, level)
    with _lock:
        if _selected != [level] and (_selected or not level):
            _selected[:] = [level]
            llvm.set_option("", f"-pre-RA-sched={_SCHEDULERS[bool(level)]}")
        code: bytes = machine.emit_object(module)
    return code


def load_or_make(key: str, made: Callable[[], bytes]) -> bytes:
    """Return the content for a key on this machine, from the cache or made now and cached."""
    if not _folder:
        return made()
    digest = hashlib.sha256(f"{_machine_name()}\n{key}".encode()).hexdigest()
    path = _folder[0] / f"{digest}.o"
    content = _read(path)
    if content is None:
        content = made()
        _write(path, content)
    return content


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
    """Remove the least recently used files, down to `MAX_CODE_BYTES` bytes."""
    found = []
    for path in folder.glob("*.o"):
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


class Code:
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
