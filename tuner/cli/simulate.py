"""``tune simulate``: fly a trajectory and write the flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tuner.cli.options import ControllerName, Many, Quiet, VehicleName
from tuner.trajectory_settings import TrajectoryName


def simulate(
    *,
    trajectory: TrajectoryName,
    out: Path,
    vehicle: VehicleName = "hovergames",
    controller: ControllerName = "hovergames",
    radius: float = 2.0,
    omega: float = 0.7,
    speed_scale: float = 2.1,
    speed: float | None = None,
    yaw_rate: float = 2.0,
    duration: float = 40.0,
    rate: float = 100.0,
    sweep: Annotated[list[str] | None, Many] = None,
    precision: Literal["float32", "float64"] = "float64",
    quiet: Quiet = False,
) -> None:
    """Fly a trajectory with a vehicle and a controller, and write the flight.

    Parameters
    ----------
    trajectory
        What is flown, from rest, with the publisher's wind-up of ten seconds.
    out
        FILE.csv, or FILE.bag with the topics of a MAVROS lab.
    radius
        m.
    omega
        rad/s.
    speed_scale
        The publisher's velocity scaler.
    speed
        m/s at which the reference peaks; instead of the velocity scaler.
    yaw_rate
        rad/s, of the yaw spin.
    duration
        s.
    rate
        Hz of the written samples.
    sweep
        NAME=LOW:HIGH:COUNT of a coefficient; several give every combination.
    precision
        What to compute in: float32 is twice as fast for many vehicles, and 0.02 mm off.
    """
    from tuner.cli.tables import print_flights
    from tuner.runtime import configure

    configure()
    from tuner.simulation.plan import simulate_to_file

    summaries = simulate_to_file(
        out,
        vehicle=vehicle,
        controller=controller,
        trajectory={
            "name": trajectory,
            "radius": radius,
            "omega": omega,
            "speed_scale": speed_scale,
            "yaw_rate": yaw_rate,
        },
        speed=speed,
        duration=duration,
        rate=rate,
        sweep=sweep or (),
        precision=precision,
    )
    if not quiet:
        print_flights(summaries, out)
