"""Times of a run's stages, with jax's tracing and compiling in them.

A stage is a block ``with span("search"):``. Unless a run is recorded it costs a look at a variable.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

from tuner.core.runtime import COMPILE_EVENT, set_environment

TRACING = "tracing"
LOWERING = "lowering"
COMPILING = "compiling"
LOADING = "loading compiled code"
BUILDING = "building kernels"
FALLBACK = "/lanes/fallback"
"""Event of a program that runs through XLA, for what it has no rule for."""
JAX_STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": TRACING,
    "/jax/core/compile/jaxpr_to_mlir_module_duration": LOWERING,
    COMPILE_EVENT: COMPILING,
    "/jax/compilation_cache/cache_retrieval_time_sec": LOADING,
    "/lanes/build_duration": BUILDING,
}
"""Event of `jax.monitoring` -> what it is called here."""
START = "start of Python"
OUTSIDE = "elsewhere"
"""Time of the main thread outside all stages."""


@dataclass(frozen=True)
class Span:
    """A stretch of time.

    Attributes
    ----------
    name
        Of the stage, or one of `JAX_STAGES`.
    begin, end
        s since the process began.
    detail
        What was traced or compiled.
    beside
        Whether another process or thread did it, while this one went on.
    processor
        Processor seconds of this process, all threads together; known of stages alone.
    """

    name: str
    begin: float
    end: float
    detail: str = ""
    beside: bool = False
    processor: float = 0.0

    @property
    def is_stage(self) -> bool:
        """Whether it is a stage of this process, rather than work of jax in one."""
        return self.name not in JAX_STAGES.values() and not self.beside


@dataclass
class Recorder:
    """Collects the spans of one run, as they end."""

    spans: list[Span] = field(default_factory=list)
    fallbacks: list[str] = field(default_factory=list)
    """Programs that run through XLA, and what they have no rule for."""
    thread: int = field(default_factory=threading.get_ident)
    """The program of the stages."""
    began: float = field(default_factory=lambda: time.perf_counter() - time.process_time())
    """The process's begin on `time.perf_counter`: until now it has done nothing but compute."""

    def now(self) -> float:
        """Return the s since the process began."""
        return time.perf_counter() - self.began

    def add_duration(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """Add what jax reports at its end, if it is one of `JAX_STAGES`."""
        if event == FALLBACK:
            self.fallbacks.append(str(kwargs.get("fun_name", "")))
        if event in JAX_STAGES:
            end, detail = self.now(), str(kwargs.get("fun_name", ""))
            beside = threading.get_ident() != self.thread
            self.spans.append(Span(JAX_STAGES[event], end - duration_secs, end, detail, beside))


_RECORDER: ContextVar[Recorder | None] = ContextVar("_RECORDER", default=None)
_WATCHER: ContextVar[Callable[[str], None] | None] = ContextVar("_WATCHER", default=None)
_STAGE: ContextVar[str] = ContextVar("_STAGE", default="")


@contextmanager
def span(name: str) -> Iterator[None]:
    """Count the time of a block as the stage ``name``'s, where a run is recorded.

    Whoever watches the run is told the stage, and at its end the one that it was in.
    """
    watcher, recorder = _WATCHER.get(), _RECORDER.get()
    outer = None if watcher is None else _STAGE.set(name)
    begin, used = (0.0, 0.0) if recorder is None else (recorder.now(), time.process_time())
    if watcher is not None:
        watcher(name)
    try:
        yield
    finally:
        if recorder is not None:
            spent = time.process_time() - used
            recorder.spans.append(Span(name, begin, recorder.now(), processor=spent))
        if watcher is not None and outer is not None:
            _STAGE.reset(outer)
            watcher(_STAGE.get())


@contextmanager
def watching(on_stage: Callable[[str], None]) -> Iterator[None]:
    """Have each stage of a block named as it begins; an empty name is none."""
    token = _WATCHER.set(on_stage)
    try:
        yield
    finally:
        _WATCHER.reset(token)


@contextmanager
def recording() -> Iterator[Recorder]:
    """Record the spans of a block, jax's own included."""
    recorder = Recorder()
    recorder.spans.append(Span(START, 0.0, recorder.now(), processor=time.process_time()))
    token = _RECORDER.set(recorder)
    with span("import"):
        set_environment()
        from jax import monitoring  # noqa: PLC0415 (takes most of a second)

    monitoring.register_event_duration_secs_listener(recorder.add_duration)
    try:
        yield recorder
    finally:
        monitoring.unregister_event_duration_listener(recorder.add_duration)
        _RECORDER.reset(token)


@dataclass
class StageTime:
    """A stage's seconds, those of stages inside it left out.

    Attributes
    ----------
    seconds
        From its begins to its ends.
    processor
        Processor seconds of all threads.
    jax
        One of `JAX_STAGES` -> how many of the seconds it took.
    programs
        How many compiled programs were asked for.
    """

    stage: str
    seconds: float = 0.0
    processor: float = 0.0
    jax: dict[str, float] = field(default_factory=lambda: dict.fromkeys(JAX_STAGES.values(), 0.0))
    programs: int = 0

    @property
    def rest(self) -> float:
        """Seconds in which jax neither traced nor compiled: computed, read, drew, wrote."""
        return self.seconds - sum(self.jax.values())


def stage_table(spans: Sequence[Span], seconds: float, processor: float) -> tuple[StageTime, ...]:
    """Return a row for every stage in the order of their begins.

    Every instant counts for the innermost span that holds it, so that the rows' seconds, and
    processor seconds, sum up to those of the process, ``seconds`` and ``processor``.
    """
    whole = Span(OUTSIDE, 0.0, seconds, processor=processor)
    rows = {OUTSIDE: StageTime(OUTSIDE)}
    open_: list[tuple[Span, StageTime]] = []
    for each in [
        whole,
        *sorted((s for s in spans if not s.beside), key=lambda s: (s.begin, -s.end)),
    ]:
        while len(open_) > 1 and open_[-1][0].end <= each.begin:
            open_.pop()
        outer = open_[-1:]
        row = rows.setdefault(each.name, StageTime(each.name)) if each.is_stage else outer[0][1]
        row.programs += each.name == COMPILING
        spent = min(each.end, seconds) - each.begin
        for (one, stage), sign in ((each, row), 1.0), *((around, -1.0) for around in outer):
            stage.seconds += sign * spent
            stage.processor += sign * each.processor
            if not one.is_stage:
                stage.jax[one.name] += sign * spent
        open_.append((each, row))
    elsewhere = rows.pop(OUTSIDE)
    return (*rows.values(), elsewhere)


def beside_of(spans: Sequence[Span]) -> dict[str, float]:
    """Return name -> s that other threads and processes spent on it, all its spans together."""
    seconds: dict[str, float] = {}
    for each in spans:
        if each.beside:
            seconds[each.name] = seconds.get(each.name, 0.0) + each.end - each.begin
    return seconds
