"""Double precision, the program's own set-up, and bounded memory, for every test that uses jax.

A test process keeps every program that it has compiled: gibibytes by the end of the suite, for most
modules compile their own and use them once. When a process has grown beyond `MOST_MEMORY`, all of
them are dropped. A program that is asked for again comes from the compilation cache on disk, which
the processes of a run share, those that tests start included; it is traced again, not compiled.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from pathlib import Path

import pytest

os.environ.setdefault("JAX_ENABLE_X64", "true")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

from hypothesis import settings

from tests.demo import demo
from tuner.runtime import cache_folder, set_environment

__all__ = ["demo"]

set_environment()
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_folder() / "compiled_by_tests"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

MOST_MEMORY = 800 * 2**20
"""bytes of a test process at the end of a test beyond which its compiled programs are dropped."""


def resident_memory() -> int:
    """Return the bytes that this process has in memory, or 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown() -> None:
    """Drop what jax has compiled once the process has grown too large."""
    if "jax" in sys.modules and resident_memory() > MOST_MEMORY:
        sys.modules["jax"].clear_caches()
        gc.collect()
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)  # what was freed goes back to the system
