"""The cache gives back what was read, and only that."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.tuner.recordings import making
from tuner.recordings import cache
from tuner.recordings import loader as loading
from tuner.recordings.cache import cache_root, digest, store
from tuner.recordings.content import ReadOptions
from tuner.recordings.flight import Flight
from tuner.recordings.loader import load_flight


@pytest.fixture
def bag(short: Path, tmp_path: Path) -> Path:
    path = tmp_path / "flight.bag"
    path.write_bytes(short.read_bytes())
    return path


def assert_equal(a: Flight, b: Flight) -> None:
    for name, values in a.signals.items():
        assert np.array_equal(values, b.signals[name], equal_nan=True), name
    for name, series in a.series.items():
        assert np.array_equal(series.time, b.series[name].time), name
        assert np.array_equal(series.values, b.series[name].values, equal_nan=True), name
    for name, value in vars(a.initial).items():
        assert np.array_equal(value, getattr(b.initial, name), equal_nan=True), name
    assert np.array_equal(a.time, b.time)
    assert a.notes == b.notes
    assert a.damage == b.damage
    assert (a.name, a.sha256, a.rate) == (b.name, b.sha256, b.rate)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The recordings that were really read."""
    seen: list[Path] = []
    original = loading.read_content

    def read(options: ReadOptions) -> object:
        seen.append(options.path)
        return original(options)

    monkeypatch.setattr(loading, "read_content", read)
    return seen


def test_second_time_comes_from_the_cache_and_is_equal(bag: Path, reads: list[Path]) -> None:
    first, second = load_flight(bag), load_flight(bag)
    assert len(reads) == 1
    assert_equal(first, second)
    assert_equal(first, load_flight(bag, cache=False))
    assert len(reads) == 2


def test_content_settings_and_side_car_count(bag: Path, reads: list[Path], tmp_path: Path) -> None:
    load_flight(bag)
    assert len(load_flight(bag, rate=50.0).time) == pytest.approx(600, abs=2)
    (tmp_path / "flight.yaml").write_text("end: 10")
    assert load_flight(bag).duration < 10
    (tmp_path / "own.yaml").write_text("name: own\nformat: ros\nextends: thesis_lab\nsignals: {}\n")
    load_flight(bag, topics=tmp_path / "own.yaml")
    (tmp_path / "own.yaml").write_text("name: own\nformat: ros\nextends: mavros\nsignals: {}\n")
    assert not load_flight(bag, topics=tmp_path / "own.yaml").has("lap")
    changed = bytearray(bag.read_bytes())
    changed[-1] ^= 1
    bag.write_bytes(changed)
    load_flight(bag)
    assert len(reads) == 6


def test_same_content_elsewhere_is_known(bag: Path, reads: list[Path], tmp_path: Path) -> None:
    load_flight(bag)
    (tmp_path / "there").mkdir()
    moved = bag.rename(tmp_path / "there" / bag.name)
    assert load_flight(moved).path == str(moved)
    assert len(reads) == 1


def test_the_longest_unused_go_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUNE_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("tuner.recordings.cache.MAX_CACHE_BYTES", 1000)
    files = [tmp_path / "flights" / str(number) for number in range(4)]
    for age, file in enumerate(files[:3]):
        store(file, bytes(300))
        os.utime(file, (1e9 - age, 1e9 - age))
    store(files[3], bytes(300))
    assert [file.exists() for file in files] == [True, True, False, True]
    monkeypatch.setattr("tuner.recordings.cache.MAX_CACHE_BYTES", 10_000)
    store(files[2], bytes(90))  # less than a hundredth: nobody looks
    monkeypatch.setattr("tuner.recordings.cache._remove_oldest", lambda: pytest.fail("looks"))
    store(files[2], bytes(9))


def test_damaged_cache_is_read_anew(bag: Path, reads: list[Path]) -> None:
    first = load_flight(bag)
    (kept,) = (cache_root() / "flights").iterdir()
    kept.write_bytes(kept.read_bytes()[:-100])
    assert_equal(first, load_flight(bag))
    assert len(reads) == 2


def test_unwritable_cache_is_no_error(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUNE_CACHE_DIR", str(bag))  # a file where a folder should be
    assert load_flight(bag).has("position")


def test_concurrent_runs_agree(bag: Path) -> None:
    code = (
        "import sys; from tuner.recordings.loader import load_flight; "
        "f = load_flight(sys.argv[1]); print(f.signals['position'].sum().hex(), len(f.time))"
    )
    runs = [
        subprocess.Popen([sys.executable, "-c", code, str(bag)], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    outputs = {run.communicate()[0] for run in runs}
    assert [run.returncode for run in runs] == [0, 0]
    assert len(outputs) == 1
    names = [file.name for file in (cache_root() / "flights").iterdir()]
    assert len(names) == 1
    assert not names[0].startswith(".")


def test_another_process_reads_beside_a_command(bag: Path) -> None:
    code = (
        "import sys, time; from tuner.engine import beside as module; module.cores = lambda: 2\n"
        "from tuner.engine.beside import beside, do_beside\n"
        "from tuner.recordings import loader; path, done = map(loader.Path, sys.argv[1:])\n"
        "with beside():\n"
        "    do_beside(loader.load_flights, path.with_name('missing.bag'))\n"
        "    do_beside(loader.load_flights, path)\n"
        "    do_beside(loader.Path.touch, done)\n"
        "    while not done.exists(): time.sleep(0.01)\n"
        "loader.read_content = None; print(loader.load_flight(path).name)"
    )
    run = [sys.executable, "-c", code, str(bag), str(bag.with_name("done"))]
    output = subprocess.run(run, capture_output=True, text=True, check=True, timeout=60).stdout
    assert output == "flight\n"


def test_folder_digest_sees_names_and_contents(tmp_path: Path) -> None:
    folder = making.to_ros2(making.CIRCLE, tmp_path / "a", making.StoragePlugin.MCAP, until=1.0)
    before = digest(folder)
    assert digest(folder) == before
    (folder / "metadata.yaml").rename(folder / "other.yaml")
    assert digest(folder) != before
    if sys.platform == "linux":
        (folder / os.fsdecode(b"\xff")).touch()  # a name that is not UTF-8
        assert digest(folder) != before


def test_the_version_is_of_all_source_in_the_folder(tmp_path: Path, monkeypatch) -> None:
    for name in ("recordings/cache.py", "recordings/ros/a.py", "equation_error/b.py"):
        (tmp_path / "tuner" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "tuner" / name).touch()
    monkeypatch.setattr(cache, "__file__", str(tmp_path / "tuner" / "recordings" / "cache.py"))
    version = cache.source_version.__wrapped__
    before = version("recordings"), version()
    (tmp_path / "tuner" / "equation_error" / "b.py").write_text("1")
    assert version("recordings") == before[0]
    assert version() != before[1]
    (tmp_path / "tuner" / "recordings" / "ros" / "a.py").write_text("1")
    assert version("recordings") != before[0]
