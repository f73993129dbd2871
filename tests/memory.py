"""What a test process holds in memory, and how it gives back what compiling has left behind."""

from __future__ import annotations

import ctypes
import gc
import os
from contextlib import suppress
from pathlib import Path

import jax

from tests import lowering

MIB = 2**20


def _installed() -> int:
    """Return the bytes of memory that the machine has, or 0 where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return 0


MOST_MEMORY = min(max(_installed() // 8, 900 * MIB), 3000 * MIB)
"""bytes of a process at the end of a module beyond which its compiled programs are dropped.

An eighth of the machine's memory, for two processes and what they start: what is dropped is traced
again.
"""
MOST_IN_A_MODULE = MOST_MEMORY + 200 * MIB
"""The same at the end of a test that others of its module follow, with which it shares programs."""
BEFORE_A_FIT = MOST_MEMORY * 2 // 3
"""bytes beyond which a process gives back what it can before it fits recorded flights."""
GROWTH = 150 * MIB
"""bytes by which a process grows beyond what it could not give back before it tries again."""

grown = 0
"""bytes that the process had left when it last could not give more back, and `GROWTH`."""


def resident() -> int:
    """Return the bytes that this process has in memory, or 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def give_back(most: int) -> None:
    """Give back what jax has compiled, and what is free, if the process holds more than ``most``.

    It takes a second: a process that stays large does not try after every test.
    """
    global grown  # noqa: PLW0603 (of this process)
    if resident() <= max(most, grown):
        return
    jax.clear_caches()
    lowering.new_context()
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):  # where the C library is not glibc
        ctypes.CDLL(None).malloc_trim(0)
    grown = resident() + GROWTH
