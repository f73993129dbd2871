"""The end of the program by Ctrl-C or SIGTERM: in one line, with what was found kept."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM
_AGAIN_AFTER_S = 0.02
"""s after which an interruption that came at a bad moment is tried again."""
_IMPORTS = "<frozen importlib._bootstrap>"
_raised: list[KeyboardInterrupt] = []
"""Interruptions of this process, the last one last."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, as of a batch system or of a shut-down: what Ctrl-C keeps is kept."""


def interruption_behind(error: BaseException) -> KeyboardInterrupt | None:
    """Return the interruption that an error is, or that a library may have made it of, if any."""
    return error if isinstance(error, KeyboardInterrupt) else _raised[-1] if _raised else None


def ended_in_words(interruption: KeyboardInterrupt) -> tuple[str, int]:
    """Return how a command ended that was interrupted, and its exit status."""
    if isinstance(interruption, Terminated):
        return "ended by SIGTERM", TERMINATED
    return "interrupted", INTERRUPTED


@contextmanager
def ending_at_once() -> Iterator[None]:
    """While the program is imported, and nothing else catches it, have Ctrl-C end it in words."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    try:
        signal.signal(signal.SIGINT, _end)
    except ValueError:  # not the main thread, whose signals these are
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(*_: object) -> None:
    with suppress(OSError):
        os.write(2, b"tune: interrupted\n")
    os._exit(INTERRUPTED)


def listen_for_signals() -> None:
    """Have Ctrl-C and SIGTERM interrupt the program, at a moment when it can be.

    An import goes on to its end: jaxlib's crashes when it is interrupted. What is raised in a
    callback of the garbage collector, as jax has one, Python ignores; it is raised again. A signal
    that the program was started to ignore stays ignored.
    """
    for number, usual, kind in (
        (signal.SIGINT, signal.default_int_handler, KeyboardInterrupt),
        (signal.SIGTERM, signal.SIG_DFL, Terminated),
    ):
        if signal.getsignal(number) is usual:
            signal.signal(number, _Interruption(kind))
    sys.unraisablehook = _raise_again


class _Interruption:
    """A handler of signals that raises an exception, once no import is under way."""

    def __init__(self, kind: type[KeyboardInterrupt]) -> None:
        self._kind = kind

    def __call__(self, _: int, frame: FrameType | None) -> None:
        while frame is not None:
            if frame.f_code.co_filename == _IMPORTS:
                self.later()
                return
            frame = frame.f_back
        _raised.append(self._kind())
        raise _raised[-1]

    def later(self) -> None:
        signal.signal(signal.SIGALRM, self)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_AFTER_S)


def _raise_again(ignored: sys.UnraisableHookArgs) -> None:
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        _Interruption(ignored.exc_type).later()
    else:
        sys.__unraisablehook__(ignored)


def end_with(status: int) -> NoReturn:
    """End the process with an exit status; one that SIGTERM ended, by that signal.

    Who sent it, such as systemd, takes that for no failure. While Python ends, nothing catches
    another Ctrl-C: the system does.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    if status == TERMINATED:
        with suppress(OSError):
            sys.stdout.flush()
        signal.raise_signal(signal.SIGTERM)
    sys.exit(status)
