"""Broken recordings by the hundred: ``python -m tests.tuner.recordings.fuzz FORMAT --cases 1000``.

Each case is a whole recording with something wrong in it. It must be read, or refused with one
line, within seconds and without much memory. Prints the counts as JSON; the exit status says
whether every case did.
"""

from __future__ import annotations

import argparse
import functools
import json
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tests.tuner.recordings import making
from tests.tuner.recordings.micro_sd import log_of
from tuner.core.errors import InputError
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.loader import load_flights

#: Seconds that one case may take, and MB that all of them may occupy at the worst moment.
PATIENCE = 20
MEMORY = 700

Random = np.random.Generator


class TooSlowError(BaseException):
    """A case went on for too long; no reader may catch this."""


@functools.cache
def _short_content() -> bytes:
    """Return the circle's first three seconds of mission as a bag."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "base.bag"
        making.rewrite(making.CIRCLE, path, chunk=1 << 15, until=1_664_800_007_000_000_000)
        return path.read_bytes()


def _short_bag(folder: Path) -> Path:
    path = folder / "base.bag"
    path.write_bytes(_short_content())
    return path


def _packed(compression: str) -> Callable[[Path], Path]:
    return lambda folder: making.rewrite(
        _short_bag(folder), folder / "packed.bag", compression=compression, chunk=1 << 15
    )


def _ros2(storage: StoragePlugin, mode: CompressionMode) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        folder_written = making.to_ros2(_short_bag(folder), folder / "base", storage, mode)
        return next(path for path in folder_written.iterdir() if path.suffix != ".yaml")

    return make


def _csv(folder: Path) -> Path:
    frame = making.to_frame(_short_bag(folder))
    frame["command_1"] = frame["pwm_1"] / 1000 - 1
    for rotor in range(2, 5):
        frame[f"command_{rotor}"] = frame["command_1"]
    path = folder / "base.csv"
    frame["time"] = frame["time"] * 1e-9
    frame.to_csv(path, index=False)
    return path


def _parquet(folder: Path) -> Path:
    frame = making.to_frame(_short_bag(folder))
    frame["time"] = frame["time"].astype("datetime64[ns]")
    path = folder / "base.parquet"
    frame.to_parquet(path)
    return path


def _ulog(folder: Path) -> Path:
    bag = _short_bag(folder)
    boot = 1_664_799_990_000_000_000
    return making.to_ulog(making.px4_messages(bag), folder / "base.ulg", boot=boot)


def _micro_sd(folder: Path) -> Path:
    time = np.arange(750) / 250
    x, y, z = np.sin(time), np.cos(time), 1 + 0.1 * time
    columns = {
        f"stateEstimateZ.{a}": ("h", 1000 * v) for a, v in zip("xyz", (x, y, z), strict=True)
    }
    columns |= {f"ctrlLee.rpy{a}": ("f", 0.1 * v) for a, v in zip("xyz", (x, y, x), strict=True)}
    columns |= {f"motor.m{i}": ("H", 3e4 + 1e3 * x) for i in range(1, 5)}
    return log_of(time, columns, folder / "base")


FORMATS: dict[str, Callable[[Path], Path]] = {
    "bag": _short_bag,
    "bag-bz2": _packed("bz2"),
    "bag-lz4": _packed("lz4"),
    "db3": _ros2(StoragePlugin.SQLITE3, CompressionMode.NONE),
    "mcap": _ros2(StoragePlugin.MCAP, CompressionMode.NONE),
    "mcap-zstd": _ros2(StoragePlugin.MCAP, CompressionMode.STORAGE),
    "ulog": _ulog,
    "micro_sd": _micro_sd,
    "csv": _csv,
    "parquet": _parquet,
}

_ABSURD = [
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\xff" * 8,
    b"\xff" * 7 + b"\x7f",
    b"\x00" * 8,
    b"\x00\x00\x00\x00",
    b"\x00\x00\xf8\x7f",
    b"\x01\x00\x00\x00",
]


def _place(random: Random, size: int) -> int:
    """Choose a place: anywhere, or near one end, where indexes and headers are."""
    near = random.integers(3)
    if near == 0:
        return int(random.integers(size))
    reach = min(size, int(2 ** random.uniform(3, 13)))
    return int(random.integers(reach)) if near == 1 else size - 1 - int(random.integers(reach))


def _flip(raw: bytearray, random: Random) -> None:
    for _ in range(int(2 ** random.uniform(0, 6))):
        raw[_place(random, len(raw))] ^= 1 << int(random.integers(8))


def _cut(raw: bytearray, random: Random) -> None:
    del raw[_place(random, len(raw)) :]


def _absurd(raw: bytearray, random: Random) -> None:
    for _ in range(int(random.integers(1, 4))):
        value = _ABSURD[int(random.integers(len(_ABSURD)))]
        at = _place(random, len(raw))
        raw[at : at + len(value)] = value


def _repeat(raw: bytearray, random: Random) -> None:
    at, length = _place(random, len(raw)), int(2 ** random.uniform(0, 12))
    raw[at:at] = raw[at : at + length] * int(random.integers(1, 20))


def _blank(raw: bytearray, random: Random) -> None:
    at, length = _place(random, len(raw)), int(2 ** random.uniform(0, 14))
    raw[at : at + length] = bytes(len(raw[at : at + length]))


def _noise(raw: bytearray, random: Random) -> None:
    at, length = _place(random, len(raw)), int(2 ** random.uniform(0, 12))
    raw[at : at + length] = random.bytes(length)


def _remove(raw: bytearray, random: Random) -> None:
    at = _place(random, len(raw))
    del raw[at : at + int(2 ** random.uniform(0, 12))]


def _nest(raw: bytearray, random: Random) -> None:
    at = _place(random, len(raw))
    bracket = (b"[", b"{", b"(", b'"', b"[float64", b"\n")[int(random.integers(6))]
    raw[at:at] = bracket * int(2 ** random.uniform(0, 12))


HARMS = (_flip, _flip, _cut, _absurd, _absurd, _repeat, _blank, _noise, _remove, _nest)


def attempt(path: Path) -> str:
    """Read one broken recording; return what came of it."""

    def stop(*_: object) -> None:
        raise TooSlowError

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        try:
            flights = load_flights(path, cache=False)
            assert all(len(flight.time) > 1 for flight in flights)
            outcome = "read"
        except InputError as err:
            outcome = "refused" if "\n" not in str(err) and len(str(err)) < 2000 else "babbled"
        assert outcome != "babbled"
        inspections, errors = inspect_recordings([path], cache=False)
        assert len(inspections) + len(errors) == 1
        return outcome
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def fuzz(name: str, cases: range, seed: int) -> dict[str, Any]:
    """Try some broken recordings of a format; return what came of them."""
    outcomes: Counter[str] = Counter()
    failures = []
    slowest = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        base = FORMATS[name](Path(scratch))
        whole = base.read_bytes()
        path = Path(scratch) / f"case{base.suffix}"
        for case in cases:
            random = np.random.default_rng([seed, case])
            raw = bytearray(whole)
            harm = HARMS[int(random.integers(len(HARMS)))]
            harm(raw, random)
            path.write_bytes(raw)
            started = time.perf_counter()
            try:
                outcomes[attempt(path)] += 1
            except BaseException as err:  # a failure of any kind is what is looked for
                outcomes["failed"] += 1
                lines = traceback.format_exception(err)[-3:]
                failures.append({"case": case, "harm": harm.__name__, "error": "".join(lines)})
                if isinstance(err, KeyboardInterrupt):
                    break
            slowest = max(slowest, time.perf_counter() - started)
        shutil.rmtree(scratch, ignore_errors=True)
    peak = _peak_megabytes()
    return {
        "format": name,
        "cases": len(cases),
        **outcomes,
        "slowest_s": round(slowest, 2),
        "peak_mb": round(peak),
        "failures": failures[:5],
    }


def _peak_megabytes() -> float:
    """Return this process's own peak; getrusage's starts from that of the parent it came from."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(row for row in status.read_text().splitlines() if row.startswith("VmHWM"))
        return float(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    """Fuzz one format and print the counts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("format", choices=[*FORMATS, "all"])
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    cases, worst = range(given.first, given.first + given.cases), 0
    for name in FORMATS if given.format == "all" else [given.format]:
        result = fuzz(name, cases, given.seed)
        sys.stdout.write(json.dumps(result) + "\n")
        sys.stdout.flush()
        worst |= bool(result["failures"]) or result["peak_mb"] > MEMORY
    return int(worst)


if __name__ == "__main__":
    sys.exit(main())
