"""``tune --flights ...``: the job itself."""

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

Method = Annotated[
    Literal["auto", "gradient", "cma", "hybrid"] | None,
    Parameter(help="How the minimum is looked for. Default: the job file's, else auto."),
]


def tune(
    *,
    flights: Flights,
    holdout: Annotated[list[str] | None, Many] = None,
    vehicle: VehicleChoice = None,
    controller: ControllerChoice = None,
    mass: float | None = None,
    config: JobChoice = None,
    topics: Topics = None,
    namespace: Namespace = None,
    fit: Annotated[list[str] | None, Many] = None,
    fix: Annotated[list[str] | None, Many] = None,
    method: Method = None,
    out: Path | None = None,
    resume: Annotated[bool, Parameter(negative=())] = False,
    force: Annotated[bool, Parameter(negative=())] = False,
    cross_validate: Annotated[bool, Parameter(negative=())] = False,
    seed: int | None = None,
    quiet: Quiet = False,
) -> None:
    """Fit, validate and report.

    Parameters
    ----------
    holdout
        Flights that are evaluated, never fitted.
    mass
        The weighed take-off mass in kg, instead of the vehicle file's.
    fit
        Exactly these coefficients are free.
    fix
        The usual coefficients are free, without these.
    out
        Result folder; default runs/ and the time.
    resume
        Go on from the checkpoint in the result folder.
    force
        Search although the check before it failed.
    cross_validate
        Also leave each fitted flight out in turn, and tabulate how the others predict it.
    seed
        Of everything random.
    """
    from tuner.cli.progress import listening, print_run
    from tuner.config import Options
    from tuner.job.run import run

    options = Options(
        flights,
        holdout=holdout,
        vehicle=vehicle,
        controller=controller,
        mass=mass,
        config=config,
        topics=topics,
        namespace=namespace,
        fit=fit,
        fix=fix,
        method=method,
        seed=seed,
    )
    with listening(quiet=quiet) as listener:
        folder, result = run(
            options,
            out=out,
            resume=resume,
            force=force,
            cross_validated=cross_validate,
            listener=listener,
            command=TYPED.get(),
        )
    if not quiet:
        print_run(folder, result)
