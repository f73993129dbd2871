"""``tune sensitivity``: what recordings tell of each coefficient."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from tuner.cli.options import (
    TYPED,
    ControllerChoice,
    Flights,
    JobChoice,
    Many,
    Namespace,
    Quiet,
    Topics,
    VehicleChoice,
)


def sensitivity(
    *,
    flights: Flights,
    vehicle: VehicleChoice = None,
    controller: ControllerChoice = None,
    mass: float | None = None,
    config: JobChoice = None,
    topics: Topics = None,
    namespace: Namespace = None,
    fit: Annotated[list[str] | None, Many] = None,
    fix: Annotated[list[str] | None, Many] = None,
    arena: str | None = None,
    global_method: Annotated[
        Literal["morris", "sobol"] | None, Parameter(name="--global", negative=())
    ] = None,
    samples: int | None = None,
    span: float = 30.0,
    profile: Annotated[list[str] | None, Many] = None,
    out: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Tell what each coefficient does, how well it is known and from what, nothing fitted.

    Parameters
    ----------
    mass
        The weighed take-off mass in kg, instead of the vehicle file's.
    fit
        Exactly these coefficients are taken to be fitted together.
    fix
        The usual coefficients are, without these.
    arena
        X,Y,Z in m from wall to wall and up, about the origin: where the next flight must fit.
        Default: what the recorded flights took, and some more.
    global_method
        Tell the indices of one of them over the range of the coefficients, too.
    samples
        For them: trajectories of Morris (default 16), base points of Sobol (default 64).
    span
        Percent by which coefficients are varied for them, where the job file gives no bounds.
    profile
        Coefficients for which the others are fitted again along a grid of values.
    out
        Folder for the tables and the report; default runs/ and the time.
    """
    from tuner.cli.options import lengths
    from tuner.cli.progress import listening, print_examined
    from tuner.runtime import configure

    configure()
    from tuner.config import Options
    from tuner.job.folder import folder_for
    from tuner.job.sensitivity import SensitivityRequest, examine_vehicle

    options = Options(
        flights,
        vehicle=vehicle,
        controller=controller,
        mass=mass,
        config=config,
        topics=topics,
        namespace=namespace,
        fit=fit,
        fix=fix,
    )
    request = SensitivityRequest(
        arena=None if arena is None else lengths("--arena", arena),
        global_method=global_method,
        samples=samples,
        span=span / 100.0,
        profiles=profile or (),
    )
    with listening(quiet=quiet) as listener:
        found = examine_vehicle(
            options, request, out=folder_for(out), command=TYPED.get(), on_message=listener.message
        )
    if not quiet:
        print_examined(found)
