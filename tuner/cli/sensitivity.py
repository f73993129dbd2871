"""``tune sensitivity``: what recordings say about each coefficient, nothing fitted."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from tuner.cli.options import EACH, TYPED, Quiet, Verbose
from tuner.options import ExaminationOptions, Options


def sensitivity(
    *,
    examined: Annotated[ExaminationOptions, EACH],
    arena: str | None = None,
    global_method: Annotated[Literal["morris", "sobol"] | None, Parameter(name="--global")] = None,
    samples: int | None = None,
    span: float = 30.0,
    profile: list[str] | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Report the effect of each coefficient, how well it is known and from which flights.

    Parameters
    ----------
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
    """
    from tuner.cli.options import lengths
    from tuner.cli.progress import listening
    from tuner.cli.results import print_sensitivity
    from tuner.core.runtime import configure

    configure()
    from tuner.engine import engine_for
    from tuner.job.folder import folder_for
    from tuner.job.sensitivity import SensitivityRequest, examine_vehicle

    request = SensitivityRequest(
        arena=None if arena is None else lengths("--arena", arena),
        global_method=global_method,
        samples=samples,
        span=span / 100.0,
        profiles=profile or (),
    )
    with (
        engine_for(examined.workers, examined.cluster),
        listening(quiet=quiet, verbose=verbose) as listener,
    ):
        result = examine_vehicle(
            Options(**vars(examined)),
            request,
            out=folder_for(examined.out),
            command=TYPED.get(),
            on_message=listener.on_message,
        )
    if not quiet:
        print_sensitivity(result, verbose=verbose)
