"""``tune --flights ...``: the job itself, and parameters that commands share."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextvars import ContextVar
from importlib import import_module
from typing import Annotated, Any, get_args

from cyclopts import CoercionError, Parameter, Token, convert

from tuner.core.errors import InputError
from tuner.options import Options

#: The command line as the user typed it, for the record of a run.
TYPED_WORDS: ContextVar[str] = ContextVar("TYPED", default="")


def _exactly(kind: Any, words: Sequence[Token]) -> Any:
    """Return the values of words without rounding: ``1.7`` is no whole number."""
    if int in (kind, *get_args(kind)) and not all(w.value.strip("+-").isdecimal() for w in words):
        raise CoercionError(token=words[0], target_type=int)
    return convert(kind, words)


#: An option takes all words up to the next option, and a switch takes none.
MANY_WORDS = Parameter(consume_multiple=True, negative=(), converter=_exactly)
#: The fields of a class of `tuner.options` are options of the command.
FLATTENED = Parameter(name="*")
Quiet = Annotated[bool, Parameter(help="Print nothing but errors.")]
Verbose = Annotated[bool, Parameter(help="Print all that the report says, and each message.")]


def arena_lengths(word: str) -> tuple[float, ...]:
    """Return the numbers of ``--arena``, such as ``8,6,3``.

    Raises
    ------
    InputError
        The word holds anything but numbers above zero.
    """
    try:
        numbers = tuple(float(part) for part in word.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(math.isfinite(n) and n > 0 for n in numbers):
        raise InputError("--arena", f"'{word}' is not a list of lengths in m", "write it as 8,6,3")
    return numbers


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
    from tuner.engine.engine import engine_for, job_script_for

    if dry_run:
        print(job_script_for(options.cluster))
        return
    began = time.perf_counter()
    # before the process beside this one, which then has them too
    from tuner.cli.progress import profiling, progress_on_terminal
    from tuner.cli.results import print_run
    from tuner.config import resolve_settings
    from tuner.core.runtime import configure, kernel_folder
    from tuner.core.spans import span
    from tuner.engine.beside import beside, do_beside
    from tuner.recordings.loader import load_flights

    with beside(), profiling(profile, quiet=quiet) as profile_into:
        settings = resolve_settings(options)
        job = settings.job
        for path in reversed(settings.flights):  # the first are read here
            do_beside(load_flights, path, topics=job.topics, namespace=job.namespace)
        if not kernel_folder().exists():  # kernels of the job will be built there
            do_beside(configure)
            do_beside(import_module, "tuner.objective.simulation")
        with span("import"):
            configure()
            from tuner.job.run import run
            from tuner.search.job_flights import read_inertial_flights

        with span("reading"):
            bare, left_out = read_inertial_flights(settings)
        told = progress_on_terminal(quiet=quiet, verbose=verbose)
        if bare:
            from tuner.job.without_pose import fit_without_pose

            with told as listener:
                measured = fit_without_pose(
                    settings,
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
