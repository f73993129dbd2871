"""``tune submit``: the job, on a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tuner.cli.options import (
    ControllerChoice,
    Flights,
    JobChoice,
    Many,
    Mass,
    Namespace,
    Quiet,
    Topics,
    VehicleChoice,
)
from tuner.cli.server_options import Server, Token, client_of, show
from tuner.cli.tune import Method


def submit(
    *,
    flights: Flights,
    server: Server = None,
    token: Token = None,
    wait: Annotated[bool, Parameter(negative=())] = False,
    out: Path | None = None,
    name: str = "",
    holdout: Annotated[list[str] | None, Many] = None,
    vehicle: VehicleChoice = None,
    controller: ControllerChoice = None,
    mass: Mass = None,
    config: JobChoice = None,
    topics: Topics = None,
    namespace: Namespace = None,
    fit: Annotated[list[str] | None, Many] = None,
    fix: Annotated[list[str] | None, Many] = None,
    method: Method = None,
    force: Annotated[bool, Parameter(negative=())] = False,
    cross_validate: Annotated[bool, Parameter(negative=())] = False,
    bootstrap: int | None = None,
    seed: int | None = None,
    quiet: Quiet = False,
) -> None:
    """Send recordings to a server and have it fit them, as tune does on this machine.

    Parameters
    ----------
    wait
        Wait for the end, show what happens, and fetch the result, as tune does.
    out
        With --wait, fetch the result into this folder. Default: runs/ and the time.
    name
        Call the job so in lists.
    holdout
        Evaluate these flights without fitting them.
    fit
        Fit exactly these coefficients.
    fix
        Fit the usual coefficients except these.
    force
        Search even where the check before the search reports a failure.
    cross_validate
        Also fit without each flight in turn.
    bootstrap
        Also fit so many times to flights drawn with replacement.
    seed
        Start the random numbers from this seed. Default: the job file's, else 0.
    """
    from tuner.cli.progress import listening
    from tuner.cli.results import print_run
    from tuner.client.client import ended_well
    from tuner.config import Options
    from tuner.job.folder import folder_for

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
    with client_of(server, token) as client:
        folder = folder_for(out) if wait else None
        job = client.submit(
            options, name=name, force=force, cross_validate=cross_validate, bootstrap=bootstrap
        )
        if folder is None:
            print(job if quiet else f"job {job}: {client.url}/jobs/{job}")
            return
        try:
            with listening(quiet=quiet) as listener:
                show(client.follow(job), listener)
        except KeyboardInterrupt:
            if not quiet:
                print(f"Job {job} goes on at the server: tune watch {job}, or tune cancel {job}.")
            raise
        ended_well(client.job(job))
        run = client.fetch(job, folder)
    if not quiet:
        print_run(folder, run.result)
