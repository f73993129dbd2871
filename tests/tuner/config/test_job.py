import re

import pytest

from tuner.config import (
    CHANNELS,
    CoefficientSettings,
    ExportSettings,
    FlightSettings,
    JobFile,
    Search,
    TrajectorySettings,
    read_job,
)
from tuner.core.errors import ConfigError
from tuner.core.shipped import configs_folder


def read(tmp_path, text):
    path = tmp_path / "tune.yaml"
    path.write_text(text)
    return read_job(path)


def test_the_annotated_example_is_read_and_leaves_nothing_out():
    path = configs_folder() / "tune.yaml"
    job = read_job(path)
    text = path.read_text(encoding="utf-8")
    assert job.model_fields_set == set(JobFile.model_fields)
    for section in (
        CoefficientSettings,
        ExportSettings,
        FlightSettings,
        Search,
        TrajectorySettings,
    ):
        for key in section.model_fields:
            assert re.search(rf"^ +{key}:", text, re.MULTILINE), f"{section.__name__}.{key}"
    assert job.search == Search()
    assert job.flights["yaw_spin_3rps"].trajectory == TrajectorySettings(
        name="yaw_spin", yaw_rate=3.0
    )
    assert job.coefficients["motor_constant"].prior.sd == 0.4e-5


def test_nothing_is_required(tmp_path):
    assert read(tmp_path, "") == JobFile()


def test_paths_count_from_the_job_file_and_bare_names_are_shipped_files(tmp_path):
    job = read(
        tmp_path, "vehicle: sub/v.yaml\ncontroller: hovergames_sitl\nexport: {into: ../m.sdf}\n"
    )
    assert job.vehicle == tmp_path / "sub" / "v.yaml"
    assert job.controller == configs_folder() / "controllers" / "hovergames_sitl.yaml"
    assert job.export.into == tmp_path / ".." / "m.sdf"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("vehicel: x.yaml", "unknown key 'vehicel'; did you mean 'vehicle'?"),
        ("priors: {mass: 2}", "unknown key 'priors'; known are channels, "),
        ("vehicle: hovergame", "did you mean 'hovergames'?"),
        ("free: [motor_constan]", "unknown coefficient 'motor_constan'; did you mean"),
        ("search: {seed: 12345678901}", "search.seed is 12345678901; it should be at most"),
        ("mass: 2243", "mass is 2243; it should be at most 500"),
        ("free: [mass]\nfixed: [mass]", "both 'free' and 'fixed' are given"),
        ("terms: [linear_drag]\nfixed: [linear_drag_y]", "'linear_drag_y' is both among terms and"),
        ("free: []", "free is []"),
        ("free: [mass, mass]", "free names 'mass' twice"),
        ("coefficients: {mas: {lower: 1}}", "unknown coefficient 'mas'"),
        ("coefficients: {mass: {lower: 2, upper: 1}}", "lower 2 is not below upper 1"),
        ("coefficients: {mass: {lower: 0, scale: log}}", "lower 0 has no logarithm"),
        ("coefficients: {mass: {prior: {mean: 2}}}", "coefficients.mass.prior.sd' is missing"),
        ("coefficients: {mass: {prior: {mean: 2, sd: 0}}}", "coefficients.mass.prior.sd is 0"),
        ("ties: [[inertia_xx]]", "ties[0] is ['inertia_xx']"),
        ("ties: [[inertia_xx, inertia_yy], [inertia_yy, mass]]", "ties names 'inertia_yy' twice"),
        ("channels: {positon: true}", "unknown channel 'positon'; did you mean 'position'?"),
        ("weights: {position: -1}", "weights.position is -1"),
        ("weights: {position: 1.0e+300}", "weights.position is 1e+300; it should be at most"),
        ("inlet: motors", "inlet is 'motors'"),
        ("search: {method: newton}", "search.method is 'newton'"),
        ("search: {starts: 0}", "search.starts is 0"),
        ("time_offset: 12", "time_offset is 12; it should be at most 10"),
        ("search: {seed: 1.5}", "search.seed is 1.5"),
        ("flights: {a: {trajectory: {name: square}}}", "there is no trajectory 'square'"),
        ("export: {formats: [urdf]}", "unknown export format 'urdf'; did you mean 'sdf'?"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(tmp_path, text, expected):
    with pytest.raises(ConfigError) as error:
        read(tmp_path, text)
    assert expected in str(error.value)
    assert str(tmp_path / "tune.yaml") in str(error.value)


def test_every_channel_off_is_refused(tmp_path):
    channels = "".join(f"  {name}: false\n" for name in CHANNELS)
    with pytest.raises(ConfigError, match="every channel is switched off"):
        read(tmp_path, "channels:\n" + channels)
