"""The project's tests; ``checked`` turns sim_jax's annotations into run-time checks.

What jax reads when it is imported is set here: double precision, and a cache of compiled programs
on disk, however small they are, which the processes of a run share, those that tests start
included.

Most tests compile for ten seconds what then runs for a tenth of one. So LLVM does not optimise what
they compile, which halves the time to compile and triples that to run, and without XLA's newer
emitter of kernels two fifths of the rest are saved, and a quarter of that in one part and without
marks of what shares no memory, which optimising alone reads. Nor are kernels of `lanes` optimised,
but where they are held against XLA (the fixture ``optimised``). `make test-all` has all as the
program does (``TUNE_TESTS_OPTIMISED``).
"""

import os
from typing import Any

from tuner.core.disk import cache_folder
from tuner.core.runtime import collect_rarely, release_of, set_environment


def __getattr__(name: str) -> Any:
    if name != "checked":
        raise AttributeError(name)
    from tests.annotations import checked  # noqa: PLC0415 (tests' child processes need none)

    return checked


if not os.environ.get("TUNE_TESTS_OPTIMISED"):
    cheap = (
        "--xla_backend_optimization_level=0",
        *(["--xla_cpu_use_fusion_emitters=false"] if release_of("jaxlib") == "0.10" else []),
        "--xla_llvm_enable_alias_scope_metadata=false",
        "--xla_llvm_enable_noalias_metadata=false",
        "--xla_cpu_parallel_codegen_split_count=1",
    )
    os.environ["XLA_FLAGS"] = " ".join([*cheap, os.environ.get("XLA_FLAGS", "")]).strip()
    os.environ.setdefault("LANES_UNOPTIMISED", "1")
os.environ.setdefault("JAX_ENABLE_X64", "true")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_folder() / "compiled_by_tests"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
set_environment()
collect_rarely()  # before jax is imported, a million objects that stay
