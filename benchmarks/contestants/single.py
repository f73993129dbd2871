"""One vehicle for 40 s at 400 Hz as `tune simulate` flies it, filters and latencies included."""

from __future__ import annotations

from benchmarks.timing import answer
from tuner import runtime

runtime.configure()

import jax  # noqa: E402 (after the set-up)

from sim_jax.rollout import rollout  # noqa: E402
from sim_jax.state import hover  # noqa: E402
from tuner.config import ControllerFile, TrajectorySettings, configs_folder, read_vehicle  # noqa: E402
from tuner.model import model_of, schedule_of  # noqa: E402
from tuner.simulation.trajectory import published  # noqa: E402

DURATION = 40.0


def main() -> None:
    controller = ControllerFile()
    schedule = schedule_of(controller, log_rate=100)
    model = model_of(read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml"), controller)
    reference = published(
        TrajectorySettings(name="lemniscate"),
        duration=DURATION,
        control_rate=schedule.position_control_rate,
    )
    samples = round(DURATION * schedule.log_rate)

    def fly(model, inlet, start):  # type: ignore[no-untyped-def]
        begin = hover(model.vehicle, start)
        return rollout(model.vehicle, model.controller, schedule, inlet, begin, samples=samples)

    run = jax.jit(fly).lower(model, reference.inlet, reference.start).compile()
    answer(
        lambda: jax.block_until_ready(run(model, reference.inlet, reference.start)),
        DURATION,
        f"physics at {schedule.physics_rate} Hz, {schedule.integrator}, float64",
    )


if __name__ == "__main__":
    main()
