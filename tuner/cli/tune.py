"""``tune --flights ...``: the job itself."""

from __future__ import annotations

import time
from pathlib import Path

from tuner.cli.options import TYPED, Cluster, FitOptions, Quiet, Switch, Verbose, Workers


def tune(
    *,
    fitted: FitOptions,
    bench: str | None = None,
    out: Path | None = None,
    resume: Switch = False,
    force: Switch = False,
    cross_validate: Switch = False,
    bootstrap: int | None = None,
    workers: Workers = None,
    cluster: Cluster = None,
    dry_run: Switch = False,
    profile: Switch = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fit the coefficients, validate them on held-out flights, and write the report.

    Parameters
    ----------
    bench
        Start from these ground measurements, a result folder of tune bench, and fit with them as
        prior; conflicts between ground and flights are named.
    out
        Write into this result folder. Default: runs/ and the time.
    resume
        Continue the search that was interrupted in the result folder from its checkpoint.
    force
        Search even where the check before the search reports a failure.
    cross_validate
        Also fit without each flight in turn, tabulate how well the other flights predict it, and
        give the jackknife's standard errors.
    bootstrap
        Also fit so many times to flights drawn with replacement, and give the standard errors that
        follow.
    dry_run
        Print the job script that would bring the cluster file's workers, and do nothing.
    profile
        Measure where the seconds go: a table by stage, on the terminal and in profile.csv, and
        profile.json, a trace that https://ui.perfetto.dev opens.
    """
    from tuner.engine.choose import engine_for, job_script_for

    if dry_run:
        print(job_script_for(cluster))
        return
    began = time.perf_counter()
    from tuner.cli.profile import profiling
    from tuner.core.spans import span

    with profiling(profile, quiet=quiet) as profile_into:
        with span("import"):
            from tuner.cli.progress import listening
            from tuner.cli.results import print_bench, print_run
            from tuner.core.runtime import configure

            configure()
            from tuner.config import settle
            from tuner.job.run import run
            from tuner.job.without_pose import fit_without_pose, without_pose

        options = fitted.options(bench=bench)
        with span("reading"):
            bare, left_out = without_pose(settle(options))
        if bare:
            with listening(quiet=quiet, verbose=verbose) as listener:
                measured = fit_without_pose(
                    settle(options),
                    bare,
                    left_out=left_out,
                    out=out,
                    listener=listener,
                    command=TYPED.get(),
                )
            profile_into(measured.folder)
            if not quiet:
                print_bench(measured, verbose=verbose)
            return
        with engine_for(workers, cluster), listening(quiet=quiet, verbose=verbose) as listener:
            folder, result = run(
                options,
                out=out,
                resume=resume,
                force=force,
                cross_validated=cross_validate,
                refits=bootstrap,
                listener=listener,
                command=TYPED.get(),
            )
        profile_into(folder)
        if not quiet:
            print_run(folder, result, seconds=time.perf_counter() - began, verbose=verbose)
