"""The program's own set-up, and bounded memory, for every test that uses jax.

A test process keeps every program that it has compiled: gibibytes by the end of the suite, for most
modules compile their own and use them once. When a process has grown too large, by the end of a
module or before the demo's fit, all of them are dropped, see `tests.memory`. A program that is
asked for again comes from the compilation cache on disk, see `tests`; it is not compiled, but
traced again, which takes seconds.
"""

from __future__ import annotations

import gc
import logging
import os
from collections import defaultdict
from collections.abc import Generator, Iterator
from pathlib import Path

import jax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from threadpoolctl import threadpool_limits

from lanes.machine import UNOPTIMISED, keep_code_in
from lanes.program import _program_of
from tests import lowering, memory
from tests.demo import demo
from tests.memory import MOST_IN_A_MODULE, MOST_MEMORY
from tuner.core.disk import cache_folder
from tuner.core.runtime import keep_memory

__all__ = ["demo"]

keep_memory()
lowering.share_contexts()
lowering.place_arrays()
threadpool_limits(1, user_api="blas")
KERNELS = cache_folder() / "kernels"
"""The program's own: commands that a test runs, in this process or another, find what it built."""
keep_code_in(KERNELS)
assert jax.config.jax_compilation_cache_dir, "jax was imported before `tests` set its environment"

settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Have every other process begin with the last folder, and find compiled what it comes to.

    Where no bytecode is written yet, of tests and of libraries, each compiles half of it.
    """
    report = yield
    number = os.environ.get("PYTEST_XDIST_WORKER", "").removeprefix("gw")
    if isinstance(collector, pytest.Directory) and number.isdigit() and int(number) % 2:
        report.result.reverse()
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first, and in turns those of the folders with most of them left.

    Processes that take file by file then end together, and what one has compiled the other finds
    later, rather than compiling it at the same time.
    """
    items.sort(key=lambda item: item.path)  # in whichever order they were found
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    folders: dict[tuple[bool, Path], list[Path]] = defaultdict(list)
    for path in dict.fromkeys(item.path for item in items):
        folders[path in slow, path.parent].append(path)
    behind = {path: len(paths) - i for paths in folders.values() for i, path in enumerate(paths)}
    items.sort(key=lambda item: (item.path not in slow, -behind[item.path]))


def pytest_collection_finish() -> None:
    """Have searches for garbage leave out all that the tests have imported, and be a tenth as many.

    They take a fiftieth of a process's time else, most of it in what stays. The first example of
    hypothesis in a process is one, which took seconds where gibibytes were compiled before it.
    """
    gc.freeze()
    given(st.none())(lambda _: None)()
    gc.set_threshold(10 * gc.get_threshold()[0], *gc.get_threshold()[1:])


@pytest.fixture(scope="session", autouse=True)
def short_proposals() -> Iterator[None]:
    """Have jobs propose flights of eight seconds and more: those of most tests take six."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tuner.job.results.SHORTEST", 8.0)
        yield


@pytest.fixture
def optimised(monkeypatch: pytest.MonkeyPatch) -> None:
    """Build kernels as the program does, those of this process that are not optimised anew."""
    monkeypatch.setenv(UNOPTIMISED, "")
    _program_of.cache_clear()


class _NoFallback(logging.Handler):
    """Fails what runs through XLA for want of a rule: every flight of every job is a kernel's."""

    def emit(self, record: logging.LogRecord) -> None:
        raise AssertionError(record.getMessage())


KERNELS_ALONE = _NoFallback(logging.DEBUG)
logging.getLogger("lanes.program").addHandler(KERNELS_ALONE)
logging.getLogger("lanes.program").setLevel(logging.DEBUG)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Give memory back where the process has grown too large for what comes next."""
    ends = nextitem is None or nextitem.path != item.path
    memory.give_back(MOST_MEMORY if ends else MOST_IN_A_MODULE)
