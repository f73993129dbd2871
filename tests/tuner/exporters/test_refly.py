from datetime import date

import pytest

from tests.tuner.exporters.conftest import MODELS
from tuner.cli import main
from tuner.config import JobFile
from tuner.core.errors import ExportError
from tuner.evaluate.comparison import Comparison
from tuner.exporters import effective
from tuner.exporters.effective import kept_effective, refly
from tuner.exporters.export import export
from tuner.exporters.simulators import GZ_SIM
from tuner.options import ExportOptions
from tuner.result import (
    CoefficientResult,
    FlightResult,
    RunResult,
    SearchResult,
    read_run,
)
from tuner.search.job_flights import Recording
from tuner.vehicle import (
    COEFFICIENTS,
    ControllerFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)


@pytest.fixture
def run(bag, flight, updated, tmp_path):
    """A result folder that is true of one recording."""
    start = with_values(updated, {"rotor_drag_coefficient": 4e-4})
    comparison = Comparison([Recording(flight)], ControllerFile())
    coefficients = {
        name: CoefficientResult(
            unit=COEFFICIENTS[name].unit,
            initial=value,
            best=values_of(updated)[name],
            fitted=name == "rotor_drag_coefficient",
            identifiable=True,
            verdict="well_known",
            reason={"code": "interval"},
        )
        for name, value in values_of(start).items()
    }
    before, after = (comparison.fly(v)["small_circle"].rmse for v in (start, updated))
    held_out = FlightResult(
        name="small_circle",
        path=str(bag),
        sha256=flight.sha256,
        split="holdout",
        duration=flight.duration,
        time_offset=0.0,
        rmse_initial=before,
        rmse_best=after,
    )
    result = RunResult(
        schema_version=2,
        status="converged",
        seed=0,
        versions={},
        settings={
            "controller": ControllerFile().model_dump(mode="json"),
            "job": JobFile().model_dump(mode="json"),
            "vehicle": start.model_dump(mode="json"),
        },
        coefficients=coefficients,
        flights=(held_out,),
        findings=(),
        search=SearchResult(
            method="gradient",
            evaluations=1,
            iterations=1,
            wall_time=1.0,
            cost_initial=1.0,
            cost_best=0.0,
            converged=True,
            message="no_further_gain",
        ),
    )
    result.write(tmp_path)
    write_vehicle(updated, tmp_path / "best_fit.yaml")
    return read_run(tmp_path)


def test_a_true_run_flies_again_as_it_says(run):
    again = refly(run, run.vehicle)["small_circle"]
    assert again.model_dump() == pytest.approx(run.result.flights[0].rmse_best.model_dump())
    done = export(run, ExportOptions("yaml"), refly=refly, today=date(2024, 5, 6))
    assert all(gate.passed for gate in done.gates)
    assert read_vehicle(done.path).aerodynamics == run.vehicle.aerodynamics


def test_recordings_are_read_as_the_run_read_them(run, monkeypatch):
    def read(settings, *, fits):
        seen.append(settings.vehicle)
        return reading(settings, fits=fits)

    seen, reading = [], effective.read_usable
    monkeypatch.setattr(effective, "read_usable", read)
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
            export(other, ExportOptions("yaml"), refly=refly, today=date(2024, 5, 6))


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
            export(other, ExportOptions("yaml"), refly=refly, today=date(2024, 5, 6))


def test_the_command_exports_and_says_what_it_did(run, capsys, tmp_path):
    model = tmp_path / "quad.sdf"
    model.write_text((MODELS / "quad_x.sdf").read_text())
    assert main(["export", str(run.folder), "--format", "sdf", "--into", str(model)]) == 0
    out = capsys.readouterr().out
    assert "yes  no held-out flight is worse than before" in out
    assert "'base_link' gets 2.204 kg" in out
    assert f"written to {model} and read back" in out
    assert "<motorConstant>1.45e-05<" in model.read_text()


def test_the_command_refuses_in_one_line(run, capsys):
    write_vehicle(with_values(run.vehicle, {"mass": 9.0}), run.folder / "best_fit.yaml")
    assert main(["export", str(run.folder), "--format", "yaml"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "small_circle crashes" in err
    assert "--accept" in err
    accepted = ["export", str(run.folder), "--format", "yaml", "--accept", "to look at"]
    assert main(accepted) == 0
    assert "NO   every trajectory" in capsys.readouterr().out


def test_a_simulator_gets_coefficients_of_its_own_and_flies_as_it_computes(run, monkeypatch):
    flight = run.result.flights[0].model_copy(update={"split": "fit"})
    result = run.result.model_copy(update={"flights": (flight,)})
    run = run.model_copy(update={"result": result})
    today = date(2024, 5, 6)
    with pytest.raises(ExportError, match="small_circle"):  # physical ones fly otherwise there
        export(run, ExportOptions("gz-sim"), refly=refly, today=today)
    done = export(run, ExportOptions("gz-sim"), refly=refly, refit=kept_effective, today=today)
    assert all(gate.passed for gate in done.gates)
    vehicle, found = kept_effective(run, GZ_SIM)
    assert found.rmse_effective.position < found.rmse_unfitted.position
    assert {term.group for term in found.lost} >= {"max_relative_airspeed"}
    assert vehicle == GZ_SIM.flown(vehicle)
    assert "effective coefficients, not physical ones: gz-sim lacks" in done.path.read_text()

    def fail(*_):
        raise AssertionError("it is kept")

    monkeypatch.setattr(effective, "effective_in", fail)
    assert kept_effective(run, GZ_SIM) == (vehicle, found)
