import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tuner.config import configs_folder, find_config
from tuner.errors import ConfigError

ROOT = Path(__file__).resolve().parents[3]


def test_a_checkout_reads_the_folder_at_its_root():
    assert configs_folder() == ROOT / "configs"


def test_a_path_is_a_path_and_a_bare_name_is_a_shipped_file(tmp_path):
    assert find_config("vehicles", "v.yaml", tmp_path) == tmp_path / "v.yaml"
    assert find_config("vehicles", "sub/v", tmp_path) == tmp_path / "sub" / "v"
    shipped = configs_folder() / "vehicles" / "hovergames.yaml"
    assert find_config("vehicles", "hovergames", tmp_path) == shipped
    (tmp_path / "hovergames").touch()
    assert find_config("vehicles", "hovergames", tmp_path) == tmp_path / "hovergames"
    with pytest.raises(ConfigError, match="did you mean 'hovergames'"):
        find_config("vehicles", "hovergaems", tmp_path)


def test_an_installed_wheel_carries_the_configuration(tmp_path):
    pytest.importorskip("setuptools", minversion="77")
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "LICENSE", "README.md"):
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, source)
    for name in ("configs", "tuner", "sim_jax"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = "from setuptools import build_meta; print(build_meta.build_wheel('../dist'))"
    (tmp_path / "dist").mkdir()
    subprocess.run([sys.executable, "-c", build], cwd=source, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    shutil.unpack_archive(wheel, tmp_path / "site", "zip")
    for folder in ("tuner", "sim_jax"):
        for file in (ROOT / folder).rglob("*"):
            if file.is_file() and file.suffix != ".pyc":
                assert (tmp_path / "site" / file.relative_to(ROOT)).exists(), file

    show = (
        "import tuner; from tuner.config import *; print(tuner.__file__);"
        "print(read_vehicle(find_config('vehicles', 'hovergames', configs_folder())).name);"
        "print(read_job(configs_folder() / 'tune.yaml').mass);"
        "from tuner.flights.topics import load_topic_map;"
        "print(load_topic_map('thesis_lab').name)"
    )
    outcome = subprocess.run(
        [sys.executable, "-c", show],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "site")},
        check=True,
        capture_output=True,
        text=True,
    )
    where, vehicle, mass, topics = outcome.stdout.splitlines()
    assert where == str(tmp_path / "site" / "tuner" / "__init__.py")
    assert (vehicle, mass, topics) == ("hovergames", "2.243", "thesis_lab")
