"""Ctrl-C while local workers start: theirs to miss, and this process's to hear when they are there.

A terminal sends it to all processes of a job at once. Workers are ended by whoever started them, in
their own time; one that was interrupted while it starts would leave a trace and be started again,
and Dask cannot end a cluster that is half there.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker


@contextlib.contextmanager
def interrupts_kept_from_children() -> Iterator[None]:
    """Start processes, and threads that will, which Ctrl-C does not reach; hear it afterwards.

    Children inherit that a signal is blocked, but not what a handler of their parent's does. Does
    nothing where the caller is not the main thread, whose signals these are, or signals cannot be
    blocked.
    """
    handler = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or handler is None or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    pressed = threading.Event()
    # which would unblock the signal in the thread that spawns first, and so starts it
    resource_tracker.ensure_running()
    # some other thread, of a library, may hear what is blocked in this one
    signal.signal(signal.SIGINT, lambda *_: pressed.set())
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        signal.signal(signal.SIGINT, handler)
    if pressed.is_set():
        signal.raise_signal(signal.SIGINT)
