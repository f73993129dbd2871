"""How jax is set up for this program: threads, devices, vector width, precision, compiled code.

What was measured with jaxlib 0.10 on two cores with AVX-512, on steps of some hundred operations:

- XLA's own thread pool makes kernels of this size two to four times slower: it is turned off, and
  the cores come back as one device each.
- A loop that runs as one compiled function, rather than as a hundred kernels that are called one
  after the other, is ten times faster for one vehicle, seven times for the derivatives of a few
  flights, and nearly twice for a batch in pieces that stay in the first-level cache. XLA does so
  for small loops; what counts as small is raised beyond any loop.
- Left alone, XLA computes each component of a step's result for itself, all that it depends on
  included. Preparing for fusions of several outputs cuts the operations to what is needed. Making
  those fusions, too, would cost a factor of ten, for loops over several outputs are not vectorised.
- Unrolling such loops gains nothing and triples the time to compile.
- The tiled emitter takes vectors of four for roots and divisions: a third slower than without.
- A schedule for concurrency spreads kernels of a tenth of a microsecond over threads: twice slower.
- 512-bit vectors give a seventh.
- Two fifths of the time to trace went into Python's search for garbage: it is made rare.
- Without the newer emitter of kernels a Jacobian compiles an eighth sooner, and runs as fast; but a
  gradient in reverse mode takes minutes to compile.
- Compiling a program leaves hundreds of megabytes free that the C library keeps for itself. To give
  them back takes some milliseconds, and the demo's fit, nothing compiled before, ends with 1.2 GiB
  in memory rather than 1.8.

Whatever the user has set in the environment stays.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

from tuner.disk import cache_folder

logger = logging.getLogger(__name__)

COMPILED = "/jax/core/compile/backend_compile_duration"
"""What `jax.monitoring` calls the end of compiling, or of reading compiled code from the cache."""

#: Releases of jaxlib (major.minor) known to accept all flags below: an unknown one is fatal.
_RELEASES_KNOWN = ("0.10",)
_LARGER_THAN_ANY_LOOP = 10**15
"""bytes"""
_COLLECT_AFTER = (100_000, 20, 100)
"""New objects, and collections of younger ones, after which Python looks for garbage. A program
that jax traces is hundreds of thousands of objects that stay, which Python's own 700 look through
again and again."""
_LONG = 0.5
"""s of compiling after which memory is given back."""


def cores() -> int:
    """Return how many processor cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def _has_avx512() -> bool:
    try:
        return " avx512f " in Path("/proc/cpuinfo").read_text(errors="replace")
    except OSError:
        return False


def _flags() -> dict[str, str]:
    flags = {"--xla_force_host_platform_device_count": str(cores())}
    if _has_avx512():
        flags["--xla_cpu_prefer_vector_width"] = "512"
    if version("jaxlib").rpartition(".")[0] in _RELEASES_KNOWN:
        flags["--xla_cpu_copy_insertion_use_region_analysis"] = "true"
        flags["--xla_cpu_enable_concurrency_optimized_scheduler"] = "false"
        flags["--xla_disable_hlo_passes"] = "cpu_multi_output_fusion"
        flags["--xla_backend_extra_options"] = ",".join(
            [
                f"xla_cpu_small_while_loop_byte_threshold={_LARGER_THAN_ANY_LOOP}",
                "xla_cpu_use_multi_output_fusion",
                "xla_cpu_disable_loop_unrolling",
                "xla_cpu_disable_tiled_emitter",
            ]
        )
    return flags


def set_environment() -> None:
    """Set what jax reads from the environment when it makes its devices."""
    os.environ.setdefault("NPROC", "1")
    # Loading its own compiled code, XLA complains of pseudo-features that no processor reports.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    given = os.environ.get("XLA_FLAGS", "")
    names = {flag.partition("=")[0] for flag in given.split()}
    added = [f"{name}={value}" for name, value in _flags().items() if name not in names]
    os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()


def collect_rarely() -> None:
    """Have Python look for garbage less often than it does by itself, unless it does already."""
    if gc.get_threshold()[0] < _COLLECT_AFTER[0]:
        gc.set_threshold(*_COLLECT_AFTER)


def return_memory() -> None:
    """Give memory that nobody uses back to the system, where the C library can: that of glibc."""
    with suppress(OSError, AttributeError, TypeError):  # the last is what Windows answers
        ctypes.CDLL(None).malloc_trim(0)


@cache
def return_memory_after_compiling() -> None:
    """Have every thread that has compiled a large program give back what that has left free."""
    from jax import monitoring  # noqa: PLC0415 (takes most of a second)

    def compiled(event: str, duration_secs: float, **_: str | int) -> None:
        if event == COMPILED and duration_secs > _LONG:
            return_memory()

    monitoring.register_event_duration_secs_listener(compiled)


def configure(*, keep_compiled: bool = True) -> None:
    """Set jax up for simulation; call it once, before the first computation.

    It computes in double precision unless ``JAX_ENABLE_X64`` says otherwise.
    The environment variables ``NPROC`` and ``XLA_FLAGS`` are read when jax makes its devices, so
    that a program that has already computed with jax keeps the threads and devices it has, at the
    price of speed and of nothing else. On a GPU nothing here has an effect but the precision and
    the cache.

    Parameters
    ----------
    keep_compiled
        Keep compiled code in the user's cache folder, so that the same job starts at once the next
        time, unless ``JAX_COMPILATION_CACHE_DIR`` names another folder.
    """
    set_environment()
    collect_rarely()
    import jax  # noqa: PLC0415 (must come after the environment, and is slow)

    return_memory_after_compiling()
    if keep_compiled:
        from lanes import keep_code_in  # noqa: PLC0415 (imports jax)

        keep_code_in(cache_folder() / "kernels")
    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
    if keep_compiled and jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "compiled"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    logger.debug("%s", describe())


def keeps_compiled() -> bool:
    """Return whether compiled code is kept in this program's own folder."""
    import jax  # noqa: PLC0415 (slow to import)

    kept: str | None = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return kept == str(cache_folder() / "compiled")


def describe() -> str:
    """Return one line on the settings in force, to stand beside every measured figure."""
    import jax  # noqa: PLC0415 (slow to import)

    devices = jax.devices()
    precision = jax.dtypes.canonicalize_dtype(float)
    return (
        f"jax {jax.__version__}, {len(devices)} {devices[0].platform} device(s), {precision}, "
        f"NPROC={os.environ.get('NPROC', '')}, XLA_FLAGS={os.environ.get('XLA_FLAGS', '')}"
    )
