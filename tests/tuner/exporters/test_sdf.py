import difflib
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from tests.tuner.exporters.conftest import MODELS
from tuner.core.errors import ExportError
from tuner.exporters.sdf.model import (
    Inertial,
    Pose,
    base_for,
    composite,
    join_bodies,
    pose_from,
    sdf_of,
)
from tuner.exporters.sdf.spans import (
    Edit,
    ModelFile,
    append_child,
    apply_edits,
    parse,
    render,
    set_value,
    without_comments,
    without_jinja,
)
from tuner.exporters.simulators import GAZEBO_CLASSIC, GZ_SIM
from tuner.exporters.target import not_carried, target_of, write
from tuner.exporters.targets.sdf import TARGET, numbers_of, read_values, sdf_draft
from tuner.vehicle import COEFFICIENTS, ExportTag, values_of

CLASSIC, GZ, TEMPLATE = (
    MODELS / "quad_x.sdf",
    MODELS / "quad_x_gz.sdf",
    MODELS / "quad_x.sdf.jinja",
)
ALL = pytest.mark.parametrize("path", [CLASSIC, GZ, TEMPLATE], ids=lambda path: path.name)


def changes(before, after):
    """Return the (removed, added) lines of a diff, each pair once."""
    lines = difflib.ndiff(before.splitlines(), after.splitlines())
    return {line[0] + line[1:].strip() for line in lines if line[0] in "+-"}


def patched(tmp_path, vehicle, text, name="model.sdf"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return sdf_draft(path, vehicle, "by a test")


@pytest.mark.parametrize("path", [CLASSIC, GZ], ids=lambda path: path.name)
def test_only_our_values_change(path, vehicle):
    before = path.read_text(encoding="utf-8")
    draft = sdf_draft(path, vehicle, "by a test")
    expected = {
        "+<!-- Coefficients by tune: by a test -->",
        "-<mass>2.04</mass>  <!-- frame, battery, companion computer -->",
        "+<mass>2.204</mass>  <!-- frame, battery, companion computer -->",
        "-<ixx>0.021</ixx>",
        "+<ixx>0.0271486293466</ixx>",
        "-<ixz>0</ixz>",
        "+<ixz>2.78733838609e-06</ixz>",
        "-<iyy>0.021</iyy>",
        "+<iyy>0.0320310694714</iyy>",
        "-<izz>0.04</izz>",
        "+<izz>0.0363636446048</izz>",
        "-<motorConstant>8.55e-06</motorConstant>",
        "+<motorConstant>1.45e-05</motorConstant>",
        "-<momentConstant>0.06</momentConstant>",
        "+<momentConstant>0.033</momentConstant>",
        "-<rotorDragCoefficient>0.000806</rotorDragCoefficient>",
        "+<rotorDragCoefficient>0.000145</rotorDragCoefficient>",
    }
    if path == GZ:  # speeds scaled to the 1000 rad/s that PX4 can tell gz-sim of
        expected -= {line for line in expected if "otor" in line and line[0] == "+"}
        expected |= {
            "+<motorConstant>1.598625e-05</motorConstant>",
            "+<rotorDragCoefficient>0.00015225</rotorDragCoefficient>",
            "-<rollingMomentCoefficient>1e-06</rollingMomentCoefficient>",
            "+<rollingMomentCoefficient>0</rollingMomentCoefficient>",
            "-<maxRotVelocity>1100</maxRotVelocity>",
            "+<maxRotVelocity>1047.61904762</maxRotVelocity>",
        }
    if path == CLASSIC:
        expected |= {"-<input_scaling>1000</input_scaling>", "+<input_scaling>950</input_scaling>"}
    assert changes(before, draft.text) == expected
    assert len(draft.text.splitlines()) == len(before.splitlines()) + 1
    constant = "1.598625e-05" if path == GZ else "1.45e-05"
    assert draft.text.count(f"<motorConstant>{constant}<") == 4


def test_a_template_keeps_its_expressions_and_sets_its_variables(vehicle):
    before = TEMPLATE.read_text(encoding="utf-8")
    draft = sdf_draft(TEMPLATE, vehicle, "by a test")
    diff = changes(before, draft.text)
    assert "+{%- set motor_constant = 1.45e-05 -%}" in diff
    assert "+<input_scaling>950</input_scaling>" in diff
    assert not any("{{" in line for line in diff)
    assert sum(line.startswith("+") for line in diff) == 10
    final = etree.fromstring(render(draft.text, TEMPLATE).encode())
    assert [e.text for e in final.iter("motorConstant")] == ["1.45e-05"] * 4
    assert [e.text for e in final.iter("input_scaling")] == ["950"] * 4


def test_a_variable_that_several_rotors_use_is_set_once(vehicle, tmp_path):
    text = CLASSIC.read_text(encoding="utf-8").replace(
        "<motorConstant>8.55e-06</motorConstant>", "<motorConstant>{{ kf }}</motorConstant>"
    )
    text = text.replace("<sdf ", "{% set kf = 8.55e-06 %}\n<sdf ")
    out = patched(tmp_path, vehicle, text, "model.sdf.jinja").text
    assert "{% set kf = 1.45e-05 %}" in out
    assert out.count("{{ kf }}") == 4


@ALL
def test_links_together_weigh_and_turn_like_the_vehicle(path, vehicle):
    draft = sdf_draft(path, vehicle, "by a test")
    whole = composite(sdf_of(parse(render(draft.text, path), path), 4))
    assert whole.mass == pytest.approx(2.243, rel=1e-11)
    np.testing.assert_allclose(whole.inertia, np.diag([0.028, 0.033, 0.038]), atol=1e-12)
    assert any("'base_link' gets 2.204 kg" in note and "rotor_3" in note for note in draft.notes)


@ALL
def test_patching_again_changes_nothing(path, vehicle, tmp_path):
    once = sdf_draft(path, vehicle, "by a test").text
    assert patched(tmp_path, vehicle, once, path.name).text == once


@ALL
def test_a_later_export_replaces_the_earlier_comment(path, vehicle, tmp_path):
    once = patched(tmp_path, vehicle, path.read_text(encoding="utf-8"), path.name).text
    (tmp_path / path.name).write_text(once, encoding="utf-8")
    twice = sdf_draft(tmp_path / path.name, vehicle, "by -- another").text
    assert once.replace("by a test", "by - - another") == twice


@ALL
def test_what_was_written_is_read_back(path, vehicle, tmp_path):
    target = tmp_path / path.name
    draft = sdf_draft(path, vehicle, "by a test")
    write(draft, target)
    assert draft.faults(target, {}) == []
    other = draft.text.replace("0.000145", "0.000146").replace("0.00015225", "0.00015226")
    target.write_text(other, encoding="utf-8")
    assert any("rotor_drag_coefficient" in fault for fault in draft.faults(target, {}))
    target.write_text(draft.text.replace("2.204", "2.205"), encoding="utf-8")
    assert any(fault.startswith("mass is 2.24") for fault in draft.faults(target, {}))


@pytest.mark.parametrize("tag", ["momentConstant", "input_scaling"])
def test_a_model_that_lacks_a_tag_does_not_read_back(tag, vehicle, tmp_path):
    draft = sdf_draft(CLASSIC, vehicle, "by a test")
    target = tmp_path / "model.sdf"
    target.write_text(re.sub(rf" *<{tag}>.*\n", "", draft.text), encoding="utf-8")
    (fault,) = draft.faults(target, {})
    assert fault.endswith(" is missing")


def test_a_coefficient_for_which_nothing_is_written_is_no_verified_export(vehicle, monkeypatch):
    row = replace(COEFFICIENTS["moment_constant"], exported_as={"sdf": ExportTag("x", "joint")})
    monkeypatch.setitem(COEFFICIENTS, "moment_constant", row)
    with pytest.raises(ExportError, match="moment_constant is missing"):
        sdf_draft(CLASSIC, vehicle, "by a test")


def test_comments_formatting_and_line_ends_survive(vehicle, tmp_path):
    text = CLASSIC.read_text(encoding="utf-8")
    text = text.replace(
        "<motorConstant>8.55e-06</motorConstant>",
        "<motorConstant  >\t8.55e-06 <!-- Kraftbeiwert, gemessen für n ≥ 3000 --> </motorConstant>",
        1,
    )
    odd = patched(tmp_path, vehicle, text).text
    wanted = (
        "<motorConstant  >\t1.45e-05 <!-- Kraftbeiwert, gemessen für n ≥ 3000 --> </motorConstant>"
    )
    assert wanted in odd
    assert odd.endswith("<!-- vim: set et ts=2 sw=2 : -->\n")


def test_comments_may_hold_dashes_as_simulators_let_them(vehicle, tmp_path):
    text = CLASSIC.read_text(encoding="utf-8").replace("laid out", "-- laid <out> ----")
    out = patched(tmp_path, vehicle, text).text
    assert "-- laid <out> ---- as PX4's models are" in out


def test_windows_line_ends_survive(vehicle, tmp_path):
    path = tmp_path / "model.sdf"
    path.write_bytes(CLASSIC.read_bytes().replace(b"\n", b"\r\n"))
    draft = sdf_draft(path, vehicle, "by a test")
    write(draft, path)
    raw = path.read_bytes()
    assert raw.count(b"\r\n") == raw.count(b"\n") - 1  # our own comment's line


def test_a_missing_tag_is_added(vehicle, tmp_path):
    text = re.sub(r" *<rollingMomentCoefficient>.*\n", "", CLASSIC.read_text(encoding="utf-8"))
    text = re.sub(r" *<input_offset>.*\n", "", text)
    out = patched(tmp_path, vehicle, text).text
    assert out.count("      <rollingMomentCoefficient>1e-06</rollingMomentCoefficient>\n") == 4
    assert out.count("          <input_offset>0</input_offset>\n") == 4


def test_other_motors_and_channels_stay(vehicle, tmp_path):
    text = CLASSIC.read_text(encoding="utf-8").replace(
        "<motorNumber>3</motorNumber>", "<motorNumber>4</motorNumber>"
    )
    out = patched(tmp_path, vehicle, text).text
    assert out.count("<motorConstant>1.45e-05<") == 3
    assert "<input_scaling>3.14</input_scaling>" in out


def test_poses_of_links_and_inertials_count(vehicle, tmp_path):
    text = CLASSIC.read_text(encoding="utf-8")
    text = text.replace(
        "<pose>0.02 0 0.01 0 0 0</pose>\n      <inertial>",
        "<pose relative_to='base_link'>0.1 0 0.05 0 0 90</pose>\n      <inertial>"
        "<pose degrees='true'>0 0.01 0 0 0 30</pose>",
    ).replace("<pose>0 0 0 0 0 0</pose>", "<pose>0 0 0.2 0 0 0.3</pose>", 1)
    draft = patched(tmp_path, vehicle, text)
    whole = composite(sdf_of(parse(draft.text, CLASSIC), 4))
    np.testing.assert_allclose(whole.inertia, np.diag([0.028, 0.033, 0.038]), atol=1e-12)
    assert any("rotor_0 sits" in objection for objection in draft.gates[0].objections)


@pytest.mark.parametrize(("number", "says"), [(4, "is of another vehicle"), (3, "beside the base")])
def test_a_model_that_is_too_heavy_is_of_another_vehicle_or_has_heavy_links(
    vehicle, tmp_path, number, says
):
    """A fifth rotor, or a heavier fourth."""
    text = CLASSIC.read_text(encoding="utf-8")
    link = text[text.index("    <link name='rotor_3'>") :]
    link = link[: link.index("</link>") + len("</link>\n")]
    plugin = text[text.index("    <plugin name='rear_right_motor'") :]
    plugin = plugin[: plugin.index("</plugin>") + len("</plugin>\n")]
    heavy = link.replace("<mass>0.006</mass>", "<mass>0.9</mass>")
    if number == 4:
        fifth = (heavy + plugin).replace("rotor_3", "rotor_4")
        text = text.replace(plugin, plugin + fifth.replace("Number>3<", "Number>4<"))
    else:
        text = text.replace(link, heavy)
    with pytest.raises(ExportError, match=says):
        patched(tmp_path, vehicle, text)


def test_what_has_no_tag_is_said(vehicle):
    vehicle = vehicle.replace(
        motor=vehicle.motor.replace(quadratic=-50.0),
        aerodynamics=vehicle.aerodynamics.replace(max_relative_airspeed=20.0),
        setup=vehicle.setup.replace(estimate_latency=0.012, actuator_latency=3.3e-16),
    )
    draft = sdf_draft(CLASSIC, vehicle, "by a test")
    notes = " / ".join(not_carried(vehicle, TARGET))
    assert "quadratic -50 rad/s is not exported: the control channels map" in notes
    assert "25 m/s built in" in notes
    assert "estimate_latency 0.012 s is not exported: it belongs to the set-up" in notes
    assert "actuator_latency" not in notes
    assert draft.vehicle.motor.quadratic == 0
    assert draft.vehicle.aerodynamics.max_relative_airspeed == 25


def test_the_commands_of_gz_sim_are_px4_parameters(vehicle):
    notes = " / ".join(sdf_draft(GZ, vehicle, "by a test").notes)
    assert "SIM_GZ_EC_MIN1..4 to 95 and SIM_GZ_EC_MAX1..4 to 1000" in notes
    assert "SIM_GZ" not in " / ".join(sdf_draft(CLASSIC, vehicle, "by a test").notes)


@pytest.mark.parametrize("path", [CLASSIC, TEMPLATE], ids=lambda path: path.name)
def test_a_byte_order_mark_survives(path, vehicle, tmp_path):
    text, draft = path.read_text(encoding="utf-8"), sdf_draft(path, vehicle, "by a test")
    assert patched(tmp_path, vehicle, "\ufeff" + text, path.name).text == "\ufeff" + draft.text


def test_models_that_are_not_counted_are_named(vehicle, tmp_path):
    more = (
        "<include><uri>model://gps</uri></include>"
        "<model name='gimbal'><link name='arm'><inertial><mass>0.3</mass></inertial></link></model>"
    )
    text = CLASSIC.read_text(encoding="utf-8").replace("<static>", f"{more}<static>")
    notes = patched(tmp_path, vehicle, text).notes
    assert any(note.endswith("is not counted: model://gps, gimbal") for note in notes)


def test_the_model_with_motors_is_patched_whatever_stands_before_it(vehicle, tmp_path):
    pad = "<model name='pad'><link name='pad'/></model>"
    text = GZ.read_text(encoding="utf-8").replace("<model", f"<world name='w'>{pad}<model", 1)
    draft = patched(tmp_path, vehicle, text.replace("</sdf>", "</world></sdf>"))
    assert pad in draft.text
    assert "<mass>2.204</mass>" in draft.text


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("libgazebo_motor_model.so", "libother.so", "no motor model plugin"),
        ("<mass>0.015</mass>", "<mass>2.5</mass>", "weigh 2.524 kg, the vehicle only 2.243 kg"),
        ("<mass>0.015</mass>", "<mass>{{ m }}</mass>", "no mass that is a number"),
        (
            "<mass>2.04</mass>",
            "<mass>{{ m | default(2) }}</mass>",
            "where a number of ours belongs",
        ),
        ("<pose>0.02 0 0.01 0 0 0</pose>", "<pose>0 0</pose>", "has the pose '0 0'"),
        (
            "<pose>0.02 0 0.01 0 0 0</pose>",
            "<pose relative_to='imu_link'>0 0 0 0 0 0</pose>",
            "relative to 'imu_link'",
        ),
        ("<model name='quad_x'>", "<model name='quad_x'><b>", "not well-formed"),
        ("</sdf>", "{% if %}</sdf>", "cannot be rendered"),
        ("<ixx>0.021</ixx>", "<ixx>{% if a %}1{% else %}2{% endif %}</ixx>", "number of ours"),
        ("<inertia>\n          <ixx>0.021", "<inertia/><inertia><ixx>0.021", "with <inertia>"),
        ("</model>", "</model><model name='b'><plugin name='gazebo_motor_model'/></model>", "'b'"),
    ],
)
def test_a_model_we_cannot_serve_is_refused_in_one_line(vehicle, tmp_path, old, new, expected):
    text = CLASSIC.read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(ExportError) as error:
        patched(tmp_path, vehicle, text.replace(old, new))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_blanking_a_template_keeps_every_place():
    text = "a {# {{ x }} #} b {{ c }}\n{%- set d = 1 -%} e"
    blank = without_jinja(text)
    assert len(blank) == len(text)
    assert blank.index("b") == text.index(" b ") + 1
    assert blank.index("e") == text.rindex("e")
    assert "{" not in blank


@pytest.mark.parametrize("simulator", [GAZEBO_CLASSIC, GZ_SIM], ids=lambda s: s.name)
def test_a_snippet_holds_the_vehicle(simulator, vehicle, tmp_path):
    draft = TARGET.draft(vehicle, "by a test", simulator, None)
    path = tmp_path / "snippet.sdf"
    write(draft, path)
    model = f"<model><link name='base_link'>{draft.text}</link></model>"
    classic = simulator is GAZEBO_CLASSIC
    if classic:
        assert read_values(sdf_of(parse(model, path), 4), vehicle) == numbers_of(
            vehicle, channels=True
        )
    flown = simulator.flown(vehicle)
    assert values_of(draft.vehicle) == pytest.approx(values_of(flown), rel=1e-11)
    assert draft.text.count("<channel ") == (4 if classic else 0)
    other = draft.text.replace("1.45e-05", "1.46e-05").replace("1.598625e-05", "1.6e-05")
    path.write_text(other, encoding="utf-8")
    assert draft.faults(path, {})


UNEVEN = {f"rotor_thrust_scale_{n + 1}": scale for n, scale in enumerate((1.02, 0.985, 0.99))}
CENTRE = {"center_of_mass_x": 0.003, "center_of_mass_y": -0.002, "center_of_mass_z": 0.015}


def uneven(vehicle, **effects):
    return vehicle.replace(effects={**UNEVEN, **CENTRE, **effects})


@pytest.mark.parametrize("path", [CLASSIC, GZ], ids=lambda path: path.name)
def test_centre_of_mass_and_uneven_rotors_are_in_the_model(path, vehicle, tmp_path):
    draft = sdf_draft(path, uneven(vehicle), "by a test")
    whole = composite(sdf_of(parse(draft.text, path), 4))
    rotors = np.array([rotor.position for rotor in vehicle.rotors])
    model = sdf_of(parse(draft.text, path), 4)
    links = {link.attributes.get("name"): link for link in model.links}
    places = np.array([model.pose_of(links[f"rotor_{n}"]).position for n in range(4)])
    arms = places - whole.pose.position
    np.testing.assert_allclose(
        arms.mean(axis=0), (rotors - [0.003, -0.002, 0.015]).mean(axis=0), atol=1e-12
    )
    np.testing.assert_allclose(whole.inertia, np.diag([0.028, 0.033, 0.038]), atol=1e-12)
    final = etree.fromstring(draft.text.encode())
    constants = [float(element.text) for element in final.iter("motorConstant")]
    last = 1.0 / (1.02 * 0.985 * 0.99)
    unit = 1000 / 1050 if path == GZ else 1.0
    expected = [1.45e-5 / unit**2 * s for s in (1.02, 0.985, 0.99, last)]
    assert constants == pytest.approx(expected, rel=1e-11)
    flown = (GZ_SIM if path == GZ else GAZEBO_CLASSIC).flown(uneven(vehicle))
    assert values_of(draft.vehicle) == pytest.approx(values_of(flown), rel=1e-11)
    assert any("moves to" in note for note in draft.notes)
    again = tmp_path / path.name
    write(draft, again)
    assert sdf_draft(again, uneven(vehicle), "by a test").text == draft.text
    first = f"<motorConstant>{constants[0]:.12g}<"
    assert first in draft.text
    again.write_text(draft.text.replace(first, "<motorConstant>1.47e-05<"), encoding="utf-8")
    assert any("motor_constant of rotor_0" in fault for fault in draft.faults(again, {}))
    unmoved = re.sub(r"(</inertia>)\s*<pose>[^<]*</pose>", r"\1", draft.text, count=1)
    again.write_text(unmoved, encoding="utf-8")
    assert any("center_of_mass_x" in fault for fault in draft.faults(again, {}))


def test_rotors_that_differ_need_plugins_of_their_own(vehicle, tmp_path):
    with pytest.raises(ExportError, match="draws its rotors from a template"):
        sdf_draft(TEMPLATE, uneven(vehicle), "by a test")
    text = CLASSIC.read_text(encoding="utf-8").replace(
        "<motorConstant>8.55e-06</motorConstant>", "<motorConstant>{{ kf }}</motorConstant>"
    )
    text = text.replace("<sdf ", "{% set kf = 8.55e-06 %}\n<sdf ")
    with pytest.raises(ExportError, match="of all rotors at once"):
        patched(tmp_path, uneven(vehicle), text, "model.sdf.jinja")


def test_a_centre_of_mass_needs_rotors_to_count_from(vehicle, tmp_path):
    text = CLASSIC.read_text(encoding="utf-8").replace("'rotor_", "'prop_")
    with pytest.raises(ExportError, match="no places of rotors"):
        patched(tmp_path, uneven(vehicle), text)


def test_a_snippet_holds_centre_of_mass_and_uneven_rotors(vehicle, tmp_path):
    draft = TARGET.draft(uneven(vehicle), "by a test", GZ_SIM, None)
    assert "<pose>0.003 -0.002 0.015 0 0 0</pose>" in draft.text
    flown = GZ_SIM.flown(uneven(vehicle))
    assert values_of(draft.vehicle) == pytest.approx(values_of(flown), rel=1e-11)
    path = tmp_path / "snippet.sdf"
    write(draft, path)
    assert draft.faults(path, {}) == []


def test_a_model_for_another_vehicle_is_a_gate(vehicle, tmp_path):
    (gate,) = sdf_draft(CLASSIC, vehicle, "by a test").gates
    assert gate.passed
    text = CLASSIC.read_text(encoding="utf-8").replace("ccw<", "cw<", 1)
    (gate,) = patched(tmp_path, vehicle, text).gates
    assert gate.objections == ("rotor_0 turns cw, the vehicle file's ccw",)
    text = CLASSIC.read_text(encoding="utf-8").replace("<motorNumber>1<", "<motorNumber>0<")
    (gate,) = patched(tmp_path, vehicle, text).gates
    assert gate.objections[:2] == (
        "rotor_0 has 2 motor plugins",
        "rotor_1 has no motor plugins",
    )
    wider = [r.replace(position=(1.2 * r.position[0], *r.position[1:])) for r in vehicle.rotors]
    draft = sdf_draft(CLASSIC, vehicle.replace(rotors=tuple(wider)), "by a test")
    assert len(draft.gates[0].objections) == 4
    assert draft.vehicle.rotors[0].position[0] == pytest.approx(0.17678, abs=1e-3)  # it flies there


def test_gz_sim_is_flown_by_its_own_laws(vehicle):
    flown = sdf_draft(GZ, vehicle, "by a test").vehicle
    assert flown.aerodynamics.max_relative_airspeed > 1e5
    assert flown.aerodynamics.rolling_moment_coefficient == 0
    assert sdf_draft(CLASSIC, vehicle, "by a test").vehicle.aerodynamics == vehicle.aerodynamics
    notes = " / ".join(not_carried(vehicle, TARGET.for_simulator(into=GZ)))
    assert "thrust in gz-sim does not depend on the airspeed" in notes


def test_format_and_model_agree_about_the_simulator():
    assert TARGET.for_simulator(into=GZ).simulator is GZ_SIM
    assert TARGET.for_simulator("gz-sim").simulator is GZ_SIM
    assert TARGET.for_simulator().simulator is GAZEBO_CLASSIC
    assert TARGET.for_simulator("gazebo-classic").suffix == ".sdf"
    assert TARGET.for_simulator(into=GZ).suffix == target_of("gz-sim").suffix == "_gz-sim.sdf"
    with pytest.raises(ExportError, match="is a model for gz-sim"):
        TARGET.for_simulator("gazebo-classic", GZ)
    with pytest.raises(ExportError, match="--format gz-sim is not for gazebo-classic"):
        target_of("gz-sim").for_simulator(into=CLASSIC)


def solid_box(mass, pose, sides):
    x, y, z = (np.asarray(sides) ** 2).tolist()
    return Inertial(mass, pose, mass / 12 * np.diag([y + z, x + z, x + y]))


def test_two_half_bars_are_a_bar():
    halves = [
        solid_box(1.0, pose_from([side, 0, 0, 0, 0, 0]), [1, 0.1, 0.1]) for side in (-0.5, 0.5)
    ]
    bar = solid_box(2.0, pose_from([0] * 6), [2, 0.1, 0.1])
    assert join_bodies(halves).mass == 2
    np.testing.assert_allclose(join_bodies(halves).inertia, bar.inertia, atol=1e-15)
    np.testing.assert_allclose(join_bodies(halves).pose.position, 0, atol=1e-15)


def test_a_quarter_turn_about_z_swaps_x_and_y():
    turned = pose_from([1, 2, 3, 0, 0, np.pi / 2])
    np.testing.assert_allclose(turned.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    box = Inertial(1.0, turned, np.diag([1.0, 2.0, 2.5]))
    inertia = box.inertia_about(turned.position)
    np.testing.assert_allclose(inertia, np.diag([2.0, 1.0, 2.5]), atol=1e-15)


def test_angles_are_about_fixed_axes_roll_first():
    both = pose_from([0, 0, 0, np.pi / 2, np.pi / 2, 0]).rotation
    np.testing.assert_allclose(both @ [0, 1, 0], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(both @ both.T, np.eye(3), atol=1e-15)


def test_poses_chain():
    outer, inner = pose_from([1, 0, 0, 0, 0, np.pi / 2]), pose_from([1, 0, 0, 0, 0, 0])
    np.testing.assert_allclose((outer @ inner).position, [1, 1, 0], atol=1e-15)


@given(
    st.lists(
        st.tuples(st.floats(0.001, 0.05), *[st.floats(-0.2, 0.2)] * 3, *[st.floats(-3, 3)] * 3),
        max_size=5,
    ),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3, *[st.floats(-3, 3)] * 3),
)
def test_base_and_others_together_are_the_wanted_whole(others, base):
    bodies = [solid_box(mass, pose_from(pose), [0.02, 0.1, 0.03]) for mass, *pose in others]
    wanted = np.diag([0.05, 0.06, 0.08])
    base_body = base_for(2.0, wanted, pose_from(base), bodies)
    whole = join_bodies([base_body, *bodies])
    assert whole.mass == pytest.approx(2.0, rel=1e-12)
    np.testing.assert_allclose(whole.inertia, wanted, atol=1e-14)


def test_the_base_moves_to_where_the_common_centre_is_wanted():
    other = solid_box(0.5, pose_from([0.1, 0, 0.05, 0, 0, 1.0]), [0.02, 0.1, 0.03])
    wanted, centre = np.diag([0.05, 0.06, 0.08]), np.array([0.003, -0.002, 0.015])
    base = base_for(2.0, wanted, pose_from([0.3, 0, 0, 0.2, 0, 0]), [other], centre=centre)
    whole = join_bodies([base, other])
    np.testing.assert_allclose(whole.pose.position, centre, atol=1e-16)
    np.testing.assert_allclose(whole.inertia, wanted, atol=1e-14)


def test_links_heavier_than_the_vehicle_are_refused():
    heavy = solid_box(3.0, pose_from([0] * 6), [1, 1, 1])
    with pytest.raises(ValueError, match="weigh 3 kg, the vehicle only 2 kg"):
        base_for(2.0, np.diag([0.05, 0.06, 0.08]), pose_from([0] * 6), [heavy])
    far = Inertial(0.5, Pose(np.array([0.5, 0, 0]), np.eye(3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="more inertia than"):
        base_for(2.0, np.diag([0.05, 0.06, 0.08]), pose_from([0] * 6), [far])


PATH = Path("model.sdf")


def changed(text, tag, value):
    element = next(parse(text, PATH).all(tag))
    return apply_edits(text, [set_value(element, value)])


def test_places_are_places_in_the_text_whatever_characters_stand_before():
    text = "<a é='ü>\"'><!-- ≥ <b>0</b> --><b>1.5</b>\n<c/></a>"
    root = parse(text, PATH)
    b, c = root.children
    assert text[b.start : b.end] == "<b>1.5</b>"
    assert text[b.content : b.content_end] == "1.5"
    assert text[c.start : c.end] == "<c/>"
    assert (root.start, root.end) == (0, len(text))
    assert b.number == 1.5
    assert c.number is None


def test_a_value_changes_and_nothing_else():
    assert changed("<a>\n <b> 1e-3 </b></a>", "b", "2") == "<a>\n <b> 2 </b></a>"
    assert changed("<a><b>1 <!-- kg: 3 --></b></a>", "b", "2") == "<a><b>2 <!-- kg: 3 --></b></a>"
    assert changed("<a><b><!-- 3 -->1</b></a>", "b", "2") == "<a><b><!-- 3 -->2</b></a>"
    assert changed("<a><b/></a>", "b", "2") == "<a><b>2</b></a>"
    assert changed("<a><b x='/' /></a>", "b", "2") == "<a><b x='/'>2</b></a>"
    assert changed("<a><b></b></a>", "b", "2") == "<a><b>2</b></a>"
    assert changed("<a><b>word</b></a>", "b", "2") == "<a><b>2</b></a>"


def test_a_new_child_stands_like_the_last():
    text = "<a>\n  <b>1</b>\n</a>"
    edit = append_child(parse(text, PATH), "c", "2")
    assert apply_edits(text, [edit]) == "<a>\n  <b>1</b>\n  <c>2</c>\n</a>"
    flat = "<a><b>1</b></a>"
    assert apply_edits(flat, [append_child(parse(flat, PATH), "c", "2")]) == (
        "<a><b>1</b><c>2</c></a>"
    )


@given(
    st.recursive(
        st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=5),
        lambda inner: st.lists(inner, max_size=4),
        max_leaves=12,
    )
)
def test_every_element_is_cut_out_whole(tree):
    def build(value, parent):
        element = etree.SubElement(parent, "e", {"a": "x>'/"})
        if isinstance(value, str):
            element.text = value
        else:
            for child in value:
                build(child, element)

    top = etree.Element("e")
    build(tree, top)
    text = etree.tostring(top, encoding="unicode")

    def same(ours, theirs):
        cut = text[ours.start : ours.end]
        cut_out, whole = etree.fromstring(cut), etree.fromstring(etree.tostring(theirs))
        assert etree.tostring(cut_out, method="c14n") == etree.tostring(whole, method="c14n")
        assert len(ours.children) == len(theirs)
        for our, their in zip(ours.children, theirs, strict=True):
            same(our, their)

    same(parse(text, PATH), top)


def test_edits_that_overlap_are_our_mistake():
    source = ModelFile(PATH, "abcd", "abcd")
    with pytest.raises(ValueError, match="overlap"):
        apply_edits("abcd", [Edit(source, 0, 2, ""), Edit(source, 1, 3, "")])


@pytest.mark.parametrize("text", ["<a>", "", "<a></b>", "words", "<a>&bomb;</a>"])
def test_what_is_not_xml_is_refused(text):
    with pytest.raises(ExportError, match="not well-formed"):
        parse(text, PATH)


def test_elements_inside_each_other_without_end_are_refused():
    with pytest.raises(ExportError, match="nested too deeply"):
        parse("<a>" * 2000 + "</a>" * 2000, PATH)


@pytest.mark.parametrize("begun", ["{{", "{%", "{#", "<!--"])
def test_what_begins_again_and_again_and_never_ends_is_read_once(begun):
    began = time.process_time()
    without_comments(without_jinja(begun * 40_000))
    assert time.process_time() - began < 1.0


def test_document_types_are_refused():
    bomb = '<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;">]><a>&c;</a>'
    with pytest.raises(ExportError, match="document type"):
        parse(bomb, PATH)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{{ 'x' * 10**10 }}", "cannot be rendered without variables"),
        ("{{ 'x' * 10**8 }}", "it comes to more than 10 MB"),
        (
            "{% for i in range(99999) %}{% for j in range(99999) %}{% endfor %}{% endfor %}",
            "too long",
        ),
    ],
)
def test_a_template_without_end_is_refused(text, said, tmp_path, monkeypatch):
    if said == "too long":  # the others end by themselves, on a busy machine later
        monkeypatch.setattr("tuner.exporters.sdf.spans.MAX_RENDERING_S", 1.0)
    with pytest.raises(ExportError, match=said):
        render(text, tmp_path / "model.sdf.jinja")
