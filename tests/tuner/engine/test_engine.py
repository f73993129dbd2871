import logging
import os
import time

import pytest

from tests.tuner.engine import tasks
from tuner.core.errors import EngineError, InputError, RecordingError
from tuner.engine import HERE, current, engine_for, using
from tuner.engine.engine import InProcessEngine


@pytest.fixture(params=["here", "two workers"])
def engine(request):
    return HERE if request.param == "here" else request.getfixturevalue("two_workers")


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


def test_results_come_in_the_order_of_the_tasks(engine):
    heard = []
    assert engine.map(tasks.square, range(7), lambda *said: heard.append(said)) == [
        number * number for number in range(7)
    ]
    wait_for(lambda: len(heard) == 7)
    assert sorted(heard) == [(number, {"number": number}) for number in range(7)]


def test_what_the_user_did_wrong_arrives_as_it_was_raised(engine):
    with pytest.raises(RecordingError, match=r"a\.bag: is empty; record it again"):
        engine.map(tasks.refused, ["a.bag"])


def test_a_shared_value_arrives(engine):
    shared = engine.share({"many": list(range(1000))})
    assert engine.map(tasks.value_of, [shared, shared]) == [{"many": list(range(1000))}] * 2


@pytest.mark.slow
def test_what_was_shared_is_gone_with_the_engine(tmp_path):
    file = tmp_path / "cluster.yaml"
    file.write_text(f"store: {tmp_path / 'store'}")
    with engine_for(cluster=str(file)) as engine:
        engine.share("anything")
        assert list((tmp_path / "store").iterdir())
    assert not list((tmp_path / "store").iterdir())


def test_workers_keep_to_cores_of_their_own(two_workers):
    processes = two_workers.map(tasks.about_the_process, range(8))
    own = {one["pid"]: {tuple(cores) for cores in one["cores"]} for one in processes}
    assert os.getpid() not in own
    assert all(len(cores) == 1 for cores in own.values()), "every thread on the same core"
    if len(own) == 2 and len(os.sched_getaffinity(0)) > 1:
        first, second = own.values()
        assert first != second
    # XLA takes some threads; a pool a core would be many more
    assert all(len(one["cores"]) < 40 for one in processes)


def test_log_lines_come_back(two_workers, caplog):
    with caplog.at_level(logging.WARNING):
        two_workers.map(tasks.logged, ["from afar"])
        wait_for(lambda: "from afar" in caplog.text)


def test_a_cancelled_task_ends_at_its_next_report(two_workers, tmp_path):
    heard = []
    future = two_workers.submit(tasks.until_stopped, str(tmp_path / "ended"), heard.append)
    wait_for(lambda: heard)
    future.cancel()
    wait_for((tmp_path / "ended").exists)


def test_one_error_ends_the_other_tasks(two_workers, tmp_path):
    ended, heard = tmp_path / "ended", []
    running = two_workers.submit(tasks.until_stopped, str(ended), heard.append)
    wait_for(lambda: heard)  # one that has not begun has nothing to leave behind
    with pytest.raises(RecordingError):
        two_workers.map(tasks.refused, ["a.bag", "b.bag"])
    assert not running.done(), "only those of the same call"
    running.cancel()
    wait_for(ended.exists)


def test_the_task_of_a_worker_that_dies_is_computed_again(two_workers, tmp_path):
    assert two_workers.map(tasks.dies_at_first, [str(tmp_path / "died")]) == ["done"]


def test_the_engine_in_force(two_workers):
    assert isinstance(current(), InProcessEngine)
    with using(two_workers):
        assert current() is two_workers
    assert isinstance(current(), InProcessEngine)


def test_without_options_this_process_computes():
    with engine_for() as engine:
        assert engine is HERE


def test_both_options_contradict_each_other():
    with (
        pytest.raises(InputError, match="--workers: cannot stand beside --cluster"),
        engine_for(2, "tcp://127.0.0.1:1"),
    ):
        pass


def test_no_scheduler_is_one_line(monkeypatch):
    monkeypatch.setattr("tuner.engine.dask_engine.ANSWER", 0.5)
    with (
        pytest.raises(InputError, match="no scheduler answers"),
        engine_for(None, "tcp://127.0.0.1:1"),
    ):
        pass


def test_a_result_that_is_lost_on_its_way_is_an_error(two_workers, monkeypatch):
    async def lost(*_, **__):
        raise OSError("the worker that had it is gone")

    monkeypatch.setattr(type(two_workers._client), "_gather", lost)
    with pytest.raises(EngineError, match="does not answer any more"):
        two_workers.submit(tasks.square, 3).result(timeout=60)
