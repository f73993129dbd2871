"""Every export of a run, written, read back and flown: ``python -m benchmarks.targets runs/x``.

A row a target: by how much the run's flights are missed with all terms, by the physical and by the
effective coefficients in this project's simulation of the target's simulator, and in that simulator
itself where it is installed (drone-models wants SCIPY_ARRAY_API=1).
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from tuner.core.runtime import configure
from tuner.core.shipped import EXPORT_TARGETS
from tuner.evaluate.records import AxesRmse
from tuner.exporters.effective import cached_effective, pose_rmse, refly
from tuner.exporters.target import target_of, write
from tuner.result import PoseRmse, read_run


def main(folder: str) -> None:
    configure()
    run = read_run(folder)
    spinning = {f.name for f in run.result.flights if "spin" in f.name}

    def over_flights(flown: Mapping[str, AxesRmse]) -> str:
        rmse = pose_rmse(axes for name, axes in flown.items() if name not in spinning)
        return rmse.words

    best = over_flights({f.name: f.rmse_best for f in run.result.flights})
    print("| target | all terms | physical there | effective there | in the simulator itself |")
    print("|---|---|---|---|---|")
    for kind in EXPORT_TARGETS:
        target = target_of(kind)
        found = cached_effective(run, target.simulator) if target.simulator.name else None
        vehicle = run.vehicle if found is None else found.vehicle
        draft = target.draft(vehicle, "by a benchmark", target.simulator, None)
        with tempfile.TemporaryDirectory() as place:
            write(draft, Path(place) / f"x{target.suffix}")  # refused if it does not read back
        unfitted = (
            PoseRmse(position=None, attitude=None) if found is None else found.result.rmse_unfitted
        )
        own = over_flights(refly(run, draft.vehicle))
        there = "–" if draft.flier is None else over_flights(refly(run, draft.vehicle, draft.flier))
        physical = own if found is None else unfitted.words
        print(f"| {kind} | {best} | {physical} | {own} | {there} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
