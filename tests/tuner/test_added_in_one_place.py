"""What is added in one place is seen all the way through.

A coefficient is its row in the registry, a force is its function in the tuple of terms, an export
target is a module, an option is a field with its help: nothing else knows of them beforehand. No
row of an effect is without its use.
"""

import sys
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotated_types import Interval
from cyclopts import App

import tuner
from docs.generate.models import sections_of
from sim_jax import terms
from sim_jax.environment import Environment
from sim_jax.geometry import Vec3
from sim_jax.numeric import safe_sqrt
from sim_jax.rigid_body import Wrench
from sim_jax.rollout import rollout
from sim_jax.schedule import Schedule
from tests.memory import BEFORE_A_FIT, give_back
from tests.sim_jax.support import controller, moving_start, vec, vehicle, wobble
from tuner.cli.tune import FLATTENED, MANY_WORDS
from tuner.config import JobFile, resolve_settings
from tuner.core import shipped
from tuner.core.errors import ConfigError, ExportError
from tuner.core.phrases import CodeWithText
from tuner.core.yaml_section import build, section_of
from tuner.evaluate.simulation_files import write_flights
from tuner.exporters.simulators import THIS_PROJECT, registry_entries
from tuner.exporters.target import Draft, Target, differences
from tuner.findings.findings import Finding, one_line, shorten_finding
from tuner.options import FILES, Options
from tuner.recordings.inspection import inspect_recordings
from tuner.vehicle import (
    COEFFICIENTS,
    EFFECTS,
    REGISTRY,
    Coefficient,
    ControllerFile,
    ExportTag,
    NoExportTag,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)
from tuner.vehicle.controller import Flag, Mixer

NAME = "sail_drag"
TRUTH = 0.06

SURROUNDINGS = Environment(wind=vec(1.5, -0.5, 0.0), log_voltage=jnp.full(4, -0.1))
"""All that a term can depend on, so that each acts."""

ROW = Coefficient(
    name=NAME,
    unit="N s²/m²",
    meaning="drag of a sail that turns its face to the air",
    source="F = -d‖v‖v",
    place=(EFFECTS, NAME),
    scale="linear",
    bounds=(-0.5, 0.5),
    prior_sd=0.1,
    step=0.05,
    mass_exponent=1,
    neutral=0.0,
    exported_as={
        "sdf": NoExportTag("the motor plugins know no sail", 0.0),
        "ini": ExportTag("sail"),
    },
    informed_by="speed",
)


def sail_drag(vehicle, motion, rotor_speed, air):  # noqa: ARG001 (all terms take the same)
    """Return -d‖v‖v of the body through the air."""
    if NAME not in vehicle.effects:
        return None
    v = air.velocity
    speed = safe_sqrt(v.x * v.x + v.y * v.y + v.z * v.z)
    return Wrench(v * (-vehicle.effects[NAME] * speed), Vec3.zeros(v.x))


@dataclass(frozen=True, kw_only=True)
class MoreOptions(Options):
    """Those of `tune`, and one more, of which the job file has a key."""

    starts: Annotated[int, Interval(ge=1, le=8)] | None = None
    """Search from this many points."""


def test_an_option_is_one_field_for_the_command_line_python_the_job_file_and_http(tmp_path, capsys):
    app = App(name="tune", default_parameter=MANY_WORDS, result_action="return_value")

    @app.default
    def command(*, options: Annotated[MoreOptions, FLATTENED]):
        return options

    app(["--help"])
    assert "--starts INT Search from this many points." in " ".join(capsys.readouterr().out.split())
    bag = tmp_path / "a.bag"
    bag.touch()
    (tmp_path / "tune.yaml").write_text("search: {starts: 2, seed: 7}\n")
    typed = app(["--flights", str(bag), "--starts", "3"])
    assert typed == MoreOptions.of(flights=[bag], starts=3)
    settled = resolve_settings(typed).job.search
    assert (settled.starts, settled.seed) == (3, 7)
    with pytest.raises(ConfigError, match="--starts: is 9; it should be at most 8"):
        resolve_settings(MoreOptions([str(bag)], starts=9))
    with pytest.raises(ConfigError, match="options: starts is 9; it should be at most 8"):
        MoreOptions.of(flights=[bag], starts=9)
    with pytest.raises(ConfigError, match=r"stats: is no option; did you mean 'starts'\?"):
        MoreOptions.of(flights=[bag], stats=3)
    of_http = section_of(MoreOptions, leaving=FILES)
    assert build(of_http, {"starts": 3}, "the request").starts == 3
    with pytest.raises(ConfigError, match="starts is '3'; it should be a whole number"):
        build(of_http, {"starts": "3"}, "the request")
    assert not set(FILES) & set(of_http.model_fields)


@pytest.fixture
def added(monkeypatch):
    """The row and the term, and nothing else."""
    monkeypatch.setitem(COEFFICIENTS, NAME, ROW)
    monkeypatch.setattr(terms, "TERMS", (*terms.TERMS, sail_drag))


@pytest.fixture
def ini_target(monkeypatch):
    """A module that exports all that a row gives it a key for."""

    def draft(vehicle, *_):
        rows = {name: REGISTRY[name] for name in values_of(vehicle)}
        keys = {
            n: row.exported_as["ini"].tag for n, row in rows.items() if "ini" in row.exported_as
        }
        values = {name: values_of(vehicle)[name] for name in keys}
        text = "".join(f"{keys[name]}={value!r}\n" for name, value in values.items())

        def faults(path, _):
            lines = dict(line.split("=") for line in path.read_text().splitlines())
            held = {name: float(lines[key]) for name, key in keys.items() if key in lines}
            return differences(values, held)

        return Draft(text, vehicle, (), faults)

    def entry(row):
        return registry_entries("ini")(row) or NoExportTag("an ini file holds sails alone")

    module = ModuleType("tuner.exporters.targets.ini")
    module.TARGET = Target("ini", ".ini", draft, replace(THIS_PROJECT, entry=entry))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(shipped, "EXPORT_TARGETS", [*shipped.EXPORT_TARGETS, "ini"])


def effects_that_do_nothing():
    """Return the vehicle's effects that change neither motion nor rotor speed of a flight.

    The first flight of a batch has all at their neutral values, each other one moves one of them.
    """
    rows = [row for row in REGISTRY.values() if row.is_effect and row.scope == "vehicle"]
    effects = {
        row.name: row.neutral + row.step * jnp.eye(len(rows) + 1)[number]
        for number, row in enumerate(rows, start=1)
    }
    craft = vehicle()
    near_the_ground = eqx.tree_at(
        lambda start: start.motion.position.z, moving_start(craft), jnp.asarray(0.3)
    )
    log = eqx.filter_jit(rollout)(
        replace(craft, effects=effects),
        controller(),
        Schedule(log_rate=400),
        wobble(craft, 6),
        near_the_ground,
        samples=5,
        environment=SURROUNDINGS,
    ).log
    last = np.stack([leaf[-1] for leaf in jax.tree.leaves((log.motion, log.rotor_speed))], axis=1)
    changes = np.max(np.abs(last[1:] - last[0]), axis=1)
    return [row.name for row, change in zip(rows, changes, strict=True) if change < 1e-10]


def test_every_effect_of_the_registry_acts_and_a_row_without_a_term_is_noticed(monkeypatch):
    monkeypatch.setitem(COEFFICIENTS, NAME, ROW)
    assert effects_that_do_nothing() == [NAME]


@pytest.mark.usefixtures("added")
def test_a_row_is_a_key_of_the_vehicle_file_and_of_the_job_file(updated, tmp_path):
    path = tmp_path / "v.yaml"
    write_vehicle(with_values(updated, {NAME: TRUTH}), path)
    assert values_of(read_vehicle(path))[NAME] == TRUTH
    assert any(NAME in line and ROW.unit in line for line in path.read_text().splitlines())
    assert JobFile(free=(NAME,)).free == (NAME,)


@pytest.mark.slow
@pytest.mark.usefixtures("added", "ini_target")
def test_a_coefficient_and_its_term_are_fitted_judged_reported_and_exported(updated, tmp_path):
    give_back(BEFORE_A_FIT)
    flown = with_values(updated, {NAME: TRUTH})
    bag = tmp_path / "circle.bag"
    flights = tuner.simulate("circle", vehicle=flown, radius=1.0, speed=3.0, duration=12.0)
    write_flights(flights, bag)
    (inspection,), _ = inspect_recordings([bag])
    assert any(informed.coefficient == NAME for informed in inspection.coefficients)

    job = tmp_path / "job.yaml"
    job.write_text("terms: none\n")
    run = tuner.fit(
        [bag],
        vehicle=updated,
        controller=ControllerFile(),
        free=[NAME, "rotor_drag_coefficient"],
        config=job,
        out=tmp_path / "run",
    )
    result = run.result.coefficients[NAME]
    assert result.initial == 0.0
    assert result.best == pytest.approx(TRUTH, rel=0.02)
    assert result.unit == ROW.unit
    assert result.verdict == "well_known"
    low, high = result.ci95
    assert low < result.best < high
    assert values_of(read_vehicle(run.folder / "best_fit.yaml"))[NAME] == result.best
    assert NAME in (run.folder / "report.html").read_text(encoding="utf-8")
    assert NAME in (run.folder / "sensitivity.csv").read_text(encoding="utf-8")

    again = tuner.export(run, "yaml").path
    assert values_of(read_vehicle(again))[NAME] == result.best
    assert f"sail={result.best!r}" in tuner.export(run, "ini").path.read_text()
    sdf = tuner.export(run, "sdf", accept="to read what is lost")
    assert any("is not exported: the motor plugins know no sail" in note for note in sdf.notes)
    with pytest.raises(ExportError, match=f"{NAME} is .* which --format px4 can neither write"):
        tuner.export(physical(run), "px4")


def physical(run):
    """Return a run of which exports hold the fit's values, none that make up for what is lost."""
    job = {**run.result.settings["job"], "target": "physical"}
    settings = {**run.result.settings, "job": job}
    return run.model_copy(update={"result": run.result.model_copy(update={"settings": settings})})


class More(CodeWithText):
    SAIL_TORN = ("sail_torn", "Its {first} tore after {seconds:.0f} s.", "Mend it.")  # seconds


def test_a_finding_is_one_entry_with_its_sentence_and_remedy():
    finding = Finding(More.SAIL_TORN, "warning", "circle", {"seconds": 3.0}, ("main_sail",))
    assert one_line(finding) == "warning: circle: Its main sail tore after 3 s. Mend it."
    assert shorten_finding(finding, 60).startswith("circle: Its main sail tore")
    with pytest.raises(TypeError):
        CodeWithText("SAIL", {"TORN": "torn"})  # no code without its sentence


class SwitchedMixer(Mixer):
    """PX4's quad-X mixer, and one switch more.

    Attributes
    ----------
    battery_compensation
        ``MC_BAT_SCALE_EN``.
    """

    battery_compensation: Flag = False


class SwitchedFile(ControllerFile):
    """A controller file with that mixer."""

    mixer: SwitchedMixer = SwitchedMixer()


def test_a_controller_switch_is_one_field_of_the_file_and_its_page():
    given = build(SwitchedFile, {"mixer": {"battery_compensation": True}}, "quad.yaml")
    assert given.mixer.battery_compensation
    with pytest.raises(ConfigError, match=r"battery_compensation"):
        build(SwitchedFile, {"mixer": {"battery_compensation": "perhaps"}}, "quad.yaml")
    assert "`battery_compensation` | true or false | `false` | `MC_BAT_SCALE_EN`." in sections_of(
        SwitchedFile
    )
