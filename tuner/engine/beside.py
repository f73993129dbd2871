"""Another process beside a command: what it does ahead the command finds in the user's cache."""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from signal import SIGKILL
from typing import BinaryIO

from tuner.core.runtime import cores

PIPE_BYTES = 2**20
"""bytes that wait to be read: a command never waits for the other process to read."""
_PIPE: ContextVar[BinaryIO | None] = ContextVar("_PIPE", default=None)


@contextmanager
def beside() -> Iterator[None]:
    """Have another process do what `do_beside` is told while a block runs, on another core.

    It is forked, and so before jax is imported, whose threads allow no fork. Afterwards, on one
    core alone, and on systems other than Linux, there is none. It ends with the block.
    """
    if "jax" in sys.modules or sys.platform != "linux" or cores() == 1:
        yield
        return
    import fcntl  # noqa: PLC0415 (not on Windows)

    read, write = os.pipe()
    with suppress(OSError):  # beyond the system's limit of this user
        fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    child = os.fork()
    if not child:
        try:
            os.close(write)
            _do_all(read)
        finally:
            os._exit(0)
    os.close(read)
    with os.fdopen(write, "wb", buffering=0) as pipe:
        token = _PIPE.set(pipe)
        try:
            yield
        finally:
            _PIPE.reset(token)
            os.kill(child, SIGKILL)
            os.waitpid(child, 0)


def do_beside(function: Callable[..., object], *arguments: object, **named: object) -> None:
    """Have the process beside this one call a function of a module, after those before; if any.

    Whatever goes wrong there, it is this process's to find out when it does the same.
    """
    pipe = _PIPE.get()
    if pipe is not None:
        with suppress(OSError):  # it has ended
            pipe.write(pickle.dumps((function, arguments, named)))


def _do_all(read: int) -> None:
    """Do what comes through a pipe, without a word, until its other end is closed."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for standard in range(3):
        os.dup2(nowhere, standard)
    with os.fdopen(read, "rb") as pipe:
        while True:
            try:
                function, arguments, named = pickle.load(pipe)
            except EOFError:
                return
            with suppress(Exception):
                function(*arguments, **named)
