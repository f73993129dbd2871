import math

import pytest

from tuner.errors import ExportError
from tuner.exporters.draft import write
from tuner.exporters.target import Choices
from tuner.exporters.targets.px4 import Parameter, parameters, px4_draft, read_parameters


def value(vehicle):
    return {parameter.name: parameter.value for parameter in parameters(vehicle)}


def test_rotors_are_in_px4s_frame_forward_right_down(vehicle):
    values = value(vehicle)
    places = [[values[f"CA_ROTOR{i}_{axis}"] for axis in ("PX", "PY", "PZ")] for i in range(4)]
    assert places == [
        [0.17678, 0.17678, -0.06],
        [-0.17678, -0.17678, -0.06],
        [0.17678, -0.17678, -0.06],
        [-0.17678, 0.17678, -0.06],
    ]
    assert [values[f"CA_ROTOR{i}_KM"] for i in range(4)] == [0.033, 0.033, -0.033, -0.033]
    assert values["CA_ROTOR_COUNT"] == 4


def test_full_thrust_and_torque(vehicle):
    values = value(vehicle)
    thrust = 1.45e-5 * 1050**2
    assert values["CA_ROTOR0_CT"] == pytest.approx(thrust, rel=1e-6)
    assert values["SIH_T_MAX"] == pytest.approx(thrust, rel=1e-6)
    assert values["SIH_Q_MAX"] == pytest.approx(thrust * 0.033, rel=1e-6)
    limited = vehicle.replace(motor=vehicle.motor.replace(max_rotor_velocity=1000.0))
    assert value(limited)["SIH_T_MAX"] == pytest.approx(14.5, rel=1e-6)


def test_the_simulation_in_hardware_gets_the_body(vehicle):
    values = value(vehicle)
    assert (values["SIH_MASS"], values["SIH_IXX"], values["SIH_IYY"], values["SIH_IZZ"]) == (
        2.243,
        0.028,
        0.033,
        0.038,
    )
    assert (values["SIH_L_ROLL"], values["SIH_L_PITCH"]) == (0.17678, 0.17678)
    hover = math.sqrt(2.243 * 9.81 / 4 / 1.45e-5)
    assert values["SIH_KDV"] == pytest.approx(4 * hover * 1.45e-4, rel=1e-6)
    assert values["SIH_T_TAU"] == pytest.approx(0.01875)


def test_hover_command_carries_the_weight(vehicle):
    hover = value(vehicle)["MPC_THR_HOVER"]
    assert 4 * 1.45e-5 * (950 * hover + 100) ** 2 == pytest.approx(2.243 * 9.81, rel=1e-6)
    curved = vehicle.replace(motor=vehicle.motor.replace(quadratic=-200.0, input_offset=0.02))
    hover = value(curved)["MPC_THR_HOVER"]
    speed = 950 * (hover + 0.02) + 100 - 200 * (hover + 0.02) ** 2
    assert 4 * 1.45e-5 * speed**2 == pytest.approx(2.243 * 9.81, rel=1e-6)


def test_the_gz_bridge_gets_whole_speeds(vehicle):
    values = value(vehicle)
    assert [values[f"SIM_GZ_EC_MIN{i}"] for i in range(1, 5)] == [100] * 4
    assert [values[f"SIM_GZ_EC_MAX{i}"] for i in range(1, 5)] == [1050] * 4
    assert isinstance(values["SIM_GZ_EC_MAX1"], int)


def test_a_vehicle_too_heavy_to_hover_is_refused(vehicle):
    with pytest.raises(ExportError, match="cannot hover"):
        px4_draft(vehicle.replace(mass=20.0), "", Choices())


def test_the_file_is_what_ground_stations_load(vehicle, tmp_path):
    path = tmp_path / "x.params"
    draft = px4_draft(vehicle, "by a test", Choices())
    write(draft, path)
    lines = path.read_text().splitlines()
    assert lines[0] == "# by a test"
    assert "1\t1\tSIH_MASS\t2.243\t9" in lines
    assert "1\t1\tSIM_GZ_EC_MIN1\t100\t6" in lines
    again = read_parameters(path)
    assert {p.name for p in again} == {p.name for p in parameters(vehicle)}
    assert Parameter("SIH_MASS", 2.243) in again


def test_a_changed_file_does_not_read_back(vehicle, tmp_path):
    path = tmp_path / "x.params"
    draft = px4_draft(vehicle, "by a test", Choices())
    path.write_text(draft.text.replace("2.243", "2.244"))
    assert draft.faults(path) == ["SIH_MASS is 2.244, not 2.243"]
    path.write_text(draft.text.replace("1\t1\tSIH_MASS\t2.243\t9\n", ""))
    assert draft.faults(path) == ["SIH_MASS is None, not 2.243"]
    path.write_text("1 1 SIH_MASS\n")
    with pytest.raises(ExportError, match="SIH_MASS"):
        draft.faults(path)


def test_a_hover_command_that_px4_refuses_is_said(vehicle):
    heavy = px4_draft(vehicle.replace(mass=5.2), "", Choices())
    assert any("outside what PX4 accepts" in note for note in heavy.notes)
    assert not any("outside" in note for note in px4_draft(vehicle, "", Choices()).notes)
