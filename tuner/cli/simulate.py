"""``tune simulate``: fly a trajectory and write the flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tuner.cli.options import EACH, Quiet
from tuner.options import EngineOptions


def simulate(
    *,
    trajectory: str,
    out: Path,
    vehicle: str = "hovergames",
    controller: str = "hovergames",
    radius: float = 2.0,
    omega: float = 0.7,
    speed_scale: float = 2.1,
    speed: float | None = None,
    yaw_rate: float = 2.0,
    duration: float = 40.0,
    rate: float = 100.0,
    sweep: list[str] | None = None,
    precision: Literal["float32", "float64"] = "float64",
    forces: Path | None = None,
    engine: Annotated[EngineOptions, EACH] = EngineOptions(),
    quiet: Quiet = False,
) -> None:
    """Simulate a vehicle and its controller on a trajectory, and write the flight.

    Parameters
    ----------
    trajectory
        Fly this shape, such as circle, from rest; a name that does not exist lists all of them.
    out
        Write FILE.csv, or FILE.bag with the topics of a MAVROS lab; .png, .svg and .pdf draw it.
    vehicle
        Fly this vehicle file, or a shipped one by its name, say hovergames_updated.
    controller
        Fly this controller file, or a shipped one by its name: hovergames_sitl.
    radius
        Set the radius in m.
    omega
        Set the angular rate of the trajectory in rad/s.
    speed_scale
        Set the publisher's velocity scaler.
    speed
        Choose the velocity scaler so that the reference peaks at this speed in m/s.
    yaw_rate
        Set the rate of the yaw spin in rad/s.
    duration
        Fly for this many s.
    rate
        Write samples at this rate in Hz.
    sweep
        Vary a coefficient: NAME=LOW:HIGH:COUNT. Several of them give all combinations.
    precision
        Compute in this precision. float32 is twice as fast for many vehicles, and 0.02 mm off.
    forces
        Write force and moment of each term along the flights into this FILE.csv, too.
    """
    from tuner.cli.tables import print_flights
    from tuner.core.runtime import configure

    configure()
    from tuner.core.errors import InputError
    from tuner.engine import engine_for
    from tuner.evaluate.simulate import fly, grid_of
    from tuner.evaluate.write import Summary, summary_of, write_flights
    from tuner.report.paper import SUFFIXES, check_figure, write_figure

    drawn = out.suffix in SUFFIXES
    if drawn and (sweep or forces):
        raise InputError(out, "a figure is of one flight, without forces", "write a .csv")
    if drawn:
        check_figure(out)
    flights = fly(
        vehicle,
        controller,
        {
            "name": trajectory,
            "radius": radius,
            "omega": omega,
            "speed_scale": speed_scale,
            "yaw_rate": yaw_rate,
        },
        speed=speed,
        duration=duration,
        rate=rate,
        grid=grid_of(sweep or ()) or None,
        precision=precision,
        forces=forces is not None,
    )
    with engine_for(engine.workers, engine.cluster):
        if drawn:
            from tuner.report.figures import flight_figure

            flight = next(flights)
            write_figure(flight_figure(flight, f"{vehicle}: {trajectory}"), out)
            summaries: tuple[Summary, ...] = (summary_of(flight),)
        else:
            summaries = write_flights(flights, out, forces=forces)
    if not quiet:
        print_flights(summaries, out)
