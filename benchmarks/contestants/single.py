"""One vehicle for 40 s at 400 Hz as `tune simulate` flies it, filters and latencies included."""

from __future__ import annotations

from benchmarks.timing import answer
from tuner.core import runtime

runtime.configure()

from tuner.config import TrajectorySettings  # noqa: E402 (after the set-up)
from tuner.core.shipped import configs_folder  # noqa: E402 (after the set-up)
from tuner.evaluate.simulate import simulate  # noqa: E402
from tuner.vehicle import ControllerFile, read_vehicle  # noqa: E402 (after the set-up)

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
