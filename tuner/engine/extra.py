"""What ``pip install multirotor-tune[cluster]`` brings, imported when it is needed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tuner.core.errors import InputError

PACKAGES = ("dask", "distributed", "dask_jobqueue", "dask_kubernetes", "cloudpickle", "fsspec")


@contextmanager
def extra() -> Iterator[None]:
    """Turn a missing package of the extra, imported inside, into one line.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in PACKAGES:
            raise
        raise InputError(
            "--workers and --cluster",
            f"need {package}, which is not installed",
            "pip install 'multirotor-tune[cluster]'",
        ) from None
