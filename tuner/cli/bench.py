"""``tune bench``: ground measurements into coefficients."""

from __future__ import annotations

from pathlib import Path

from tuner.cli.options import TYPED, Quiet, Verbose


def bench(
    file: Path, /, *, out: Path | None = None, quiet: Quiet = False, verbose: Verbose = False
) -> None:
    """Estimate coefficients from ground measurements, combine them and test whether they agree.

    Parameters
    ----------
    file
        The list of experiments, bench.yaml.
    out
        Write into this result folder. Default: runs/ and the time.
    """
    from tuner.job.ground import bench as run_bench

    result = run_bench(file, out=out, command=TYPED.get())
    if not quiet:
        from tuner.cli.results import print_bench

        print_bench(result, verbose=verbose)
