"""Twelve models with one planted fault each, and models without."""

import json
import re
from pathlib import Path

import pytest

from tests.tuner.exporters.conftest import MODELS
from tuner.cli import main
from tuner.core.errors import ExportError
from tuner.exporters.audit import audit
from tuner.exporters.effective import MARK
from tuner.exporters.simulators import GZ_SIM
from tuner.exporters.targets.px4 import parameters, parameters_text

CLASSIC, GZ = MODELS / "quad_x.sdf", MODELS / "quad_x_gz.sdf"
SHIPPED = Path(__file__).resolve().parents[4] / "shared" / "models"

#: What is planted -> how (pattern, replacement, how often), and what the line must say.
PLANTED = {
    "slowdown left out": (
        r" *<rotorVelocitySlowdownSim>.*\n", "", 0, "rotorVelocitySlowdownSim is missing",
    ),
    "limit in rpm": (
        r"<maxRotVelocity>1100<", "<maxRotVelocity>10504<", 0, "is it in rpm? that would be 1100",
    ),
    "moment constant by kV": (
        # 60/(2 pi kV) of a 30 kV motor
        r"<momentConstant>0.06<", "<momentConstant>0.318<", 0, "not 60/(2π kV)",
    ),
    "time constant in ms": (
        r"<timeConstantUp>0.0125<", "<timeConstantUp>12.5<", 0, "is it in ms?",
    ),
    "one rotor's sense": (r"ccw</turn", "cw</turn", 1, "their torques do not cancel"),
    "two neighbours alike": (
        None, None, 0, "neighbouring rotors turn the same way",
    ),
    "inertia in g cm2": (
        r"<ixx>0.021</ixx>", "<ixx>210000</ixx>", 1, "largest moment is more than the other two",
    ),
    "inertia ten times": (
        r"<i(xx|yy|zz)>(0.021|0.04)<", r"<i\1>1\2<", 3, "is it in another unit?",
    ),
    "mass in g": (r"<mass>2.04</mass>", "<mass>2040</mass>", 1, "times the weight of 2040 kg"),
    "thrust per rpm2": (
        r"<motorConstant>8.55e-06<", "<motorConstant>9.4e-08<", 0, "not per rpm²",
    ),
    "one motor stronger": (
        r"<motorConstant>8.55e-06<", "<motorConstant>1.71e-05<", 1, "motorConstant differs",
    ),
    "hover beyond reach": (
        r"<mass>2.04</mass>", "<mass>3.3</mass>", 1, "hovers at a throttle of 0.8",
    ),
}  # fmt: skip


def planted(name):
    pattern, replacement, count, expected = PLANTED[name]
    text = CLASSIC.read_text()
    if pattern is None:  # front left and rear left change places in turning
        plugins = re.split(r"(?=<plugin )", text)
        swapped = [
            p.replace(">ccw<", ">cw<") if "<motorNumber>1<" in p
            else p.replace(">cw<", ">ccw<") if "<motorNumber>2<" in p
            else p
            for p in plugins
        ]  # fmt: skip
        return "".join(swapped), expected
    changed = re.sub(pattern, replacement, text, count=count)
    assert changed != text
    return changed, expected


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_fault_is_found(name, tmp_path, capsys):
    text, expected = planted(name)
    (tmp_path / "m.sdf").write_text(text)
    faults = audit(tmp_path / "m.sdf").faults
    assert any(expected in fault for fault in faults), faults
    assert len({re.sub(r"rotor \d: ", "", fault) for fault in faults}) == 1, faults
    assert main(["audit", str(tmp_path / "m.sdf")]) == 1
    assert capsys.readouterr().out.count("\n") == len(faults)


@pytest.mark.parametrize("model", [CLASSIC, GZ, MODELS / "quad_x.sdf.jinja"], ids=lambda p: p.name)
def test_nothing_is_found_in_a_good_model(model, capsys):
    assert main(["audit", str(model)]) == 0
    assert "no fault found, 2.079 kg" in capsys.readouterr().out


def test_effective_coefficients_of_an_export_are_no_fault(make_run, tmp_path):
    model, quick = tmp_path / "m.sdf", CLASSIC.read_text().replace("Up>0.0125<", "Up>0.001<")
    model.write_text(quick)
    assert "timeConstantUp 0.001 s is no motor's" in audit(model).faults[0]
    model.write_text(quick.replace("<link", f"<!-- {MARK} --><link", 1))
    found = audit(model, run=make_run())
    assert found.faults == ()
    assert found.differences[0] == f"These are {MARK}: they differ on purpose."


def test_what_is_included_from_elsewhere_is_named(tmp_path, capsys):
    include = "<include><uri>model://gps</uri></include></model>"
    (tmp_path / "m.sdf").write_text(CLASSIC.read_text().replace("</model>", include))
    assert main(["audit", str(tmp_path / "m.sdf")]) == 0
    assert "2.079 kg without model://gps, not read" in capsys.readouterr().out


@pytest.mark.skipif(not SHIPPED.is_dir(), reason="PX4's models are not in ../shared/models")
@pytest.mark.parametrize(
    "name",
    [
        "classic/iris/iris.sdf.jinja",
        "classic/typhoon_h480/typhoon_h480.sdf.jinja",
        "gz/x500/model.sdf",
        "gz/x500_depth/model.sdf",
    ],
)
def test_nothing_is_found_in_px4s_models(name):
    assert audit(SHIPPED / name).faults == ()


def test_parameters_are_held_against_the_model(vehicle, tmp_path):
    good = parameters(vehicle.replace(mass=2.079), GZ_SIM)
    for name, value, expected in (
        ("CA_ROTOR0_PX", -0.17678, "rotor 0 sits at 0.177 m"),
        ("CA_ROTOR2_KM", 0.06, "says the other turning direction than cw"),
        ("CA_ROTOR_COUNT", 6, "the model has 4 rotors"),
        ("SIM_GZ_EC_MAX1", 1066, "PX4 accepts 0 to 1000"),
        ("MPC_THR_HOVER", 0.2, "the model hovers at a throttle of"),
    ):
        changed = good | {name: value}
        file = tmp_path / "x.params"
        file.write_text(parameters_text(changed, "by a test"))
        faults = audit(GZ, file).faults
        assert any(fault.startswith(name) and expected in fault for fault in faults), faults


HOVER, EQUAL = "MPC_THR_HOVER\t0.5\t9", "SIM_GZ_EC_{}1\t500\t6"


@pytest.mark.parametrize(
    ("mass", "parameters", "said"),
    [
        (None, (HOVER, EQUAL.format("MIN"), EQUAL.format("MAX")), "speeds of 500 to 500 rad/s"),
        ("-3", (HOVER,), "its mass -3 kg is not positive"),
        ("0", (), "its mass 0 kg is not positive"),
    ],
)
def test_what_has_no_hover_is_no_internal_error(mass, parameters, said, tmp_path):
    model, params = tmp_path / "quad.sdf", tmp_path / "quad.params"
    text = GZ.read_text()
    model.write_text(text if mass is None else re.sub(r"<mass>[^<]*<", f"<mass>{mass}<", text))
    params.write_text("".join(f"1\t1\t{line}\n" for line in parameters))
    assert said in "\n".join(audit(model, params).faults)


@pytest.mark.parametrize(
    ("pattern", "text", "said"),
    [
        (r"<ixx>[^<]*<", "<ixx>inf<", "no body has a moment of inertia of 0 kg m²"),
        (r"<motorConstant>[^<]*<", "<motorConstant>nan<", "it has no motorConstant"),
        (r"<mass>[^<]*<", "<mass>nan<", "has no mass that is a number; write it as one"),
        (r"<pose>[^<]*<", "<pose>0 0 nan 0 0 0<", "has the pose '0 0 nan 0 0 0'; write six"),
    ],
)
def test_what_is_not_finite_is_no_number(pattern, text, said, tmp_path, capsys):
    model = tmp_path / "quad.sdf"
    model.write_text(re.sub(pattern, text, GZ.read_text()))
    main(["audit", str(model)])
    assert said in "".join(capsys.readouterr())


def test_coefficients_are_compared_with_a_runs(make_run, capsys):
    run = make_run()
    assert main(["audit", str(CLASSIC), "--run", str(run.folder), "--json"]) == 0
    compared = json.loads(capsys.readouterr().out)["compared"]
    assert "mass 2.079, fitted 2.243: -7.3 %, 7.31 standard errors" in compared
    (constant,) = [line for line in compared if line.startswith("motor_constant")]
    assert constant == "motor_constant 8.55e-06, fitted 1.45e-05: -41.0 %, 41 standard errors"


def test_what_is_no_model_is_refused_in_a_line(tmp_path, capsys):
    (tmp_path / "m.sdf").write_text("<sdf><world/></sdf>")
    with pytest.raises(ExportError, match="holds no <model>"):
        audit(tmp_path / "m.sdf")
    assert main(["audit", str(tmp_path / "m.sdf")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
