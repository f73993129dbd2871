"""Loss of the four reference flights, or Hessian too: ``... contestants.fit jacobian``."""

from __future__ import annotations

import sys

from benchmarks.timing import answer
from tuner.core import runtime

runtime.configure()

import numpy as np  # noqa: E402 (after the set-up)

from benchmarks.calibration import reference_job  # noqa: E402
from tuner.objective.criterion import Point  # noqa: E402
from tuner.search.progress import beginning, criterion_of  # noqa: E402
from tuner.search.stages import plan  # noqa: E402

LOSS, JACOBIAN = "loss", "jacobian"


def main(what: str) -> None:
    objective = reference_job().objective
    rate = float(objective.schedule.log_rate)
    stage = plan("gradient", objective.samples, rate, windows=False, robust=True, steps=1)[-1]
    progress = beginning(objective, objective.space.initial[None])
    vector, offsets = (
        np.asarray(part[0]) for part in (progress.points.coefficients, progress.points.offsets)
    )
    criterion = criterion_of(stage, progress.scales, offsets)
    answer(
        lambda: objective.sums(Point(vector, offsets), criterion, derivatives=what == JACOBIAN),
        1.0,
        str(len(objective.space)),
    )


if __name__ == "__main__":
    main(sys.argv[1])
