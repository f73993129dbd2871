"""Ctrl-C and SIGTERM, whenever they come."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

BUSY = """
import gc, os, signal, sys, time
# a suite that a shell's script runs in the background hands down that it is ignored
signal.signal(signal.SIGINT, signal.default_int_handler)
import tuner.cli.app as program
number = getattr(signal, sys.argv.pop())

def send():
    os.kill(os.getpid(), number)

def work(_):
    print("begins")
    {work}
    time.sleep(10)

program.app = work
program.program()
"""
WHILE_COLLECTING = "gc.callbacks.append(lambda *_: gc.callbacks.clear() or send()); gc.collect()"
WHILE_IMPORTING = """
    import pathlib
    pathlib.Path("slow.py").write_text("import __main__; __main__.send(); print('imported')")
    sys.path.insert(0, ".")
    import slow
"""
MADE_AN_ERROR = """
    try:
        send()
    except KeyboardInterrupt as cause:
        raise RuntimeError(f"by a library: {cause!r}")
"""


@pytest.mark.parametrize(
    ("name", "ending"),
    [
        ("SIGINT", (130, "tune: interrupted\n")),
        ("SIGTERM", (-signal.SIGTERM, "tune: ended by SIGTERM\n")),
    ],
)
@pytest.mark.parametrize(
    ("work", "said"),
    [
        ("send()", "begins\n"),
        (WHILE_COLLECTING, "begins\n"),
        (WHILE_IMPORTING, "begins\nimported\n"),
        (MADE_AN_ERROR, "begins\n"),
    ],
    ids=("computing", "collecting", "importing", "an_error"),
)
def test_a_signal_ends_the_program_in_one_line(work, said, name, ending, tmp_path):
    done = run(BUSY.replace("{work}", work), name, folder=tmp_path)
    assert (done.returncode, done.stderr) == ending
    assert done.stdout == said


def test_ctrl_c_before_the_program_is_there_shows_no_trace(tmp_path):
    script = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)

class Pressed:
    def find_spec(self, name, *_):
        if name == "cyclopts":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Pressed())
import tuner.cli
"""
    done = run(script, folder=tmp_path)
    assert (done.returncode, done.stderr) == (130, "tune: interrupted\n")


def run(script, *arguments, folder):
    return subprocess.run(
        [sys.executable, "-c", script, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
