"""Double precision, the program's own set-up, and bounded memory, for every test that uses jax.

A test process keeps every program that it has compiled: gibibytes by the end of the suite, for most
modules compile their own and use them once. When a process has grown beyond `MOST_MEMORY` by the
end of a module, and still is when what is free was given back, all of them are dropped; inside of a
module, whose tests share programs, beyond `MOST_IN_A_MODULE`. A program that is asked for again
comes from the compilation cache on disk, however small it is, which the processes of a run share,
those that tests start included; it is not compiled, but traced again, which takes seconds.

Most tests compile for ten seconds what then runs for a tenth of one. So LLVM does not optimise what
they compile, which halves the time to compile and triples that to run, and without XLA's newer
emitter of kernels two fifths of the rest are saved; `make test-all` has both as the program does
(``TUNE_TESTS_OPTIMISED``).
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections import defaultdict
from pathlib import Path

import pytest

os.environ.setdefault("JAX_ENABLE_X64", "true")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
if not os.environ.get("TUNE_TESTS_OPTIMISED"):
    cheap = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    os.environ["XLA_FLAGS"] = f"{cheap} {os.environ.get('XLA_FLAGS', '')}".strip()

from hypothesis import settings

from tests.demo import demo
from tuner.runtime import cache_folder, collect_rarely, set_environment

__all__ = ["demo"]

set_environment()
collect_rarely()
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_folder() / "compiled_by_tests"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

MOST_MEMORY = 900 * 2**20
"""bytes of a test process at the end of a module beyond which its compiled programs are dropped."""
MOST_IN_A_MODULE = 1300 * 2**20
"""The same at the end of a test that others of its module follow."""
GROWTH = 150 * 2**20
"""bytes by which a process grows beyond what it could not give back before it tries again."""

grown = 0
"""bytes that the process had left when it last could not give more back, and `GROWTH`."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first, and in turns those of the folders with most of them left.

    Processes that take file by file then end together, and what one has compiled the other finds
    later, rather than compiling it at the same time.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    folders: dict[tuple[bool, Path], list[Path]] = defaultdict(list)
    for path in dict.fromkeys(item.path for item in items):
        folders[path in slow, path.parent].append(path)
    behind = {path: len(paths) - i for paths in folders.values() for i, path in enumerate(paths)}
    items.sort(key=lambda item: (item.path not in slow, -behind[item.path]))


def resident_memory() -> int:
    """Return the bytes that this process has in memory, or 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Give back what is free once the process has grown too large, then what jax has compiled.

    It takes a second: a process that stays large does not try after every test.
    """
    global grown  # noqa: PLW0603 (of this process)
    ends = nextitem is None or nextitem.path != item.path
    most = max(MOST_MEMORY if ends else MOST_IN_A_MODULE, grown)
    if "jax" not in sys.modules or resident_memory() <= most:
        return
    _give_back()
    if resident_memory() > MOST_MEMORY:
        sys.modules["jax"].clear_caches()
        _give_back()
    grown = resident_memory() + GROWTH


def _give_back() -> None:
    """Return to the system what compiling has left behind and nobody holds any more."""
    gc.collect()
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
