from datetime import date

import pytest

from tests.tuner.exporters.conftest import MODELS, as_fitted
from tuner.cli import main
from tuner.core.errors import ExportError
from tuner.exporters import effective
from tuner.exporters import export as exporting
from tuner.exporters.effective import cached_effective, refly
from tuner.exporters.export import export
from tuner.exporters.simulators import GZ_SIM
from tuner.options import ExportOptions
from tuner.vehicle import read_vehicle, values_of, with_values, write_vehicle


def test_a_true_run_flies_again_as_it_says(run):
    again = refly(run, run.vehicle)["small_circle"]
    assert again.model_dump() == pytest.approx(run.result.flights[0].rmse_best.model_dump())
    done = export(run, ExportOptions("yaml"), today=date(2024, 5, 6))
    assert all(gate.passed for gate in done.gates)
    assert read_vehicle(done.path).aerodynamics == run.vehicle.aerodynamics


def test_recordings_are_read_as_the_run_read_them(run, monkeypatch):
    def read(settings, *, fits):
        seen.append(settings.vehicle)
        return reading(settings, fits=fits)

    seen, reading = [], effective.read_recordings
    monkeypatch.setattr(effective, "read_recordings", read)
    refly(run, with_values(run.vehicle, {"motor_constant": 2e-5}))
    (began_with,) = seen  # by it commands follow from a commanded wrench, and inlets are chosen
    assert values_of(began_with)["rotor_drag_coefficient"] == 4e-4
    assert values_of(began_with)["motor_constant"] == values_of(run.vehicle)["motor_constant"]


def test_numbers_that_fly_otherwise_are_refused(run):
    for values, expected in (
        ({"rotor_drag_coefficient": 3e-4}, "small_circle x gives"),
        ({"mass": 9.0}, "small_circle crashes"),
    ):
        other = run.model_copy(update={"vehicle": with_values(run.vehicle, values)})
        with pytest.raises(ExportError, match=expected):
            export(other, ExportOptions("yaml"), today=date(2024, 5, 6))


def test_a_recording_that_is_gone_or_changed_is_said(run, tmp_path):
    overwritten = tmp_path / "small_circle.bag"
    overwritten.touch()
    for change, expected in (
        ({"path": str(tmp_path / "gone.bag")}, "is not there any more"),
        ({"path": str(overwritten)}, "is empty"),
        ({"path": run.result.flights[0].path, "name": "other"}, "is not the recording of the run"),
        ({"sha256": "0" * 64}, "is not the recording of the run"),
    ):
        flights = (run.result.flights[0].model_copy(update=change),)
        other = run.model_copy(
            update={"result": run.result.model_copy(update={"flights": flights})}
        )
        with pytest.raises(ExportError, match=expected):
            export(other, ExportOptions("yaml"), today=date(2024, 5, 6))


def test_the_command_exports_and_says_what_it_did(run, capsys, tmp_path):
    model = tmp_path / "quad.sdf"
    model.write_text((MODELS / "quad_x.sdf").read_text())
    assert main(["export", str(run.folder), "--format", "sdf", "--into", str(model)]) == 0
    out = capsys.readouterr().out
    assert "yes  no flight that checks the run is worse than before" in out
    assert "'base_link' gets 2.204 kg" in out
    assert f"written to {model} and read back" in out
    assert "<motorConstant>1.45e-05<" in model.read_text()


def test_the_command_refuses_in_one_line(run, capsys):
    write_vehicle(with_values(run.vehicle, {"mass": 9.0}), run.folder / "best_fit.yaml")
    rows = run.result.coefficients
    heavy = rows | {"mass": rows["mass"].model_copy(update={"best": 9.0})}
    run.result.model_copy(update={"coefficients": heavy}).write(run.folder)
    assert main(["export", str(run.folder), "--format", "yaml"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "small_circle crashes" in err
    assert "--accept" in err
    accepted = ["export", str(run.folder), "--format", "yaml", "--accept", "to look at"]
    assert main(accepted) == 0
    assert "NO   every trajectory" in capsys.readouterr().out


def test_a_simulator_gets_coefficients_of_its_own_and_flies_as_it_computes(run, monkeypatch):
    run, today = as_fitted(run), date(2024, 5, 6)
    with monkeypatch.context() as without:  # physical ones fly otherwise there
        without.setattr(exporting, "cached_effective", lambda *_: None)
        with pytest.raises(ExportError, match="small_circle"):
            export(run, ExportOptions("gz-sim"), today=today)
    done = export(run, ExportOptions("gz-sim"), today=today)
    assert all(gate.passed for gate in done.gates)
    kept = cached_effective(run, GZ_SIM)
    assert kept.result.rmse_effective.position < kept.result.rmse_unfitted.position
    assert {term.group for term in kept.result.lost} >= {"max_relative_airspeed"}
    assert kept.vehicle == GZ_SIM.flown(kept.vehicle)
    assert "effective coefficients, not physical ones: gz-sim lacks" in done.path.read_text()

    def fail(*_):
        raise AssertionError("it is kept")

    monkeypatch.setattr(effective, "find_effective", fail)
    assert cached_effective(run, GZ_SIM) == kept
