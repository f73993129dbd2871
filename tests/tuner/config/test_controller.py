import pytest

from tuner.core.errors import ConfigError
from tuner.core.shipped import configs_folder
from tuner.vehicle import ControllerFile, read_controller


def read(tmp_path, text):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    return read_controller(path)


def test_the_shipped_default_file_spells_out_the_defaults():
    path = configs_folder() / "controllers" / "hovergames.yaml"
    assert read_controller(path) == ControllerFile()
    assert read_controller(path).model_fields_set == set(ControllerFile.model_fields)


def test_the_launch_gains_of_the_hovergames():
    c = ControllerFile()
    assert (c.position.kp, c.position.kv) == ((10, 10, 20), (5, 5, 10))
    assert (c.position.max_feedback_acceleration, c.position.rate) == (10, 100)
    assert (c.attitude.law, c.attitude.time_constant) == ("quaternion", 0.3)
    assert (c.thrust.normalized_constant, c.thrust.normalized_offset) == (0.06, 0.1)
    assert (c.rate.roll.p, c.rate.roll.i, c.rate.roll.d) == (0.18, 0.15, 0.003)
    assert (c.rate.pitch.p, c.rate.pitch.i, c.rate.pitch.d) == (0.18, 0.15, 0.003)
    assert (c.rate.yaw.p, c.rate.yaw.i, c.rate.yaw.d, c.rate.yaw.k) == (0.2, 0.1, 0.0, 1.0)
    assert (c.rate.integrator_limit, c.rate.rate) == (0.3, 400)
    assert (c.filters.gyro_cutoff, c.filters.dgyro_cutoff) == (40, 20)
    assert (c.mixer.airmode, c.mixer.thrust_factor, c.physics.rate) == (0, 0, 400)


def test_sitl_runs_at_250_hz():
    c = read_controller(configs_folder() / "controllers" / "hovergames_sitl.yaml")
    assert (c.rate.rate, c.physics.rate, c.position.rate) == (250, 250, 100)
    assert c.rate.roll == ControllerFile().rate.roll


def test_parts_left_out_keep_their_defaults(tmp_path):
    c = read(tmp_path, "rate: {yaw: {p: 0.3}}\nfilters: {gyro_cutoff: null}\nmixer:\n")
    assert (c.rate.yaw.p, c.rate.yaw.i) == (0.3, 0.1)
    assert (c.filters.gyro_cutoff, c.filters.dgyro_cutoff) == (None, 20)
    assert c.rate.roll == ControllerFile().rate.roll


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("attitude: {law: so3}", "attitude.law is 'so3'; it should be 'quaternion'"),
        ("rate: {rol: {p: 1}}", "unknown key 'rate.rol'; did you mean 'roll'?"),
        ("rate: {roll: {p: -1}}", "rate.roll.p is -1"),
        ("position: {kp: 10}", "position.kp is 10"),
        ("mixer: {airmode: 3}", "mixer.airmode is 3"),
        ("position: {rate: 0.4}", "position.rate is 0.4; it should be at least 1"),
        ("physics: {rate: 1.0e+9}", "physics.rate is 1000000000.0; it should be at most 10000"),
        ("rate: {rate: 1000}", "rate.rate is 1000 Hz, faster than physics.rate 400 Hz"),
        ("filters: {gyro_cutoff: 200}", "filters.gyro_cutoff is 200 Hz, not below half"),
        ("position: {velocity_yaw: 1}", "position.velocity_yaw is 1"),
    ],
)
def test_a_wrong_value_is_named(tmp_path, text, expected):
    with pytest.raises(ConfigError) as error:
        read(tmp_path, text)
    assert expected in str(error.value)
