import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from jax import monitoring

from tests.memory import resident
from tuner import runtime

REPORT = """
import json, os
{before}
from tuner import runtime
runtime.configure()
import jax, jax.numpy as jnp
print(json.dumps(dict(
    devices=len(jax.devices()), dtype=str(jnp.zeros(2).dtype), nproc=os.environ["NPROC"],
    flags=os.environ["XLA_FLAGS"], cache=jax.config.jax_compilation_cache_dir,
    answer=float(jnp.arange(4.0).sum()), line=runtime.describe(),
)))
"""


def in_fresh_python(tmp_path: Path, before: str = "", **environment: str) -> dict[str, object]:
    clean = {k: v for k, v in os.environ.items() if k not in {"NPROC", "XLA_FLAGS"}}
    clean = {k: v for k, v in clean.items() if not k.startswith("JAX_")}
    root = Path(runtime.__file__).parents[1]
    clean |= {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(root), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", REPORT.format(before=before)],
        env=clean | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return json.loads(done.stdout)


def test_one_device_a_core_double_precision_and_a_kept_cache(tmp_path: Path) -> None:
    report = in_fresh_python(tmp_path)
    assert report["devices"] == runtime.cores()
    assert report["dtype"] == "float64"
    assert report["nproc"] == "1"
    assert report["answer"] == 6.0
    assert any((tmp_path / "multirotor-tune" / "compiled").iterdir())
    assert "NPROC=1" in str(report["line"])


def test_what_the_user_has_set_stays(tmp_path: Path) -> None:
    report = in_fresh_python(
        tmp_path,
        NPROC="2",
        XLA_FLAGS="--xla_force_host_platform_device_count=3",
        JAX_ENABLE_X64="0",
        JAX_COMPILATION_CACHE_DIR=str(tmp_path / "elsewhere"),
    )
    assert report["devices"] == 3
    assert report["dtype"] == "float32"
    assert report["nproc"] == "2"
    assert str(report["flags"]).count("device_count") == 1
    assert report["cache"] == str(tmp_path / "elsewhere")


def test_a_program_that_has_already_computed_goes_on(tmp_path: Path) -> None:
    report = in_fresh_python(tmp_path, before="import jax.numpy as jnp; jnp.ones(3).sum()")
    assert report["devices"] == 1
    assert report["dtype"] == "float64"
    assert report["answer"] == 6.0


def test_garbage_is_looked_for_rarely_unless_the_user_wants_it_rarer_still() -> None:
    before = gc.get_threshold()
    try:
        gc.set_threshold(700, 10, 10)
        runtime.collect_rarely()
        rarely = gc.get_threshold()
        assert rarely[0] > 10_000
        gc.set_threshold(10 * rarely[0], 1, 1)
        runtime.collect_rarely()
        assert gc.get_threshold() == (10 * rarely[0], 1, 1)
    finally:
        gc.set_threshold(*before)


@pytest.mark.skipif(sys.platform != "linux", reason="asks glibc")
def test_free_memory_between_what_is_used_is_given_back():
    blocks = [np.ones(12_000) for _ in range(2_000)]  # 96 kB each: of the heap, not mapped
    used = blocks[::50]
    del blocks
    before = resident()
    runtime.return_memory()
    assert before - resident() > 100 * 2**20
    assert all(block.sum() == 12_000 for block in used)


def test_only_long_compilations_give_memory_back(monkeypatch):
    given = []
    monkeypatch.setattr(runtime, "return_memory", lambda: given.append("back"))
    runtime.return_memory_after_compiling()
    runtime.return_memory_after_compiling()
    monitoring.record_event_duration_secs(runtime.COMPILED, 0.1)
    monitoring.record_event_duration_secs("/jax/core/compile/jaxpr_trace_duration", 10.0)
    assert not given
    monitoring.record_event_duration_secs(runtime.COMPILED, 10.0)
    assert given == ["back"]
