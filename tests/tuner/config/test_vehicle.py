import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tuner.core.errors import ConfigError
from tuner.core.shipped import configs_folder
from tuner.vehicle import (
    COEFFICIENTS,
    check_rotors,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)
from tuner.vehicle.vehicle import AerodynamicsSection, InertiaSection, MotorSection, SetupSection

SHIPPED = sorted((configs_folder() / "vehicles").glob("*.yaml"))
ORIGINAL = configs_folder() / "vehicles" / "hovergames.yaml"


def test_the_interface_example_is_read(tmp_path):
    path = tmp_path / "v.yaml"
    path.write_text(
        """
name: hovergames
mass: 2.243
inertia: {xx: 0.028, yy: 0.033, zz: 0.038}
rotors:
  - {position: [0.17678, -0.17678, 0.06], spin: ccw}
  - {position: [-0.17678, 0.17678, 0.06], spin: ccw}
  - {position: [0.17678, 0.17678, 0.06], spin: cw}
  - {position: [-0.17678, -0.17678, 0.06], spin: cw}
motor: {input_scaling: 950, zero_position_armed: 100, max_rotor_velocity: 1100,
        time_constant_up: 0.0125, time_constant_down: 0.025}
aerodynamics: {motor_constant: 1.45e-5, moment_constant: 0.033, rotor_drag_coefficient: 1.45e-4,
               rolling_moment_coefficient: 1e-6}
"""
    )
    vehicle = read_vehicle(path)
    assert vehicle.mass == 2.243
    assert vehicle.inertia.yy == 0.033
    assert vehicle.rotors[0].position == (0.17678, -0.17678, 0.06)
    assert vehicle.rotors[3].spin == "cw"
    assert vehicle.motor.input_scaling == 950.0
    assert vehicle.motor.input_offset == 0
    assert vehicle.motor.quadratic == 0
    assert vehicle.aerodynamics.rolling_moment_coefficient == 1e-6
    assert vehicle.aerodynamics.max_relative_airspeed == 25
    assert vehicle.aerodynamics.reaction_torque == "body"
    assert vehicle.setup.estimate_latency == 0
    assert vehicle.setup.actuator_latency == 0


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_vehicles_come_back_from_a_file_as_they_were(path, tmp_path):
    vehicle = read_vehicle(path)
    write_vehicle(vehicle, tmp_path / "v.yaml", header="made by a test")
    assert read_vehicle(tmp_path / "v.yaml") == vehicle


def test_shipped_coefficients_are_the_published_ones():
    original = read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml")
    updated = read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")
    changed = {
        name: (value, values_of(updated)[name])
        for name, value in values_of(original).items()
        if value != values_of(updated)[name]
    }
    assert changed == {
        "mass": (2.079, 2.243),
        "inertia_xx": (0.021, 0.028),
        "inertia_yy": (0.021, 0.033),
        "inertia_zz": (0.040, 0.038),
        "input_scaling": (1000, 950),
        "motor_constant": (8.55e-6, 1.45e-5),
        "moment_constant": (0.06, 0.033),
        "rotor_drag_coefficient": (8.06e-4, 1.45e-4),
    }


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(
    numbers=st.lists(
        st.floats(1e-12, 1e12, allow_subnormal=False),
        min_size=len(COEFFICIENTS),
        max_size=len(COEFFICIENTS),
    )
)
def test_every_coefficient_comes_back_bit_for_bit(numbers, tmp_path):
    vehicle = read_vehicle(ORIGINAL)
    values = dict(zip(COEFFICIENTS, numbers, strict=False))
    values |= dict.fromkeys(("inertia_xx", "inertia_yy", "inertia_zz"), values["inertia_xx"])
    values |= {name: min(values[name], 0.04) for name in ("estimate_latency", "actuator_latency")}
    write_vehicle(with_values(vehicle, values), tmp_path / "v.yaml")
    assert values_of(read_vehicle(tmp_path / "v.yaml")) == values


def test_the_unit_stands_beside_each_coefficient(tmp_path):
    write_vehicle(read_vehicle(ORIGINAL), tmp_path / "v.yaml")
    lines = (tmp_path / "v.yaml").read_text().splitlines()
    assert any(line.startswith("mass: 2.079") and line.endswith("# kg") for line in lines)
    assert any("max_rotor_velocity: " in line and line.endswith("# rad/s") for line in lines)
    assert any(line.startswith("rotors: ") and "# positions in m" in line for line in lines)
    assert any(
        line.startswith("  motor_constant: 8.55e-06") and line.endswith("# N s²/rad²")
        for line in lines
    )


def test_provenance_is_kept(tmp_path):
    vehicle = read_vehicle(ORIGINAL).replace(
        source={"run": "runs/1", "confidence": {"mass": [2.0, 2.1]}, "date": "2024-01-01"}
    )
    write_vehicle(vehicle, tmp_path / "v.yaml")
    assert read_vehicle(tmp_path / "v.yaml").source == vehicle.source


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "motor_constant",
            "motor_constnat",
            "line 18: unknown key 'aerodynamics.motor_constnat'; did you mean 'motor_constant'?",
        ),
        ("mass: 2.079", "masss: 2.079", "unknown key 'masss'; did you mean 'mass'?"),
        ("mass: 2.079", "mass: -1", "line 4: mass is -1; it should be more than 0"),
        ("mass: 2.079", "mass: heavy", "mass is 'heavy'; it should be a number"),
        ("mass: 2.079", "mass: true", "mass is True; it should be a number"),
        ("mass: 2.079", "mass: .nan", "mass is nan; it should be a finite number"),
        ("mass: 2.079", "mass: .inf", "mass is inf; it should be a finite number"),
        ("mass: 2.079", "", "key 'mass' is missing"),
        ("zz: 0.040", "zz: 0", "inertia.zz is 0; it should be more than 0"),
        ("zz: 0.040", "zz: 0.05", "inertia.zz is 0.05, more than the other two together (0.042)"),
        (
            "spin: ccw",
            "spin: clockwise",
            "rotors[0].spin is 'clockwise'; it should be 'ccw' or 'cw'",
        ),
        ("spin: ccw", "spin: cw", "rotors[0] turns cw"),
        ("[0.17678, -0.17678, 0.06]", "[0.17678, 0.17678, 0.06]", "rotors[0] sits at"),
        ("[0.17678, -0.17678, 0.06]", "[0.17678, -0.17678]", "rotors[0].position[2]"),
        ("time_constant_up: 0.0125", "time_constant_up: 0", "motor.time_constant_up is 0"),
        ("inertia: {xx: 0.021, yy: 0.021, zz: 0.040}", "inertia: 5", "inertia is 5"),
        (
            "mass: 2.079",
            "mass: 2.079\nsetup: {actuator_latency: 0.2}",
            "setup.actuator_latency is 0.2; it should be at most 0.04",
        ),
    ],
)
def test_a_wrong_value_is_named_in_one_line(vehicle_text, tmp_path, old, new, expected):
    path = tmp_path / "v.yaml"
    assert old in vehicle_text
    path.write_text(vehicle_text.replace(old, new))
    with pytest.raises(ConfigError) as error:
        read_vehicle(path)
    assert str(path) in str(error.value)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_with_values_refuses_what_is_no_vehicle():
    vehicle = read_vehicle(ORIGINAL)
    with pytest.raises(ConfigError, match="did you mean 'inertia_xx'"):
        with_values(vehicle, {"inertia_x": 1.0})
    with pytest.raises(ConfigError, match=r"inertia\.zz"):
        with_values(vehicle, {"inertia_zz": 1.0})


def test_every_coefficient_has_a_place_of_its_own():
    effects = {name: row.neutral for name, row in COEFFICIENTS.items() if row.is_effect}
    vehicle = with_values(read_vehicle(ORIGINAL), {"gyro_cutoff": 30.0} | effects)
    assert set(values_of(vehicle)) == set(COEFFICIENTS)
    assert len({coefficient.place for coefficient in COEFFICIENTS.values()}) == len(COEFFICIENTS)
    for name, value in values_of(vehicle).items():
        if not name.startswith("inertia"):
            other = value + 0.01
            assert values_of(with_values(vehicle, {name: other}))[name] == other


def test_every_number_of_a_vehicle_file_is_a_coefficient_or_known_not_to_be():
    sections = {
        "inertia": InertiaSection,
        "motor": MotorSection,
        "aerodynamics": AerodynamicsSection,
        "setup": SetupSection,
    }
    places = {(name, key) for name, model in sections.items() for key in model.model_fields}
    places |= {("", "mass")}
    registered = {row.place for row in COEFFICIENTS.values() if not row.is_effect}
    assert registered < places
    assert places - registered == {
        ("motor", "max_rotor_velocity"),
        ("aerodynamics", "reaction_torque"),
        ("aerodynamics", "thrust_law"),
    }


def test_effects_are_optional_numbers_under_names_of_the_registry(vehicle_text, tmp_path):
    path = tmp_path / "v.yaml"
    path.write_text(vehicle_text + "effects: {fuselage_drag: 0.02}\n")
    vehicle = read_vehicle(path)
    assert values_of(vehicle)["fuselage_drag"] == 0.02
    write_vehicle(vehicle, path)
    assert read_vehicle(path) == vehicle
    (line,) = [line for line in path.read_text().splitlines() if "fuselage_drag" in line]
    assert line.endswith("# N s²/m²")
    write_vehicle(read_vehicle(ORIGINAL), path)
    assert "effects" not in path.read_text()
    path.write_text(vehicle_text + "effects: {fuselage_darg: 0.02}\n")
    with pytest.raises(
        ConfigError, match=r"'effects\.fuselage_darg'; did you mean 'fuselage_drag'"
    ):
        read_vehicle(path)


def test_six_and_eight_rotors_are_read_and_only_the_mixer_refuses_them(vehicle_text, tmp_path):
    path = tmp_path / "v.yaml"
    extra = [
        "  - {position: [0.0, 0.3, 0.0], spin: ccw}\n",
        "  - {position: [0.0, -0.3, 0.0], spin: cw}\n",
    ]
    path.write_text(vehicle_text.replace("motor:\n", "".join(extra) + "motor:\n", 1))
    hexacopter = read_vehicle(path)
    assert len(hexacopter.rotors) == 6
    check_rotors(read_vehicle(ORIGINAL))
    with pytest.raises(ConfigError, match="has 6 rotors") as error:
        check_rotors(hexacopter)
    assert "exported and audited" in str(error.value)
    path.write_text(vehicle_text.replace("motor:\n", extra[0] + "motor:\n", 1))
    with pytest.raises(ConfigError, match="rotors are 5; list 4, 6 or 8 rotors"):
        read_vehicle(path)
