"""``tune sensitivity``: what recordings say about each coefficient, nothing fitted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from tuner.cli.options import (
    TYPED,
    Cluster,
    ControllerChoice,
    Flights,
    JobChoice,
    Many,
    Mass,
    Namespace,
    Quiet,
    Topics,
    VehicleChoice,
    Verbose,
    Workers,
)


def sensitivity(
    *,
    flights: Flights,
    vehicle: VehicleChoice = None,
    controller: ControllerChoice = None,
    mass: Mass = None,
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
    workers: Workers = None,
    cluster: Cluster = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Report the effect of each coefficient, how well it is known and from which flights.

    Parameters
    ----------
    fit
        Judge exactly these coefficients, as if they were fitted together.
    fix
        Judge the usual coefficients except these.
    arena
        Propose next flights that fit into X,Y,Z in m: from wall to wall, and up. Default: what the
        recorded flights took, and a little more.
    global_method
        Also compute the indices of Morris or Sobol over the range of the coefficients.
    samples
        Compute them from this many trajectories (Morris, default 16) or base points (Sobol, 64).
    span
        Vary coefficients without bounds in the job file by this many percent for them.
    profile
        Profile the likelihood of these coefficients: fit the others again along a grid of values.
    out
        Write tables and report into this folder. Default: runs/ and the time.
    """
    from tuner.cli.options import lengths
    from tuner.cli.progress import listening
    from tuner.cli.results import print_sensitivity
    from tuner.core.runtime import configure

    configure()
    from tuner.config import Options
    from tuner.engine import engine_for
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
    with engine_for(workers, cluster), listening(quiet=quiet, verbose=verbose) as listener:
        result = examine_vehicle(
            options,
            request,
            out=folder_for(out),
            command=TYPED.get(),
            on_message=listener.on_message,
        )
    if not quiet:
        print_sensitivity(result, verbose=verbose)
