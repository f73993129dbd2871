"""crazyflow, first principles with attitude control: ``... contestants.crazyflow 4096``."""

from __future__ import annotations

import sys

import jax
import numpy as np
from crazyflow.control import Control
from crazyflow.sim import Sim

from benchmarks.timing import answer


def main(vehicles: int) -> None:
    sim = Sim(n_worlds=vehicles, control=Control.attitude, freq=500)
    sim.reset()
    sim.attitude_control(np.tile(np.array([[[0.0, 0.0, 0.0, 0.3]]]), (vehicles, 1, 1)))
    steps = max(50, min(5_000, 400_000 // vehicles))

    def run() -> None:
        sim.step(steps)
        jax.block_until_ready(sim.data.states.pos)

    answer(run, vehicles * steps, "float32, attitude control at 500 Hz")


if __name__ == "__main__":
    main(int(sys.argv[1]))
