"""The source counted: ``python -m benchmarks.house [ROOT]``, for this checkout or another.

With ``--walk``, also how far a reader walks who follows recordings into flights, and a job from the
command to its folder: the files whose functions are called, each read when it is first called, the
stays in them, and the returns to a file that was left. Nothing is cached when the walks begin.
"""

from __future__ import annotations

import argparse
import ast
import os
import statistics
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from docs.generate.house import ROOT, imported, statements

PACKAGES = ("tuner", "sim_jax", "lanes")
SMALL = 60
"""Lines below which a module counts as small."""


def counts(root: Path) -> dict[str, float]:
    """Return the counts of a checkout's packages."""
    files = [f for p in PACKAGES for f in sorted((root / p).rglob("*.py"))]
    lines = {f: len(f.read_text(encoding="utf-8").splitlines()) for f in files}
    nodes = [n for f in files for n in statements(f)]
    imports = {f: set(imported(f)) for f in files}
    modules = [f for f in files if f.name != "__init__.py"]
    names = {".".join(f.relative_to(root).with_suffix("").parts) for f in modules}
    importers = Counter(m for found in imports.values() for m in found if m in names)
    rooms = {f.relative_to(root).parts[:2] for f in files if len(f.relative_to(root).parts) > 2}
    between = {
        (f.relative_to(root).parts[1], m.split(".")[1])
        for f in files
        for m in imports[f]
        if f.is_relative_to(root / "tuner") and m.startswith("tuner.")
    }
    return {
        "lines": sum(lines.values()),
        "statements": len(nodes),
        "files": len(files),
        "lines of a file in the mean": statistics.mean(lines[f] for f in modules),
        f"modules under {SMALL} lines": sum(lines[f] < SMALL for f in modules),
        "modules with one importer": sum(n == 1 for n in importers.values()),
        "classes": sum(isinstance(n, ast.ClassDef) for n in nodes),
        "rooms": len(rooms),
        "arrows between rooms of tuner": len({(a, b) for a, b in between if a != b}),
        "circles of rooms": circles({(a, b) for a, b in between if a != b}),
    }


def circles(arrows: set[tuple[str, str]]) -> int:
    """Return how many sets of nodes reach one another by arrows, of two nodes and more."""
    nodes = sorted({node for arrow in arrows for node in arrow})
    graph = np.array([[(a, b) in arrows for b in nodes] for a in nodes], dtype=int)
    _, parts = connected_components(graph, connection="strong")
    return sum(count > 1 for count in Counter(parts).values())


def walk(call: Callable[[], object]) -> dict[str, int]:
    """Return through which files a call goes: files, stays, returns."""
    stays: list[str] = []
    read: set[CodeType] = set()

    def entered(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        ours = any(f"/{package}/" in code.co_filename for package in PACKAGES)
        if event != "call" or not ours or "site-packages" in code.co_filename or code in read:
            return
        read.add(code)
        if not stays or stays[-1] != code.co_filename:
            stays.append(code.co_filename)

    sys.setprofile(entered)
    try:
        call()
    finally:
        sys.setprofile(None)
    files = len(set(stays))
    return {"files": files, "stays": len(stays), "returns": len(stays) - files}


def walks(recordings: list[Path]) -> Mapping[str, dict[str, int]]:
    """Return the walks of recordings and of the job that fits them, with nothing cached."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        from tuner.cli import main as tune  # noqa: PLC0415 (the cache is the walk's own)
        from tuner.recordings.loader import load_flight  # noqa: PLC0415

        flights = [str(path) for path in recordings]
        return {
            "recordings": walk(lambda: [load_flight(path) for path in recordings]),
            "a job": walk(lambda: tune(["--flights", *flights, "--out", f"{folder}/run"])),
        }


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=ROOT)
    parser.add_argument("--walk", type=Path, nargs="+", metavar="RECORDING", default=[])
    given = parser.parse_args()
    for name, count in counts(given.root).items():
        print(f"{name:32} {count:8.0f}")
    if given.walk:
        for way, walked in walks(given.walk).items():
            for name, count in walked.items():
                print(f"{f'walk of {way}, {name}':32} {count:8d}")


if __name__ == "__main__":
    main()
