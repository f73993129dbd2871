"""``python -m benchmarks [throughput ...] [--out FILE | --update]``: measure, and write a page.

Without names everything is measured that speaks of speed, and benchmarks/RESULTS.md written; with
names the parts are printed, and with ``--update`` they take their place on that page. Either way
the page's history gets a line. Two
environment variables bring others into the comparison: TUNE_YARDSTICK, the folder of the C++
program, and TUNE_PEERS, a Python that has drone-models, crazyflow and mujoco installed
(``pip install -e '.[bench]'`` puts them beside this project).
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import time
import tomllib
from pathlib import Path

from benchmarks.table import (
    ResultSection,
    sections_of,
    table,
    update_bars,
    update_section,
    updated_history,
)
from benchmarks.timing import ROOT, machine
from tuner.core import runtime

PARTS: dict[str, str] = {
    "throughput": "simulator",
    "derivatives": "simulator",
    "one_vehicle": "simulator",
    "compilation": "simulator",
    "job": "job",
    "reading": "reading",
    "service": "service",
    "workers": "workers",
    "prediction": "prediction",
}
"""Part -> the module that measures it, by a function of its name or by ``measure``."""
BY_NAME = {"large": "large", "lab": "lab", "calibration": "calibration", "fast": "fast_flights"}
"""Parts that are measured by name alone: they take as long as all others together."""
RESULTS = Path(__file__).with_name("RESULTS.md")


def page(sections: list[ResultSection], where: str, minutes: float, before: str = "") -> str:
    """Return the page: the bars first, then every table; what was not measured stays as it was."""
    bars = [bar.row() for section in sections for bar in section.bars]
    how = (
        f"`make bench` on {datetime.date.today()} in {minutes:.1f} minutes: {where}. "
        "Medians with quartiles in brackets; contestants of one table ran in turn. "
        f"tune's settings: {runtime.describe()}."
    )
    parts = ["# Measured speed", how, table(["bar", "measured", "asked for", ""], bars)]
    measured = {section.title: section.markdown() for section in sections}
    kept = {title: text for title, text in sections_of(before).items() if title not in measured}
    return "\n\n".join([*parts, *measured.values(), *kept.values()])


def version() -> str:
    """Return the version of what is measured: of this source, whatever is installed."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    return str(tomllib.loads(text)["project"]["version"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS, *BY_NAME])
    target_of = parser.add_mutually_exclusive_group()
    target_of.add_argument("--out", type=Path)
    target_of.add_argument("--update", action="store_true")
    arguments = parser.parse_args()
    began, where, sections = time.perf_counter(), machine(), list[ResultSection]()
    runtime.configure()
    whole = not arguments.parts and not arguments.update
    target = arguments.out or (RESULTS if whole or arguments.update else None)
    text = before = target.read_text(encoding="utf-8") if target and target.exists() else ""
    for part in arguments.parts or PARTS:
        module = importlib.import_module(f"benchmarks.{(PARTS | BY_NAME)[part]}")
        section: ResultSection = getattr(module, part if hasattr(module, part) else "measure")()
        sections.append(section)
        bars = [" | ".join(bar.row()) for bar in section.bars]
        print(section.markdown(), *bars, sep="\n", flush=True)
        if target is None:
            continue
        past = updated_history(
            before,
            [bar for section in sections for bar in section.bars],
            when=datetime.datetime.now(datetime.UTC),
            version=version(),
            whole=not arguments.parts,
        )
        if arguments.update:
            text = update_section(update_bars(update_section(text, section), section.bars), past)
        else:
            text = page([past, *sections], where, (time.perf_counter() - began) / 60, before)
        target.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
