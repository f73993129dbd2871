"""The source counted: ``python -m benchmarks.house [ROOT]``, for this checkout or another.

With ``--walk``, also how far a reader walks who follows a recording into a flight: the files that
the calls pass through, the stays in them, and the returns to a file that was left.
"""

from __future__ import annotations

import argparse
import ast
import statistics
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

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
    }


def walk(recording: Path) -> dict[str, int]:
    """Return through which files a recording becomes a flight: files, stays, returns."""
    from tuner.recordings.loader import load_flight  # noqa: PLC0415 (the walk begins here)

    stays: list[str] = []

    def entered(frame: FrameType, event: str, _: Any) -> None:
        name = frame.f_code.co_filename
        ours = any(f"/{package}/" in name for package in PACKAGES) and "site-packages" not in name
        if event == "call" and ours and (not stays or stays[-1] != name):
            stays.append(name)

    sys.setprofile(entered)
    try:
        load_flight(recording)
    finally:
        sys.setprofile(None)
    files = len(set(stays))
    return {"files": files, "stays": len(stays), "returns": len(stays) - files}


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=ROOT)
    parser.add_argument("--walk", type=Path, metavar="RECORDING")
    given = parser.parse_args()
    for name, count in counts(given.root).items():
        print(f"{name:32} {count:8.0f}")
    if given.walk:
        for name, count in walk(given.walk).items():
            print(f"walk of a recording, {name:11} {count:8d}")


if __name__ == "__main__":
    main()
