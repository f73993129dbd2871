import contextlib
import os
import socket
import sys
from types import SimpleNamespace

import pytest

from tuner.cli import main
from tuner.core.errors import ConfigError, InputError
from tuner.core.shipped import configs_folder
from tuner.engine import dask_engine
from tuner.engine.dask_engine import dask, pod_specification
from tuner.engine.engine import ClusterFile, job_script_for, read_cluster

FOLDER = configs_folder() / "clusters"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_cluster_files_are_read(path):
    assert read_cluster(str(path)).workers >= 1


def test_an_address_stands_for_a_file():
    assert read_cluster("tcp://node1:8786") == ClusterFile(address="tcp://node1:8786")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("workers: 0", "workers is 0"),
        ("worker: 2", "unknown key 'worker'; did you mean 'workers'"),
        ("memory: lots", "memory is 'lots'"),
        ("jobs: {system: slurm}", "'jobs' needs the memory of a worker"),
        ("jobs: {system: slurn}\nmemory: 1GiB", "jobs.system is 'slurn'"),
        ("address: node1", "address is 'node1'"),
        ("address: tcp://a:1\nkubernetes: {image: x}", "both 'address' and 'kubernetes'"),
        ("tls: {ca: a, certificate: b, key: c}", "'tls' belongs to an address"),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, text, complaint):
    path = tmp_path / "cluster.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_cluster(str(path))
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_certificates_lie_beside_the_file(tmp_path):
    path = tmp_path / "cluster.yaml"
    path.write_text("address: tls://a:1\ntls: {ca: ca.pem, certificate: me.pem, key: /k.pem}")
    tls = read_cluster(str(path)).tls
    assert tls is not None
    assert (tls.ca, str(tls.key)) == (tmp_path / "ca.pem", "/k.pem")


def test_the_dry_run_prints_what_slurm_would_be_given(capsys):
    path = FOLDER / "slurm.yaml"
    assert main(["--flights", "x.bag", "--cluster", str(path), "--dry-run"]) == 0
    script = capsys.readouterr().out
    for line in (
        "#SBATCH -J tune",
        "#SBATCH -p main",
        "#SBATCH -A lab",
        "#SBATCH --cpus-per-task=1",
        "#SBATCH --mem=4G",
        "#SBATCH -t 01:00:00",
        "#SBATCH --nice=100",
        "module load python/3.11",
    ):
        assert line in script.splitlines()
    (worker,) = (line for line in script.splitlines() if "dask_worker" in line)
    assert worker.startswith(f"{sys.executable} -m distributed.cli.dask_worker tcp://")
    assert "--nthreads 1 --memory-limit 4.00GiB --nanny" in worker


@pytest.mark.parametrize("system", ["pbs", "lsf", "sge"])
def test_other_batch_systems_have_scripts(tmp_path, system):
    path = tmp_path / "cluster.yaml"
    path.write_text(f"memory: 2GiB\njobs: {{system: {system}, walltime: '00:30'}}")
    assert "distributed.cli.dask_worker" in job_script_for(str(path))


def test_a_job_script_needs_no_port_of_its_own():
    with socket.socket() as other:
        with contextlib.suppress(OSError):  # it is taken already
            other.bind(("", 8787))  # where Dask's dashboard would be
            other.listen()
        assert "#SBATCH" in job_script_for(str(FOLDER / "slurm.yaml"))


def test_the_scheduler_has_the_options_of_dasks_own_file():
    with dask.config.set({"jobqueue.slurm.scheduler-options": {"port": 0, "host": "127.0.0.2"}}):
        assert "tcp://127.0.0.2:" in job_script_for(str(FOLDER / "slurm.yaml"))


def test_a_dry_run_without_a_batch_system_is_one_line():
    for cluster in (None, str(FOLDER / "local.yaml")):
        with pytest.raises(ConfigError, match="--dry-run: prints the job script"):
            job_script_for(cluster)


def test_pods_get_the_memory_and_cores_of_the_file():
    file = read_cluster(str(FOLDER / "kubernetes.yaml"))
    assert file.kubernetes is not None
    specification = pod_specification(file, file.kubernetes)
    assert specification["metadata"] == {"name": "tune", "namespace": "tune"}
    worker = specification["spec"]["worker"]
    assert worker["replicas"] == 16
    (container,) = worker["spec"]["containers"]
    assert container["image"] == "registry.example.org/multirotor-tune:latest"
    assert container["resources"]["limits"] == {"cpu": "1", "memory": "4Gi"}


def test_a_missing_extra_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask", None)
    monkeypatch.setitem(sys.modules, "dask.config", None)
    with pytest.raises(InputError, match=r"need dask.*pip install 'multirotor-tune\[cluster\]'"):
        job_script_for(str(FOLDER / "slurm.yaml"))


def test_workers_take_gpus_in_turn_though_their_starter_keeps_to_the_processor(monkeypatch):
    monkeypatch.setattr(dask_engine, "configure", lambda: None)
    for name, gpu in {0: "0", 1: "1", 4: "1"}.items():
        monkeypatch.setattr(os, "environ", {"JAX_PLATFORMS": "cpu"})
        dask_engine.WorkerSetup(gpus=3).setup(SimpleNamespace(name=name))
        assert os.environ["CUDA_VISIBLE_DEVICES"] == gpu
        assert os.environ["JAX_PLATFORMS"] == ""
        assert os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"
