"""Every target: written, read back, and where its simulator installs, flown there."""

from datetime import date

import numpy as np
import pytest

import tuner
from tests.tuner.exporters.conftest import MODELS
from tuner.cli import main
from tuner.core.errors import ExportError
from tuner.core.shipped import EXPORT_TARGETS, configs_folder
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.simulation_files import write_flights
from tuner.exporters import laws
from tuner.exporters.export import export_vehicle
from tuner.exporters.external_simulator import flier_of
from tuner.exporters.target import target_of, write
from tuner.exporters.targets.mujoco import MUJOCO
from tuner.options import ExportOptions
from tuner.recordings.loader import load_flight
from tuner.search.job_flights import JobFlight
from tuner.vehicle import ControllerFile, read_vehicle, values_of, write_vehicle

TODAY = date(2024, 5, 6)
EVERY = pytest.mark.parametrize("kind", EXPORT_TARGETS)


@EVERY
def test_what_is_written_is_read_back_and_a_changed_number_is_seen(kind, vehicle, tmp_path):
    target = target_of(kind)
    draft = target.draft(vehicle, "by a test", target.simulator, None)
    path = tmp_path / f"x{target.suffix}"
    write(draft, path)
    text = path.read_text()
    assert "by a test" in text
    assert "2.243" in text
    path.write_text(text.replace("2.243", "2.244"))
    assert draft.faults(path, {})


def test_every_number_of_a_mujoco_model_is_read_back(vehicle, tmp_path):
    target, path = target_of("mujoco"), tmp_path / "x.xml"
    draft = target.draft(vehicle, "by a test", target.simulator, None)
    upside_down = draft.text.replace('gear="0 0 1 0 0', 'gear="0 0 -1 0 0', 1)
    path.write_text(upside_down)
    assert draft.faults(path, {}) == ["rotor_0 gear[2] is -1.0, not 1.0"]


def test_rotors_that_stand_still_at_small_commands_are_refused_for_mujoco(vehicle):
    dead = vehicle.replace(motor=vehicle.motor.replace(input_offset=-0.2))
    target = target_of("mujoco")
    with pytest.raises(ExportError, match="stand still at small commands"):
        target.draft(dead, "by a test", target.simulator, None)


@EVERY
def test_laws_applied_twice_change_nothing(kind, vehicle):
    target = target_of(kind)
    vehicle = vehicle.replace(
        effects={"linear_drag_x": 0.1, "fuselage_drag": 0.02, "angular_drag_z": 0.01},
        motor=vehicle.motor.replace(quadratic=-20.0, input_offset=0.01),
    )
    once = target.simulator.flown(vehicle)
    assert values_of(target.simulator.flown(once)) == pytest.approx(values_of(once), rel=1e-12)


def test_body_rates_decay_equally_in_isaac_lab(vehicle):
    """PhysX's angular_damping is in 1/s, whatever the moment of inertia."""
    damped = vehicle.replace(effects={"angular_drag_x": 0.012, "angular_drag_z": 0.03})
    target = target_of("isaaclab")
    draft = target.draft(damped, "by a test", target.simulator, None)
    flown, inertia = draft.vehicle.effects, vehicle.inertia
    rate = (0.012 / inertia.xx + 0.03 / inertia.zz) / 3
    assert f"'angular_damping': {rate!r}"[:30] in draft.text
    for axis, moment in (("x", inertia.xx), ("y", inertia.yy), ("z", inertia.zz)):
        assert flown[f"angular_drag_{axis}"] / moment == pytest.approx(rate)


@EVERY
def test_thrust_and_hover_are_carried(kind, vehicle):
    flown = target_of(kind).simulator.flown(vehicle)
    assert laws.thrust_to_weight(flown) == pytest.approx(laws.thrust_to_weight(vehicle), rel=1e-9)
    if kind != "px4":  # whose thrust is linear in the command
        assert laws.hover_command(flown) == pytest.approx(laws.hover_command(vehicle), abs=1e-3)


@pytest.mark.parametrize(
    "simulator",
    [target_of(kind).simulator for kind in EXPORT_TARGETS if target_of(kind).simulator.name],
    ids=lambda simulator: simulator.name,
)
def test_each_simulator_is_written_down_with_its_source(simulator):
    assert simulator.version
    assert "/" in simulator.source or "." in simulator.source
    assert simulator.deviations


@EVERY
def test_a_vehicle_file_is_exported_without_a_run(kind, tmp_path):
    assert not main(
        "new-vehicle --mass 1.4 --wheelbase 0.45 --propeller 10x4.5 --motor-kv 920 --cells 3 "
        f"--quiet --out {tmp_path}/quad.yaml".split()
    )
    done = export_vehicle(tmp_path / "quad.yaml", ExportOptions(kind), today=TODAY)
    assert done.path.parent == tmp_path
    assert "by scaling laws, not measured; no flight was compared" in done.path.read_text()
    assert any(note.startswith("motor_constant 1.459e-05") for note in done.notes)
    not_run = [gate.name for gate in done.gates if not gate.ran]
    assert "the exported numbers fly as the run says" in not_run
    hover = next(gate for gate in done.gates if gate.name.startswith("thrust to weight"))
    assert hover.passed
    with pytest.raises(ExportError, match="is there already"):
        export_vehicle(tmp_path / "quad.yaml", ExportOptions(kind), today=TODAY)


@EVERY
def test_a_name_with_control_characters_leaves_the_file_readable(kind, vehicle, tmp_path):
    file = tmp_path / "quad.yaml"
    write_vehicle(vehicle.replace(name="a\x0bb\x7f"), file)
    assert export_vehicle(file, ExportOptions(kind), today=TODAY).path.parent == tmp_path


def test_a_vehicle_file_goes_into_a_model_that_fits_it(tmp_path, capsys):
    model, file = tmp_path / "quad.sdf", tmp_path / "v.yaml"
    model.write_text((MODELS / "quad_x.sdf").read_text())
    vehicle = read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")
    write_vehicle(vehicle, file)
    assert main(["export", str(file), "--format", "sdf", "--into", str(model)]) == 0
    assert "<motorConstant>1.45e-05<" in model.read_text()
    assert "---  the exported numbers fly as the run says (not looked at" in capsys.readouterr().out
    write_vehicle(vehicle.replace(mass=8.0), file)
    before = model.read_text()
    with pytest.raises(ExportError, match="cannot hover"):
        export_vehicle(file, ExportOptions("sdf", into=model), today=TODAY)
    assert model.read_text() == before


class Gliding:
    """A body that keeps its velocity."""

    def __init__(self, step):
        self.period, self.state = step, None

    def begin(self, state, _rotor_speed):
        self.state = state.copy()

    def step(self, asked):
        self.state[:3] += self.period * self.state[3:6]
        return self.state, asked


def test_another_simulators_body_is_what_moves(updated, tmp_path):
    flights = tuner.simulate("circle", vehicle=updated, radius=0.3, speed=1.2, duration=4.0)
    write_flights(flights, tmp_path / "short.bag")
    flight = load_flight(tmp_path / "short.bag")
    errors = Comparison([JobFlight(flight)], ControllerFile()).fly(updated, flier=flier_of(Gliding))
    (missed,) = errors.values()
    start = flight.signals["position"][0]
    flown = missed.position.recorded + missed.position.error
    steps = np.diff(flown, axis=0) / np.diff(missed.position.time)[:, None]
    np.testing.assert_allclose(flown[0], start, atol=0.01)
    np.testing.assert_allclose(steps, steps[0] * np.ones_like(steps), atol=1e-6)


def test_mujoco_itself_flies_what_is_written_for_it(flight, updated):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: the extra simulators")

    draft = target_of("mujoco").draft(updated, "by a test", MUJOCO, None)
    comparison = Comparison([JobFlight(flight)], ControllerFile())
    own = comparison.fly(draft.vehicle)["small_circle"].rmse
    there = comparison.fly(draft.vehicle, flier=draft.flier)["small_circle"].rmse
    for axis in ("x", "y", "z"):
        assert getattr(there, axis) == pytest.approx(getattr(own, axis), abs=0.003)
    for axis in ("roll", "pitch", "yaw"):
        assert getattr(there, axis) == pytest.approx(getattr(own, axis), abs=0.3)
    heavy = draft.vehicle.replace(mass=1.3 * draft.vehicle.mass)
    wrong = target_of("mujoco").draft(heavy, "by a test", MUJOCO, None)
    worse = comparison.fly(draft.vehicle, flier=wrong.flier)["small_circle"].rmse
    assert worse.z > there.z + 0.01


@pytest.mark.parametrize("kind", ["mujoco", "rotorpy", "isaaclab"])
def test_rotors_are_placed_about_the_centre_of_mass(kind, vehicle):
    off = vehicle.replace(effects={"center_of_mass_x": 0.004, "center_of_mass_z": -0.02})
    flown = target_of(kind).simulator.flown(off)
    assert flown.rotors[0].position == pytest.approx((0.17278, -0.17678, 0.08))
    assert not any(name.startswith("center_of_mass") for name in flown.effects)
