"""The engine that ``--workers`` and ``--cluster`` name."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from tuner.core.errors import ConfigError, InputError
from tuner.core.yaml_section import build
from tuner.engine.cluster_file import ClusterFile, read_cluster
from tuner.engine.engine import HERE, Engine, using

PACKAGES = ("dask", "distributed", "dask_jobqueue", "dask_kubernetes", "cloudpickle", "fsspec")


@contextmanager
def extra() -> Iterator[None]:
    """Turn a missing package of ``multirotor-tune[cluster]``, imported inside, into one line.

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


def cluster_for(workers: int | None, cluster: str | None) -> ClusterFile | None:
    """Return the cluster that the options name; None for this process.

    Raises
    ------
    ConfigError
        They contradict each other, or the cluster file cannot be used.
    """
    if cluster is None:
        return None if workers is None else build(ClusterFile, {"workers": workers}, "--workers")
    if workers is not None:
        raise ConfigError("--workers", "cannot stand beside --cluster", "give one of them")
    return read_cluster(cluster)


@contextmanager
def engine_for(workers: int | None = None, cluster: str | None = None) -> Iterator[Engine]:
    """Start the engine that the options name, put it in force, and end it.

    Parameters
    ----------
    workers
        Local processes; None and no cluster is this process.
    cluster
        A cluster file, or the address of a scheduler.

    Raises
    ------
    InputError
        An option cannot be used, or no scheduler answers.
    """
    chosen = cluster_for(workers, cluster)
    if chosen is None:
        with using(HERE) as engine:
            yield engine
        return
    with extra():
        _quiet_dask()
        from tuner.engine.dask_engine import on_dask  # noqa: PLC0415 (slow to import)

    with on_dask(chosen) as engine, using(engine):
        yield engine


def job_script_for(cluster: str | None) -> str:
    """Return the job script that a cluster file's batch system would be given.

    Raises
    ------
    ConfigError
        There is no cluster file, or it names no batch system.
    """
    file = cluster_for(None, cluster)
    if file is None or file.jobs is None:
        raise ConfigError(
            "--dry-run", "prints the job script of a batch system", "name one with --cluster FILE"
        )
    with extra():
        _quiet_dask()
        from tuner.engine.clusters import job_script  # noqa: PLC0415 (slow to import)

    return job_script(file, file.jobs)


def _quiet_dask() -> None:
    """Have Dask log nothing, unless the user has set that otherwise: what fails is raised."""
    import dask.config  # noqa: PLC0415 (an extra)

    dask.config.update_defaults({"logging": {"distributed": logging.CRITICAL + 1}})
