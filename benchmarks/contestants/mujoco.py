"""MuJoCo's C ``rollout`` of a free body with four thrusters: ``... contestants.mujoco 4096 2``."""

from __future__ import annotations

import sys

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from benchmarks.timing import answer

MODEL = """
<mujoco>
  <option timestep="0.001" integrator="Euler"/>
  <worldbody>
    <body pos="0 0 1">
      <freejoint/>
      <inertial pos="0 0 0" mass="1.5" diaginertia="0.029 0.029 0.055"/>
      <site name="a" pos="0.177 -0.177 0"/> <site name="b" pos="-0.177 0.177 0"/>
      <site name="c" pos="0.177 0.177 0"/> <site name="d" pos="-0.177 -0.177 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor site="a" gear="0 0 1 0 0 -0.06"/> <motor site="b" gear="0 0 1 0 0 -0.06"/>
    <motor site="c" gear="0 0 1 0 0 0.06"/> <motor site="d" gear="0 0 1 0 0 0.06"/>
  </actuator>
</mujoco>
"""


def main(vehicles: int, threads: int) -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    data = [mujoco.MjData(model) for _ in range(threads)]
    state = np.zeros((vehicles, size))
    mujoco.mj_getState(model, data[0], state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state[:] = state[0]
    steps = max(20, min(20_000, 200_000 // vehicles))
    control = np.full((vehicles, steps, 4), 1.5 * 9.81 / 4)
    pool = Rollout(nthread=threads if threads > 1 else 0)
    answer(
        lambda: pool.rollout(model, data, state, control),
        vehicles * steps,
        f"float64, dynamics alone, {threads} threads",
    )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
