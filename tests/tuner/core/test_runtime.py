import gc
import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tuner.core import runtime

REPORT = """
import json, os
{before}
from tuner.core import runtime
runtime.configure()
import jax, jax.numpy as jnp, numpy, resource
def fault():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        [numpy.ones(500_000) for _ in range(10)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(json.dumps(dict(
    dtype=str(jnp.zeros(2).dtype), nproc=os.environ["NPROC"],
    cache=jax.config.jax_compilation_cache_dir,
    faults=[fault(), fault()], answer=float(jnp.arange(4.0).sum()), line=runtime.describe(),
)))
"""


def in_fresh_python(tmp_path: Path, before: str = "", **environment: str) -> dict[str, object]:
    clean = {k: v for k, v in os.environ.items() if k not in {"NPROC", "XLA_FLAGS"}}
    clean = {k: v for k, v in clean.items() if not k.startswith("JAX_")}
    root = Path(runtime.__file__).parents[2]
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


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """Return a cache folder, and what a process said to which nothing else was given."""
    cache = tmp_path_factory.mktemp("cache")
    return cache, in_fresh_python(cache)


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("JAX_PLATFORMS", "cuda", "JAX_PLATFORMS: is 'cuda', which jax cannot use here; unset"),
        ("JAX_PLATFORMS", "tpu", "JAX_PLATFORMS: is 'tpu', which jax cannot use here; unset"),
        ("JAX_ENABLE_X64", "maybe", "invalid truth value 'maybe' for environment 'JAX_ENABLE_X64'"),
    ],
)
def test_what_jax_cannot_use_is_one_line(
    variable: str, value: str, words: str, tmp_path: Path
) -> None:
    program = "from tuner.cli import program; program()"
    asked = ["simulate", "--trajectory", "hover", "--out", str(tmp_path / "hover.csv")]
    done = subprocess.run(
        [sys.executable, "-c", program, *asked],
        env=os.environ | {variable: value},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert words in done.stderr


FORKED = """
import os
from tuner.core.errors import InputError
from tuner.core.runtime import configure
configure()
child = os.fork()
try:
    configure()
except InputError as error:
    print(error, flush=True)
os._exit(0) if not child else os.waitpid(child, 0)
"""


@pytest.mark.skipif(os.name != "posix", reason="nothing forks there")
def test_a_process_that_would_wait_for_threads_it_lacks_is_refused() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORKED],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    (line,) = done.stdout.splitlines()
    assert "this process: was forked from one that had computed with jax" in line
    assert "spawn" in line


def test_one_thread_double_precision_and_a_kept_cache(
    plain: tuple[Path, dict[str, object]],
) -> None:
    cache, report = plain
    assert report["dtype"] == "float64"
    assert report["nproc"] == "1"
    assert report["answer"] == 6.0
    assert any((cache / "multirotor-tune" / "compiled").iterdir())
    assert "NPROC=1" in str(report["line"])


def test_a_cache_that_cannot_be_kept_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "multirotor-tune").write_text("a file in its place")
    assert in_fresh_python(tmp_path)["cache"] is None


def test_the_memory_of_arrays_stays_for_the_next_ones(
    plain: tuple[Path, dict[str, object]],
) -> None:
    """Else each of these ten of a thousand pages is fetched from the system again."""
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("another C library")
    faults = plain[1]["faults"]
    assert isinstance(faults, list)
    assert faults[1] < 1000


def test_what_the_user_has_set_stays(tmp_path: Path) -> None:
    report = in_fresh_python(
        tmp_path,
        NPROC="2",
        JAX_ENABLE_X64="0",
        JAX_COMPILATION_CACHE_DIR=str(tmp_path / "elsewhere"),
    )
    assert report["dtype"] == "float32"
    assert report["nproc"] == "2"
    assert report["cache"] == str(tmp_path / "elsewhere")


def test_releases_of_jax_that_may_be_installed_are_those_whose_flags_are_known() -> None:
    text = (Path(runtime.__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    (bounds,) = re.findall(r'"jax>=0\.(\d+),.*<0\.(\d+)"', text)
    assert [f"0.{n}" for n in range(*map(int, bounds))] == list(runtime.RELEASES_KNOWN)


def test_an_unknown_release_gets_no_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    for release, known in {"0.10.1": True, "0.12.0.1": True, "0.99.0": False}.items():
        monkeypatch.setattr(runtime, "version", lambda _, release=release: release)
        monkeypatch.setattr(os, "environ", dict(os.environ))
        runtime.set_environment()
        assert ("XLA_FLAGS" in os.environ) == known
        os.environ.pop("XLA_FLAGS", None)


def test_a_gpu_is_left_alone_unless_the_user_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for given, used in {None: "cpu", "cuda,cpu": "cuda,cpu", "": ""}.items():
        others = {name: v for name, v in os.environ.items() if name != "JAX_PLATFORMS"}
        monkeypatch.setattr(
            os, "environ", others if given is None else others | {"JAX_PLATFORMS": given}
        )
        runtime.set_environment()
        assert os.environ["JAX_PLATFORMS"] == used


def test_a_program_that_has_already_computed_goes_on(tmp_path: Path) -> None:
    report = in_fresh_python(tmp_path, before="import jax.numpy as jnp; jnp.ones(3).sum()")
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


def test_what_is_imported_before_jax_is_set_up_does_without_it() -> None:
    # the environment that `configure` sets is read when jax is imported
    names = ("cli.results", "cli.progress", "report", "result", "service.client")
    code = "import sys\n" + "".join(
        f"import tuner.{name}\nif 'jax' in sys.modules: sys.exit('{name}')\n" for name in names
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_command_keeps_algebra_on_one_thread_before_numpy_is_there() -> None:
    code = (
        "import sys, os; from tuner.cli import main; print('numpy' in sys.modules); "
        "main(['--version']); print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    clean = {k: v for k, v in os.environ.items() if k not in runtime.THREAD_VARIABLES}
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=True
    )
    words = done.stdout.split()
    assert (words[0], words[-1]) == ("False", "1")
