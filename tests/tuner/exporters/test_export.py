import shutil
from datetime import date
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.tuner.exporters.conftest import MODELS, as_the_run_says, rmse
from tuner.config import ExportSettings
from tuner.core import shipped
from tuner.core.errors import ExportError, InputError, OutputError
from tuner.exporters import export as exporting
from tuner.exporters.effective import Effective, lost_groups
from tuner.exporters.export import (
    RUN_CONDITIONS,
    check,
    export,
    export_formats_of_job,
    exported_vehicle,
    provenance,
)
from tuner.exporters.target import Draft, write
from tuner.options import ExportOptions
from tuner.report.result_texts import export_sentence
from tuner.result import EffectiveResult, LostTerm, PoseRmse
from tuner.vehicle import ExportTag, read_vehicle

TODAY = date(2024, 5, 6)


def exported(run, kind="yaml", refly=as_the_run_says, **options):
    return export(run, ExportOptions(kind, **options), refly=refly, today=TODAY)


def test_yaml_carries_source_date_run_and_confidence(make_run):
    run = make_run()
    done = exported(run)
    assert done.path == run.folder / "export" / "hovergames_updated.yaml"
    vehicle = read_vehicle(done.path)
    assert vehicle.mass == 2.243
    assert vehicle.source["run"] == str(run.folder.resolve())
    assert vehicle.source["date"] == "2024-05-06"
    assert vehicle.source["versions"] == {"tune": "0.1.0"}
    assert vehicle.source["flights"]["held"] == f"holdout, sha256 {'0' * 64}"
    fitted = vehicle.source["coefficients"]["motor_constant"]
    assert fitted["status"] == "fitted"
    assert fitted["std_error"] == pytest.approx(1.45e-7)
    assert fitted["ci95"] == pytest.approx([0.98 * 1.45e-5, 1.02 * 1.45e-5])
    assert vehicle.source["coefficients"]["time_constant_up"] == {"status": "fixed"}
    assert done.path.read_text().startswith("# fitted to circle; run run; 2024-05-06\n")


def test_what_moved_with_a_held_coefficient_keeps_its_value_and_the_notes_tell_them_apart(make_run):
    doubtful = {"fitted": True, "identifiable": False}
    run = make_run(
        coefficients={
            "input_scaling": doubtful
            | {"verdict": "held", "reason": {"code": "not_with_all_free"}},
            "motor_constant": doubtful
            | {
                "verdict": "not_identifiable",
                "reason": {"code": "not_with_all_free", "given_held": "input_scaling"},
            },
        }
    )
    done = exported(run)
    vehicle = read_vehicle(done.path)
    assert vehicle.aerodynamics.motor_constant == run.vehicle.aerodynamics.motor_constant
    held, moved = (
        next(note for note in done.notes if note.startswith(name))
        for name in ("input_scaling", "motor_constant")
    )
    assert "held at its initial value: " in held
    assert "fitted with input_scaling held at its initial value" in moved
    assert vehicle.source["coefficients"]["motor_constant"]["status"].startswith("not identifiable")


@pytest.mark.parametrize("kind", ["sdf", "px4"])
def test_the_other_formats_land_in_the_result_folder_too(make_run, kind):
    done = exported(make_run(), kind)
    assert done.path.parent.name == "export"
    assert "fitted to circle" in done.path.read_text()


def test_a_model_is_patched_where_it_is_or_beside(make_run, tmp_path):
    model = tmp_path / "quad.sdf"
    shutil.copy(MODELS / "quad_x.sdf", model)
    before = model.read_text()
    beside = tmp_path / "patched.sdf"
    assert exported(make_run(), "sdf", into=model, out=beside).path == beside
    assert model.read_text() == before
    assert exported(make_run(), "sdf", into=model).path == model
    assert model.read_text() == beside.read_text() != before


def test_a_model_behind_a_link_keeps_its_link_and_its_rights(make_run, tmp_path):
    model, link = tmp_path / "quad.sdf", tmp_path / "link.sdf"
    shutil.copy(MODELS / "quad_x.sdf", model)
    model.chmod(0o600)
    link.symlink_to(model)
    exported(make_run(), "sdf", into=link)
    assert link.is_symlink()
    assert "Coefficients by tune" in model.read_text()
    assert model.stat().st_mode & 0o777 == 0o600


def test_a_model_that_may_not_be_written_is_left(make_run, tmp_path, monkeypatch):
    model = tmp_path / "quad.sdf"
    shutil.copy(MODELS / "quad_x.sdf", model)
    before = model.read_text()
    monkeypatch.setattr("os.access", lambda path, _: path != model)  # root may write anything
    with pytest.raises(OutputError, match="may not write there"):
        exported(make_run(), "sdf", into=model)
    assert model.read_text() == before


def test_into_goes_with_sdf_only(make_run, tmp_path):
    with pytest.raises(ExportError, match="--into"):
        exported(make_run(), "px4", into=tmp_path / "x")


def test_a_missing_model_is_named(make_run, tmp_path):
    with pytest.raises(ExportError, match=r"gone\.sdf: does not exist"):
        exported(make_run(), "sdf", into=tmp_path / "gone.sdf")


CRASHED = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"))

BAD = [
    (
        {"flights": {"held": {"rmse_best": rmse(0.2)}}},
        "held position 0.3 m, before 0.15",
    ),
    (
        {"flights": {"held": {"rmse_best": {**rmse(0.001).model_dump(), "yaw": 3.0}}}},
        "held attitude 3 degrees",
    ),
    (
        {"coefficients": {"motor_constant": {"upper": 1.45e-5}}},
        "motor_constant 1.45e-05 is its upper",
    ),
    ({"coefficients": {"inertia_xx": {"lower": 0.028}}}, "inertia_xx 0.028 is its lower"),
    ({"flights": {"held": {"rmse_best": CRASHED}}}, "fit to export: held crashes; fit again"),
]


@pytest.mark.parametrize(("bad", "expected"), BAD)
def test_a_bad_set_is_refused_and_nothing_is_written(make_run, bad, expected):
    run = make_run(**bad)
    with pytest.raises(ExportError) as error:
        exported(run)
    assert expected in str(error.value)
    assert "--accept" in str(error.value)
    assert not (run.folder / "export").exists()


@pytest.mark.parametrize(("bad", "_expected"), BAD)
def test_a_reason_overrides_and_stands_in_the_file(make_run, bad, _expected):
    done = exported(make_run(**bad), accept="only to look at")
    assert "exported against a refusal: only to look at" in done.path.read_text()
    assert not all(gate.passed for gate in done.gates)


@pytest.mark.parametrize("kind", ["sdf", "mujoco", "yaml", "rotorpy"])
def test_a_reason_of_any_letters_leaves_the_file_readable(make_run, kind, tmp_path):
    run, model = make_run(**BAD[0][0]), tmp_path / "quad.sdf"
    shutil.copy(MODELS / "quad_x.sdf", model)
    into = {"into": model} if kind == "sdf" else {}
    for _ in range(2):  # and goes into it once more
        done = exported(run, kind, accept="odd --- it\x07\u2028has {{ c }} and {% if %}", **into)
    text = done.path.read_text()
    assert text.count("odd ") == 1
    if kind in ("sdf", "mujoco"):
        ElementTree.fromstring(text)


def test_a_crash_or_another_rmse_when_flown_again_is_refused(make_run):
    def crashes(run, vehicle):
        return as_the_run_says(run, vehicle) | {"circle": rmse(0.1).model_copy(update=CRASHED)}

    def differs(run, vehicle):
        return as_the_run_says(run, vehicle) | {"circle": rmse(0.0012)}

    def forgets(run, vehicle):
        return {"circle": as_the_run_says(run, vehicle)["circle"]}

    def cannot(_run, _vehicle):
        raise InputError("a.bag", "is not there any more", "look for it")

    for refly, expected in (
        (cannot, "cannot be flown again .a.bag: is not there any more"),
        (crashes, "circle crashes"),
        (differs, "circle x gives 0.0012, the run 0.001"),
        (forgets, "held was not flown again"),
    ):
        with pytest.raises(ExportError, match=expected):
            exported(make_run(), refly=refly)


def test_a_flight_that_crashed_in_the_run_is_no_better_though_it_flies_again(make_run):
    run = make_run(flights={"held": {"rmse_best": CRASHED}})
    again = as_the_run_says(run, run.vehicle) | {"held": rmse(0.001)}
    gates = check(run, run.vehicle, lambda *_: again)
    assert [objection for gate in gates for objection in gate.objections] == ["held crashes"]


@pytest.mark.parametrize("best", [0.0, 3e-7])
def test_a_coefficient_may_stay_at_the_bound_where_its_search_began(make_run, best):
    stayed = {"fitted": True, "lower": 0.0, "upper": 0.04, "best": best}
    run = make_run(coefficients={"actuator_latency": stayed})
    assert run.result.coefficients["actuator_latency"].initial == 0.0
    assert all(gate.passed for gate in check(run, run.vehicle, as_the_run_says))


@pytest.mark.parametrize(
    ("best", "told", "refused"), [(0.04, True, True), (0.04, False, False), (0.0, True, False)]
)
def test_a_coefficient_on_its_bound_that_moves_nothing_is_named(make_run, best, told, refused):
    """Neither one that no flight tells, nor a latency that went to zero, keeps the others back."""
    row = {"fitted": True, "lower": 0.0, "upper": 0.04, "initial": 0.01, "best": best}
    side = "upper" if best else "lower"
    row |= {"identifiable": told, "verdict": "weakly_known" if told else "not_identifiable"}
    row |= {"reason": {"code": "interval", "bound": side}}
    run = make_run(coefficients={"actuator_latency": row})
    objections = check(run, run.vehicle, as_the_run_says)[-1].objections
    assert objections == (("actuator_latency 0.04 is its upper bound",) if refused else ())
    assert RUN_CONDITIONS[-1] == "no coefficient that flights tell sits on a bound"
    (note,) = exported_vehicle(run, TODAY)[1]
    assert note.startswith(f"actuator_latency = {best:g} is")
    assert note.endswith(f"; it lies at its {side} bound")


def test_a_fixed_coefficient_may_equal_its_bound(make_run):
    run = make_run(coefficients={"mass": {"fitted": False, "upper": 2.243}})
    assert all(gate.passed for gate in check(run, run.vehicle, as_the_run_says))


def test_a_job_exports_what_it_asks_for_and_says_what_is_refused(make_run):
    run = make_run()
    model = MODELS / "quad_x.sdf"
    asked = ExportSettings(formats=("yaml", "sdf", "px4"), into=model)
    written = dict(export_formats_of_job(run.folder, asked, refly=as_the_run_says, today=TODAY))
    folder = run.folder / "export"
    names = ["hovergames_updated.yaml", "quad_x.sdf", "hovergames_updated.params"]
    assert list(written.values()) == [folder / name for name in names]
    sentence = export_sentence("sdf", written["sdf"])
    assert sentence == f"The sdf export was written to {folder / 'quad_x.sdf'}."
    assert (folder / "quad_x.sdf").read_text() != model.read_text()
    make_run(**BAD[0][0])
    for kind, refusal in export_formats_of_job(
        run.folder, asked, refly=as_the_run_says, today=TODAY
    ):
        assert export_sentence(kind, refusal).startswith(f"The {kind} export was refused: ")
        assert "held position" in str(refusal)


def test_no_two_formats_of_a_job_are_one_file(make_run):
    run = make_run()
    asked = ExportSettings(formats=tuple(shipped.EXPORT_TARGETS))
    written = dict(export_formats_of_job(run.folder, asked, refly=as_the_run_says, today=TODAY))
    paths = [path for path in written.values() if isinstance(path, Path)]
    assert len(set(paths)) == len(paths) >= 6


def test_a_file_that_would_not_read_back_is_not_written(tmp_path, make_run):
    (tmp_path / "a.txt").write_text("before")
    draft = Draft("text", make_run().vehicle, (), lambda path, _: [f"{path.read_text()} is wrong"])
    with pytest.raises(ExportError, match=r"a\.txt: would not read back: text is wrong"):
        write(draft, tmp_path / "a.txt")
    assert (tmp_path / "a.txt").read_text() == "before"


def test_gates_fly_what_the_format_holds(make_run, tmp_path):
    flown = []

    def refly(run, vehicle):
        flown.append(vehicle)
        return as_the_run_says(run, vehicle)

    run = make_run()
    curved = run.vehicle.replace(motor=run.vehicle.motor.replace(quadratic=30.0))
    exported(run.model_copy(update={"vehicle": curved}), "sdf", refly=refly, out=tmp_path / "a.sdf")
    exported(
        run.model_copy(update={"vehicle": curved}), "yaml", refly=refly, out=tmp_path / "a.yaml"
    )
    assert [vehicle.motor.quadratic for vehicle in flown] == [0.0, 30.0]


EFFECTIVE = EffectiveResult(
    target="gazebo",
    coefficients={"rotor_drag_coefficient": 3e-4, "mass": 2.243},
    lost=(
        LostTerm(
            group="fuselage_drag",
            names=("fuselage_drag",),
            rmse_without=PoseRmse(position=0.05, attitude=0.4),
        ),
    ),
    carried=(),
    rmse_physical=PoseRmse(position=0.002, attitude=0.1),
    rmse_unfitted=PoseRmse(position=0.05, attitude=0.4),
    rmse_effective=PoseRmse(position=0.0123, attitude=0.2),
    flights={"circle": rmse(0.005), "held": rmse(0.006)},
    converged=True,
)
DRAGGY = {
    "values": {"fuselage_drag": 0.03},
    "coefficients": {"fuselage_drag": {"initial": 0.0, "fitted": True}},
}


def in_both(run, _vehicle, flown=None):
    """Stand in for flying again: the run's flights as they are met by what it exports."""
    if flown is not None:
        flown.append(_vehicle)
    return {flight.name: flight.rmse_best for flight in run.result.flights}


@pytest.mark.parametrize("kind", ["sdf", "px4"])
def test_a_simulator_gets_the_effective_coefficients_and_the_file_says_so(
    make_run, kind, monkeypatch
):
    run, flown = make_run(**DRAGGY, effective=EFFECTIVE), []
    found = Effective(run.effective, EFFECTIVE)
    monkeypatch.setattr(exporting, "cached_effective", lambda *_: found)
    done = exported(run, kind, refly=lambda r, v: in_both(r, v, flown))
    if kind == "sdf":
        assert flown[0].aerodynamics.rotor_drag_coefficient == 3e-4
    else:  # as the SIH flies it
        hover = (2.243 * 9.81 / 4 / 1.45e-5) ** 0.5
        assert flown[0].effects["linear_drag_x"] == pytest.approx(4 * hover * 3e-4, rel=1e-3)
    assert not flown[0].effects.get("fuselage_drag")
    text = done.path.read_text()
    simulator = {"sdf": "Gazebo", "px4": "PX4's SIH"}[kind]
    assert f"effective coefficients, not physical ones: {simulator} lacks fuselage_drag" in text
    assert "by 1.2 cm and 0.2° where all terms miss them by 2 mm and 0.1°" in text
    lost = [note for note in done.notes if note.startswith("fuselage_drag is not exported")]
    assert len(lost) == 1
    assert "missed by 5 cm and 0.4°" in lost[0]


def test_what_holds_every_term_gets_the_physical_coefficients(make_run):
    done = exported(make_run(**DRAGGY, effective=EFFECTIVE), "yaml")
    vehicle = read_vehicle(done.path)
    assert vehicle.effects["fuselage_drag"] == 0.03
    assert vehicle.aerodynamics.rotor_drag_coefficient == 1.45e-4
    assert "effective" not in done.path.read_text()


def test_a_job_can_want_physical_coefficients_in_the_simulator(make_run):
    run = make_run(**DRAGGY, effective=EFFECTIVE, target="physical")
    done = exported(run, "sdf")
    assert "<rotorDragCoefficient>0.000145<" in done.path.read_text()
    assert "effective" not in done.path.read_text()
    assert any(note.startswith("fuselage_drag 0.03 N s²/m² is not exported") for note in done.notes)


def test_a_run_without_simulated_flights_says_so_where_its_numbers_stand(make_run):
    run = make_run()
    measured = run.model_copy(update={"result": run.result.model_copy(update={"flights": ()})})
    assert provenance(run, TODAY).startswith("fitted to circle; run ")
    assert provenance(measured, TODAY).startswith("measured, no flight was simulated; run ")


def test_where_nothing_is_held_out_fitted_flights_check_the_run(make_run):
    flights = {"circle": {"rmse_best": rmse(0.2)}, "held": {"split": "fit"}}
    with pytest.raises(ExportError, match=r"circle position 0\.3 m, before 0\.15"):
        exported(make_run(flights=flights), "yaml")
    flights["circle"] = {"rmse_initial": rmse(1e-9), "rmse_best": rmse(1e-6)}
    exported(make_run(flights=flights), "yaml")


def test_gates_ask_of_the_effective_coefficients_what_they_ask_of_others(make_run):
    worse = EFFECTIVE.model_copy(update={"flights": {"circle": rmse(0.005), "held": rmse(0.2)}})
    with pytest.raises(ExportError, match=r"held position 0\.3 m, before 0\.15"):
        exported(make_run(**DRAGGY, effective=worse), "sdf")
    bound = EFFECTIVE.model_copy(update={"coefficients": {"rotor_drag_coefficient": 4.03e-3}})
    with pytest.raises(ExportError, match=r"rotor_drag_coefficient 0\.00403 is its upper bound"):
        exported(make_run(**DRAGGY, effective=bound), "sdf")


def test_effective_coefficients_of_other_flights_are_no_fault_of_ours(make_run):
    edited = EFFECTIVE.model_copy(update={"flights": {"circle": rmse(0.005)}})
    with pytest.raises(ExportError, match="no flight 'held'; was it edited"):
        exported(make_run(**DRAGGY, effective=edited), "sdf")


def test_what_a_target_holds_is_not_lost_there():
    assert lost_groups(EFFECTIVE, lambda _: ExportTag("a tag"), ()) == ()
