"""Dask's clusters from a cluster file."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import dask.config
from distributed import Client, LocalCluster
from distributed.security import Security

from tuner.core.errors import InputError
from tuner.engine.cluster_file import ClusterFile, JobQueue, Kubernetes, extra

ANSWER = 10
"""s within which a scheduler answers."""
SPARING = {
    "distributed": {
        "worker": {"profile": {"enabled": False}},
        "admin": {"tick": {"interval": "500ms"}},
    }
}
"""What local workers' cores are spared, unless the user's Dask configuration says otherwise: looks
at the stack a hundred times a second, and at each event loop's delay fifty times."""
dask.config.update_defaults(SPARING)
CLASSES = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "lsf": "LSFCluster",
    "sge": "SGECluster",
}


def cluster_of(file: ClusterFile) -> AbstractContextManager[Any]:
    """Return the cluster that a file asks for: started on entering, ended on leaving.

    Raises
    ------
    InputError
        What it needs is not installed, or does not start.
    """
    if file.address is not None:
        return contextlib.nullcontext(file.address)
    if file.jobs is not None:
        return _jobs(file, file.jobs)
    if file.kubernetes is not None:
        return _kubernetes(file, file.kubernetes)
    cluster: AbstractContextManager[Any] = LocalCluster(
        n_workers=file.workers,
        threads_per_worker=1,
        memory_limit=file.memory or "auto",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL + 1,
    )
    return cluster


@contextlib.contextmanager
def connected(cluster: Any, file: ClusterFile) -> Iterator[Client]:
    """Yield a client of a cluster.

    Raises
    ------
    InputError
        No scheduler answers.
    """
    security = None
    if file.tls is not None:
        security = Security(
            tls_ca_file=str(file.tls.ca),
            tls_client_cert=str(file.tls.certificate),
            tls_client_key=str(file.tls.key),
            require_encryption=True,
        )
    try:
        client = Client(cluster, timeout=ANSWER, security=security, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise InputError(
            f"--cluster {file.address or ''}".strip(),
            f"no scheduler answers ({' '.join(str(error).split())})",
            "start it, or correct the address",
        ) from None
    try:
        yield client
    finally:
        with contextlib.suppress(OSError, TimeoutError, RuntimeError):
            client.close()


def job_script(file: ClusterFile, jobs: JobQueue) -> str:
    """Return the job script with which a batch system would start a worker; none is submitted."""
    with _jobs(file, jobs, submit=False) as cluster:
        return str(cluster.job_script())


def _jobs(file: ClusterFile, jobs: JobQueue, *, submit: bool = True) -> AbstractContextManager[Any]:
    with extra():
        import dask_jobqueue  # noqa: PLC0415 (few need it)

    kind = getattr(dask_jobqueue, CLASSES[jobs.system])
    options = {
        "queue": jobs.queue,
        "account": jobs.account,
        "walltime": jobs.walltime,
        "job_extra_directives": list(jobs.directives),
        "job_script_prologue": list(jobs.prologue),
        "python": jobs.python,
        "interface": jobs.interface,
        "local_directory": jobs.scratch,
        "log_directory": None if jobs.logs is None else str(Path(jobs.logs).expanduser()),
    }
    cluster: AbstractContextManager[Any] = kind(
        n_workers=file.workers if submit else 0,
        cores=file.cores,
        processes=1,
        worker_extra_args=["--nthreads", "1"] if file.cores > 1 else [],
        memory=file.memory,
        job_name="tune",
        silence_logs="error",
        **{key: value for key, value in options.items() if value is not None},
    )
    return cluster


def _kubernetes(file: ClusterFile, pods: Kubernetes) -> AbstractContextManager[Any]:
    with extra():
        from dask_kubernetes.operator import KubeCluster  # noqa: PLC0415 (few need it)

    return contextlib.closing(KubeCluster(custom_cluster_spec=pod_specification(file, pods)))


def pod_specification(file: ClusterFile, pods: Kubernetes) -> dict[str, Any]:
    """Return the Dask cluster that dask_kubernetes' operator is asked for."""
    with extra():
        from dask_kubernetes.operator import make_cluster_spec  # noqa: PLC0415 (few need it)

    specification: dict[str, Any] = make_cluster_spec(
        name=pods.name,
        image=pods.image,
        n_workers=file.workers,
        resources={
            "requests": {"cpu": str(file.cores), "memory": _quantity(file)},
            "limits": {"cpu": str(file.cores), "memory": _quantity(file)},
        },
        worker_command="dask worker --nthreads 1",
    )
    if pods.namespace is not None:
        specification["metadata"]["namespace"] = pods.namespace
    return specification


def _quantity(file: ClusterFile) -> str:
    """Return the memory as Kubernetes writes it: 2Gi, 500M."""
    assert file.memory is not None
    return file.memory.replace(" ", "").removesuffix("B")
