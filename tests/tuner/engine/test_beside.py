"""The process beside a command does in turn what it is told, and ends with the command's block."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="it is forked on Linux alone")

TWO_CORES = """
import os, sys, time
from pathlib import Path
from tuner.engine import beside as module
from tuner.engine.beside import beside, do_beside
module.cores, folder = lambda: 2, Path(sys.argv[1])
"""


def _run(code: str, folder: Path) -> str:
    run = [sys.executable, "-c", TWO_CORES + code, str(folder)]
    return subprocess.run(run, capture_output=True, text=True, check=True, timeout=60).stdout


def test_it_goes_on_after_an_error_without_a_word_and_ends_with_the_block(tmp_path: Path) -> None:
    code = """
with beside():
    do_beside(print, "nobody reads this", flush=True)
    do_beside(os.mkdir, folder / "a")
    do_beside(os.mkdir, folder / "a")
    do_beside(os.mkdir, folder / "a/b", mode=0o700)
    while not (folder / "a/b").exists(): time.sleep(0.01)
    do_beside(time.sleep, 600.0)
do_beside(os.mkdir, folder / "later")
try: os.wait()
except ChildProcessError: print("no child is left")
"""
    assert _run(code, tmp_path) == "no child is left\n"
    assert (tmp_path / "a/b").exists()
    assert not (tmp_path / "later").exists()


def test_it_may_end_before_the_block(tmp_path: Path) -> None:
    code = """
with beside():
    do_beside(os._exit, 0)
    os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
    do_beside(os.mkdir, folder / "a")
print("done")
"""
    assert _run(code, tmp_path) == "done\n"
    assert list(tmp_path.iterdir()) == []


def test_none_is_forked_once_jax_has_its_threads(tmp_path: Path) -> None:
    code = """
sys.modules["jax"] = None
os.fork = lambda: print("forked") or 1
with beside(): do_beside(os.mkdir, folder / "a")
"""
    assert _run(code, tmp_path) == ""
    assert list(tmp_path.iterdir()) == []
