import math

import pytest

from tuner.core.errors import ExportError
from tuner.exporters.simulators import GZ_SIM
from tuner.exporters.target import write
from tuner.exporters.targets.px4 import (
    SIH,
    outside_range,
    parameters,
    px4_draft,
    read_parameters,
)


def test_rotors_are_in_px4s_frame_forward_right_down(vehicle):
    values = parameters(vehicle, SIH)
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
    values = parameters(vehicle, SIH)
    thrust = 1.45e-5 * 1050**2
    assert values["CA_ROTOR0_CT"] == pytest.approx(thrust, rel=1e-6)
    assert values["SIH_T_MAX"] == pytest.approx(thrust, rel=1e-6)
    assert values["SIH_Q_MAX"] == pytest.approx(thrust * 0.033, rel=1e-6)
    limited = vehicle.replace(motor=vehicle.motor.replace(max_rotor_velocity=1000.0))
    assert parameters(limited, SIH)["SIH_T_MAX"] == pytest.approx(14.5, rel=1e-6)


def test_rotors_that_begin_above_no_command_stand_still_below(vehicle):
    dead = vehicle.replace(motor=vehicle.motor.replace(input_offset=-0.2))
    values = parameters(dead, GZ_SIM)
    assert (values["SIM_GZ_EC_MIN1"], values["SIM_GZ_EC_MAX1"]) == (0, 860)
    assert GZ_SIM.flown(GZ_SIM.flown(dead)) == GZ_SIM.flown(dead)


def test_rotors_too_slow_for_whole_speeds_are_refused(vehicle):
    slow = vehicle.replace(motor=vehicle.motor.replace(max_rotor_velocity=0.001))
    with pytest.raises(ExportError, match="told of whole rad/s; correct its motor"):
        parameters(slow, GZ_SIM)


def test_the_simulation_in_hardware_gets_the_body(vehicle):
    values = parameters(vehicle, SIH)
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


def test_the_hover_is_that_of_the_simulator_in_the_file(vehicle):
    sih = parameters(vehicle, SIH)  # whose thrust is linear in the command
    assert 4 * sih["SIH_T_MAX"] * sih["MPC_THR_HOVER"] == pytest.approx(2.243 * 9.81, rel=1e-6)
    assert not any(name.startswith("SIM_GZ") for name in sih)
    gz = parameters(vehicle, GZ_SIM)
    assert not any(name.startswith("SIH_") for name in gz)
    low, high = gz["SIM_GZ_EC_MIN1"], gz["SIM_GZ_EC_MAX1"]
    unit = 1000 / 1050
    speed = (low + (high - low) * gz["MPC_THR_HOVER"]) / unit
    assert 4 * 1.45e-5 * speed**2 == pytest.approx(2.243 * 9.81, rel=1e-6)


def test_angular_drag_is_written_and_none_is_zero(vehicle):
    assert parameters(vehicle, SIH)["SIH_KDW"] == 0.0  # PX4's default damps
    damped = vehicle.replace(effects={f"angular_drag_{axis}": 0.01 for axis in "xyz"})
    assert parameters(damped, SIH)["SIH_KDW"] == pytest.approx(0.01)
    dragging = vehicle.replace(effects={"linear_drag_x": 0.1, "linear_drag_y": 0.1})
    assert parameters(dragging, SIH)["SIH_KDV"] == pytest.approx(
        parameters(vehicle, SIH)["SIH_KDV"] + 0.1
    )


def test_what_px4_does_not_accept_is_a_gate(vehicle):
    assert tuple(outside_range({"SIM_GZ_EC_MAX1": 1066})) == (
        "SIM_GZ_EC_MAX1 1066: PX4 accepts 0 to 1000",
    )
    assert tuple(outside_range({"SIH_KDW": -1.0, "SIH_IXY": -1.0})) == (
        "SIH_KDW -1: PX4 accepts at least 0",
    )
    heavy = px4_draft(vehicle.replace(mass=5.8), "", SIH)
    (gate, _) = heavy.gates
    assert gate.objections[0].startswith("MPC_THR_HOVER 0.8")
    assert px4_draft(vehicle, "", SIH).gates[0].passed


def test_the_sih_of_another_airframe_is_a_gate(vehicle):
    rotors = list(vehicle.rotors)
    rotors[0] = rotors[0].replace(position=(0.2, -0.17678, 0.06))
    (_, gate) = px4_draft(vehicle.replace(rotors=tuple(rotors)), "", SIH).gates
    assert "along x" in gate.objections[0]
    (_, gate) = px4_draft(vehicle, "", GZ_SIM).gates
    assert gate.passed


def test_hover_command_carries_the_weight(vehicle):
    vehicle = vehicle.replace(motor=vehicle.motor.replace(input_scaling=850.0))
    hover = parameters(vehicle, GZ_SIM)["MPC_THR_HOVER"]
    assert 4 * 1.45e-5 * (850 * hover + 100) ** 2 == pytest.approx(2.243 * 9.81, rel=1e-6)


def test_speeds_beyond_px4s_range_are_scaled(vehicle):
    values = parameters(vehicle, GZ_SIM)
    assert (values["SIM_GZ_EC_MIN1"], values["SIM_GZ_EC_MAX1"]) == (95, 1000)
    draft = px4_draft(vehicle, "", GZ_SIM)
    assert any("scaled by 0.952381" in note for note in draft.notes)
    assert draft.vehicle.motor.input_scaling == pytest.approx(950, rel=1e-3)
    assert draft.vehicle.aerodynamics.motor_constant == 1.45e-5


def test_the_gz_bridge_gets_whole_speeds(vehicle):
    values = parameters(vehicle.replace(motor=vehicle.motor.replace(input_scaling=850.4)), GZ_SIM)
    assert [values[f"SIM_GZ_EC_MIN{i}"] for i in range(1, 5)] == [100] * 4
    assert [values[f"SIM_GZ_EC_MAX{i}"] for i in range(1, 5)] == [950] * 4
    assert isinstance(values["SIM_GZ_EC_MAX1"], int)


def test_a_vehicle_too_heavy_to_hover_is_refused(vehicle):
    with pytest.raises(ExportError, match="cannot hover"):
        px4_draft(vehicle.replace(mass=20.0), "", SIH)


def test_the_file_is_what_ground_stations_load(vehicle, tmp_path):
    path = tmp_path / "x.params"
    draft = px4_draft(vehicle, "by a test", SIH)
    write(draft, path)
    lines = path.read_text().splitlines()
    assert lines[0] == "# by a test"
    assert "1\t1\tSIH_MASS\t2.243\t9" in lines
    assert "1\t1\tCA_ROTOR_COUNT\t4\t6" in lines
    again = read_parameters(path)
    assert set(again) == set(parameters(vehicle, SIH))
    assert again["SIH_MASS"] == 2.243


def test_a_changed_file_does_not_read_back(vehicle, tmp_path):
    path = tmp_path / "x.params"
    draft = px4_draft(vehicle, "by a test", SIH)
    path.write_text(draft.text.replace("2.243", "2.244"))
    assert draft.faults(path, {}) == ["SIH_MASS is 2.244, not 2.243"]
    path.write_text(draft.text.replace("1\t1\tSIH_MASS\t2.243\t9\n", ""))
    assert draft.faults(path, {}) == ["SIH_MASS is missing"]
    path.write_text("1 1 SIH_MASS\n")
    with pytest.raises(ExportError, match="SIH_MASS"):
        draft.faults(path, {})
