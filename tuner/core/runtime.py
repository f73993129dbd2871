"""Set-up of jax: threads, precision, compiled code; versions that decide a run's numbers.

A job's flights run as kernels of `lanes`, which have threads of their own. What XLA and NumPy's
linear algebra compute in a job is small, and thread pools make it slower: they are turned off.
Flights that do run through XLA (reverse mode, one's own programs with `sim_jax`) want two things of
it: loops compiled as one function, ten times faster for one vehicle, and fusions of several outputs
prepared, without which each number of a step is computed anew, 3.7 times as many operations.

Whatever the user has set in the environment stays.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import platform
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tuner.core.disk import cache_folder
from tuner.core.errors import InputError

PROGRAM = "multirotor-tune"
LIBRARY_NAMES = ("jax", "jaxlib", "equinox", "numpy", "rosbags")


EXTRAS: Mapping[str, Collection[str]] = {
    "cluster": (
        *("dask", "distributed", "dask_jobqueue", "dask_kubernetes", "cloudpickle"),
        "fsspec",
    ),
    "postgresql": ("psycopg",),
    "service": (
        *("fastapi", "uvicorn", "sqlalchemy", "alembic", "fsspec", "python_multipart"),
        *("prometheus_client", "starlette", "anyio", "httpx"),
    ),
}
"""Extra of this program -> the packages that it brings, by the names that are imported."""


@contextmanager
def extra(name: str, asked_by: str, needs: str = "needs") -> Iterator[None]:
    """Turn a missing package of an extra, imported inside, into one line.

    Parameters
    ----------
    asked_by, needs
        What needs it: a command or options; and the verb that goes with that.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS[name]:
            raise
        what = f"{needs} {package}, which is not installed"
        raise InputError(asked_by, what, f"pip install 'multirotor-tune[{name}]'") from None


def installed(distribution: str = PROGRAM) -> str:
    """Return the installed version of a distribution, or ``not installed``."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Return the versions of Python, of this program and of the libraries that it computes with."""
    return {"python": platform.python_version()} | {
        name: installed(name) for name in (PROGRAM, *LIBRARY_NAMES)
    }


logger = logging.getLogger(__name__)

COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"
"""The event of `jax.monitoring` at the end of compiling, or of reading compiled code."""

#: Releases of jaxlib (major.minor) known to accept the flags below: an unknown one is fatal.
RELEASES_KNOWN = ("0.10", "0.11", "0.12")
_LARGER_THAN_ANY_LOOP = 10**15
"""bytes"""
_FLAGS = {
    "--xla_disable_hlo_passes": "cpu_multi_output_fusion",
    "--xla_backend_extra_options": "xla_cpu_use_multi_output_fusion,"
    f"xla_cpu_small_while_loop_byte_threshold={_LARGER_THAN_ANY_LOOP}",
}
_COLLECT_AFTER = (100_000, 20, 100)
"""New objects, and collections of younger ones, after which Python looks for garbage. A program
that jax traces is hundreds of thousands of objects that stay, which Python's own 700 look through
again and again."""


_MAX_KEPT_BYTES = 2**28
"""bytes that arrays have left and that stay for the next ones. Every simulation fills arrays anew;
given back and fetched again, their memory takes the system a third of a sweep's time."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _LARGEST = -1, -3, 2**25
"""Options of glibc's mallopt, and its largest threshold."""

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables with the number of threads of linear algebra, by library."""


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def release_of(distribution: str) -> str:
    """Return the installed release of a distribution, as ``0.10``."""
    return ".".join(version(distribution).split(".")[:2])


def set_environment() -> None:
    """Set what jax and NumPy read from the environment when they are imported."""
    os.environ.setdefault("NPROC", "1")
    # of a GPU, jax would take three quarters of the memory, for what is a processor's work
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for (
        name
    ) in THREAD_VARIABLES:  # matrices are small: more threads spin for longer than they compute
        os.environ.setdefault(name, "1")
    # Loading its own compiled code, XLA complains of pseudo-features that no processor reports.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if release_of("jaxlib") not in RELEASES_KNOWN:
        return
    given = os.environ.get("XLA_FLAGS", "")
    names = {flag.partition("=")[0] for flag in given.split()}
    added = [f"{name}={value}" for name, value in _FLAGS.items() if name not in names]
    os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()


def collect_rarely() -> None:
    """Have Python look for garbage less often than it does by itself, unless it does already."""
    if gc.get_threshold()[0] < _COLLECT_AFTER[0]:
        gc.set_threshold(*_COLLECT_AFTER)


def keep_memory() -> None:
    """Have the C library keep the memory of arrays for the next ones, where it is glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGEST)
        mallopt(_M_TRIM_THRESHOLD, _MAX_KEPT_BYTES)


def kernel_folder() -> Path:
    """Return the folder in which kernels are kept."""
    return cache_folder() / "kernels"


_forked: list[bool] = []
"""Whether this process was forked from one that had computed: one entry, or none."""


@cache
def _notice_forks() -> None:
    """Have each process that is forked from this one know it."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=partial(_forked.append, True))


def configure(*, keep_compiled: bool = True) -> None:
    """Set jax up for simulation; call it once, before the first computation.

    It computes in double precision unless ``JAX_ENABLE_X64`` says otherwise.
    The environment variables ``NPROC`` and ``XLA_FLAGS`` are read when jax makes its devices: a
    program that has already computed with jax keeps what it has, at the price of speed alone.

    Parameters
    ----------
    keep_compiled
        Keep compiled code in the user's cache folder, so that the same job starts at once the next
        time, unless ``JAX_COMPILATION_CACHE_DIR`` names another folder.

    Raises
    ------
    InputError
        A variable of the environment, of those that jax reads, is none that it can use here; or the
        process was forked from one that had computed, whose threads it lacks.
    """
    if _forked:
        what = "was forked from one that had computed with jax, and would wait for ever"
        remedy = 'start it by multiprocessing.get_context("spawn")'
        raise InputError("this process", what, remedy)
    set_environment()
    collect_rarely()
    keep_memory()
    try:
        import jax  # noqa: PLC0415 (must come after the environment, and is slow)
    except ValueError as error:  # as for JAX_ENABLE_X64=maybe
        raise InputError("the environment", str(error), "correct or unset the variable") from None
    try:
        jax.devices()
    except (RuntimeError, AssertionError):
        what = f"is {os.environ['JAX_PLATFORMS']!r}, which jax cannot use here"
        raise InputError("JAX_PLATFORMS", what, "unset the variable, or set it to cpu") from None
    _notice_forks()

    if keep_compiled:
        from lanes import keep_code_in  # noqa: PLC0415 (imports jax)

        keep_code_in(kernel_folder())
    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
    if keep_compiled and jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        compiled = cache_folder() / "compiled"
        with suppress(OSError):
            compiled.mkdir(parents=True, exist_ok=True)
        jax.config.update(
            "jax_compilation_cache_dir", str(compiled) if os.access(compiled, os.W_OK) else None
        )
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    logger.debug("%s", describe())


def describe() -> str:
    """Return one line on the settings in force, to stand beside every measured figure."""
    import jax  # noqa: PLC0415 (slow to import)

    devices = jax.devices()
    precision = jax.dtypes.canonicalize_dtype(float)
    return (
        f"jax {jax.__version__}, {len(devices)} {devices[0].platform} device(s), {precision}, "
        f"NPROC={os.environ.get('NPROC', '')}, XLA_FLAGS={os.environ.get('XLA_FLAGS', '')}"
    )
