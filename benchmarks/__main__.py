"""``python -m benchmarks [throughput derivatives ...] [--out FILE]``: measure, and write a page.

Without names everything is measured that speaks of speed, and benchmarks/RESULTS.md written; with
names the parts are printed. Two environment variables bring others into the comparison:
TUNE_YARDSTICK, the folder of the C++ program, and TUNE_PEERS, a Python that has drone-models,
crazyflow and mujoco installed (``pip install -e '.[bench]'`` puts them beside this project).
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import time
from pathlib import Path

from benchmarks.table import Section, table
from benchmarks.timing import machine
from tuner import runtime

PARTS = (
    "throughput",
    "derivatives",
    "one_vehicle",
    "compilation",
    "scaling",
    "job",
    "reading",
    "service",
    "workers",
    "prediction",
)
NO_SPEED = ("lab",)
"""Parts that are measured by name alone: they take as long as all others together."""
RESULTS = Path(__file__).with_name("RESULTS.md")


def page(sections: list[Section], where: str, minutes: float) -> str:
    """Return the page: the bars first, then every table."""
    bars = [bar.row() for section in sections for bar in section.bars]
    how = (
        f"`make bench` on {datetime.date.today()} in {minutes:.1f} minutes: {where}. "
        "Medians with quartiles in brackets; contestants of one table ran in turn. "
        f"tune's settings: {runtime.describe()}."
    )
    parts = ["# Measured speed", how, table(["bar", "measured", "asked for", ""], bars)]
    return "\n\n".join([*parts, *(section.markdown() for section in sections)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS, *NO_SPEED])
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    began, where, sections = time.perf_counter(), machine(), list[Section]()
    runtime.configure()
    target = arguments.out or (None if arguments.parts else RESULTS)
    for part in arguments.parts or PARTS:
        section = importlib.import_module(f"benchmarks.{part}").measure()
        sections.append(section)
        bars = [" | ".join(bar.row()) for bar in section.bars]
        print(section.markdown(), *bars, sep="\n", flush=True)
        if target is not None:
            target.write_text(page(sections, where, (time.perf_counter() - began) / 60))


if __name__ == "__main__":
    main()
