"""One vehicle for 40 s at 400 Hz as `tune simulate` flies it, filters and latencies included."""

from __future__ import annotations

from benchmarks.timing import answer
from tuner import runtime

runtime.configure()

from tuner.config import (  # noqa: E402 (after the set-up)
    ControllerFile,
    TrajectorySettings,
    configs_folder,
    read_vehicle,
)
from tuner.simulation.simulate import simulate  # noqa: E402

DURATION = 40.0


def main() -> None:
    controller = ControllerFile()
    vehicle = read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml")
    lemniscate = TrajectorySettings(name="lemniscate")
    physics = controller.physics
    answer(
        lambda: list(simulate(vehicle, controller, lemniscate, duration=DURATION)),
        DURATION,
        f"physics at {physics.rate:g} Hz, {physics.integrator}, float64, signals included",
    )


if __name__ == "__main__":
    main()
