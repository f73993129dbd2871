"""A scheduler that goes away, and a user who presses Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

import tuner

SCHEDULER = (sys.executable, "-m", "distributed.cli.dask_scheduler")
WORKER = (sys.executable, "-m", "distributed.cli.dask_worker")


ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(tuner.__file__).parents[1])}


@pytest.fixture
def cluster(tmp_path):
    """A scheduler with one worker, as somebody starts them by hand."""
    file = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    quiet["env"] = ENVIRONMENT
    ends = ("--scheduler-file", str(file))
    place = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    scheduler = subprocess.Popen([*SCHEDULER, *place, *ends], **quiet)
    alone = ("--nthreads", "1", "--no-nanny", "--no-dashboard")
    worker = subprocess.Popen([*WORKER, *ends, *alone], **quiet)
    try:
        while not file.exists() or not file.read_text().strip().endswith("}"):
            time.sleep(0.1)
            assert scheduler.poll() is None
        yield scheduler, file
    finally:
        for process in (worker, scheduler):
            process.terminate()
            process.wait(20)


USER = """
import sys
from tests.tuner.engine import tasks
from tuner.engine import engine_for
from tuner.core.errors import EngineError

with engine_for(cluster=sys.argv[1]) as engine:
    assert engine.map(tasks.square, [3]) == [9]
    try:
        engine.map(tasks.until_stopped, [sys.argv[2]], lambda *_: print("works", flush=True))
    except EngineError as error:
        print(error)
"""


@pytest.mark.slow
def test_a_scheduler_that_goes_away_is_one_line(cluster, tmp_path):
    scheduler, file = cluster
    address = file.read_text().split('"address": "')[1].split('"')[0]
    user = subprocess.Popen(
        [sys.executable, "-c", USER, address, str(tmp_path / "ended")],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert user.stdout is not None
    assert user.stdout.readline() == "works\n"
    scheduler.kill()
    said = [line for line in user.communicate(timeout=60)[0].splitlines() if line != "works"]
    remedy = "start it again; a search goes on with --out and --resume"
    assert said == [f"scheduler: does not answer any more; {remedy}"]
    assert user.returncode == 0


GREEDY = """
import sys
from tests.tuner.engine import tasks
from tuner.engine import engine_for
from tuner.core.errors import EngineError

if __name__ == "__main__":
    with engine_for(cluster=sys.argv[1]) as engine:
        try:
            engine.map(tasks.takes_ever_more, [None])
        except EngineError as error:
            print(error)
"""


@pytest.mark.slow
def test_a_worker_beyond_its_memory_is_one_line(tmp_path):
    script, file = tmp_path / "greedy.py", tmp_path / "cluster.yaml"
    script.write_text(GREEDY)
    file.write_text("workers: 1\nmemory: 1GiB\n")
    said = subprocess.run(
        [sys.executable, str(script), str(file)],
        env=ENVIRONMENT | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    remedy = "give each more memory, as memory: 4GiB in the cluster file, or use fewer"
    assert said.stdout == f"workers: ended once over the same task; {remedy}\n"
    assert said.stderr == ""


IMPATIENT = """
import signal
import sys
from tests.tuner.engine import tasks
from tuner.engine import engine_for

if __name__ == "__main__":
    # a suite that a shell's script runs in the background hands down that it is ignored
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print("begins", flush=True)
    try:
        with engine_for(int(sys.argv[2])) as engine:
            engine.map(
                tasks.until_stopped, [sys.argv[1]] * 4, lambda *_: print("works", flush=True)
            )
    except KeyboardInterrupt:
        print("interrupted")
"""


def processes_of(group):
    """Return what the processes of a group do, those that have ended but for their parent not."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            _, _, rest = (folder / "stat").read_text().rpartition(") ")
        except OSError:
            continue
        state, _, own_group = rest.split()[:3]
        if int(own_group) == group and state != "Z":
            with suppress(OSError):
                found.append((folder / "cmdline").read_text())
    # of a process that is about to become a zombie the system has no command any more
    return [command for command in found if command]


@pytest.mark.slow
@pytest.mark.parametrize(("moment", "workers"), [("workers start", 1), ("workers work", 2)])
def test_ctrl_c_ends_every_process(tmp_path, moment, workers):
    script = tmp_path / "impatient.py"
    script.write_text(IMPATIENT)
    user = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "ended"), str(workers)],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert user.stdout is not None
    assert user.stdout.readline() == "begins\n"
    if moment == "workers work":
        assert user.stdout.readline() == "works\n"
    else:
        while len(processes_of(user.pid)) < 3:
            time.sleep(0.02)
    assert len(processes_of(user.pid)) >= 3
    os.killpg(user.pid, signal.SIGINT)
    said, complaints = user.communicate(timeout=60)
    assert said.splitlines()[-1] == "interrupted"
    assert complaints == ""
    assert not processes_of(user.pid)
