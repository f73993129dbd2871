"""``tune --flights ...``: the job itself."""

from __future__ import annotations

import time
from typing import Annotated

from tuner.cli.options import FLATTENED, TYPED_WORDS, Quiet, Verbose
from tuner.options import Options


def tune(
    *,
    options: Annotated[Options, FLATTENED],
    dry_run: bool = False,
    profile: bool = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fit the coefficients, validate them on held-out flights, and write the report.

    Parameters
    ----------
    dry_run
        Print the job script that would bring the cluster file's workers, and do nothing.
    profile
        Measure where the seconds go: a table by stage, on the terminal and in profile.csv, and
        profile.json, a trace that https://ui.perfetto.dev opens.
    """
    from tuner.engine.cluster_file import engine_for, job_script_for

    if dry_run:
        print(job_script_for(options.cluster))
        return
    began = time.perf_counter()
    from tuner.cli.profile import profiling
    from tuner.core.spans import span

    with profiling(profile, quiet=quiet) as profile_into:
        with span("import"):
            from tuner.cli.progress import progress_on_terminal
            from tuner.cli.results import print_run
            from tuner.core.runtime import configure

            configure()
            from tuner.config import resolve_settings
            from tuner.job.run import run
            from tuner.search.job_flights import read_inertial_flights

        with span("reading"):
            bare, left_out = read_inertial_flights(resolve_settings(options))
        told = progress_on_terminal(quiet=quiet, verbose=verbose)
        if bare:
            from tuner.job.without_pose import fit_without_pose

            with told as listener:
                measured = fit_without_pose(
                    resolve_settings(options),
                    bare,
                    left_out=left_out,
                    out=options.out,
                    listener=listener,
                    command=TYPED_WORDS.get(),
                )
            folder, result = measured.folder, measured.result
        else:
            with engine_for(options.workers, options.cluster), told as listener:
                folder, result = run(
                    options,
                    out=options.out,
                    resume=options.resume,
                    listener=listener,
                    command=TYPED_WORDS.get(),
                )
        profile_into(folder)
        if not quiet:
            print_run(folder, result, seconds=time.perf_counter() - began, verbose=verbose)
