from pathlib import Path

import pytest

from tuner.config import JobFile
from tuner.core.shipped import configs_folder
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.records import AxesRmse
from tuner.result import CoefficientResult, FlightResult, RunResult, SearchResult, read_run
from tuner.search.job_flights import JobFlight
from tuner.vehicle import (
    COEFFICIENTS,
    ControllerFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)

MODELS = Path(__file__).resolve().parents[3] / "examples" / "models"


@pytest.fixture
def vehicle():
    return read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")


def rmse(scale):
    return AxesRmse(x=scale, y=scale, z=scale / 2, roll=20 * scale, pitch=20 * scale, yaw=5 * scale)


@pytest.fixture
def make_run(tmp_path):
    """Return a function that writes a result folder; what it is given replaces what is usual."""

    def make(
        *,
        coefficients=None,
        flights=None,
        vehicle="hovergames_updated",
        values=None,
        effective=None,
        target="gazebo",
    ):
        start = read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml")
        best = read_vehicle(configs_folder() / "vehicles" / f"{vehicle}.yaml")
        best = with_values(best, values or {})
        rows = {}
        for name, initial in values_of(start).items():
            value = values_of(best)[name]
            rows[name] = {
                "unit": COEFFICIENTS[name].unit,
                "initial": initial,
                "best": value,
                "fitted": value != initial,
                "lower": 0.2 * initial,
                "upper": 5.0 * initial,
                "std_error": 0.01 * value,
                "ci95": (0.98 * value, 1.02 * value),
                "identifiable": True,
                "verdict": "well_known",
                "reason": {"code": "interval", "half_width": 0.02},
            } | (coefficients or {}).get(name, {})
        best = with_values(best, {name: row["best"] for name, row in rows.items()})
        usual = {
            "circle": {"split": "fit", "rmse_best": rmse(0.001)},
            "held": {"split": "holdout", "rmse_best": rmse(0.002)},
        }
        shown = [
            FlightResult(
                **{
                    "name": name,
                    "path": f"{name}.bag",
                    "sha256": "0" * 64,
                    "duration": 36.0,
                    "time_offset": 0.0,
                    "rmse_initial": rmse(0.1),
                }
                | flight
                | (flights or {}).get(name, {})
            )
            for name, flight in usual.items()
        ]
        folder = tmp_path / "run"
        folder.mkdir(exist_ok=True)
        write_vehicle(best, folder / "best_fit.yaml")
        result = RunResult(
            schema_version=2,
            status="converged",
            seed=0,
            versions={"tune": "0.1.0"},
            settings={"job": {"target": target}},
            effective=effective,
            coefficients={name: CoefficientResult(**data) for name, data in rows.items()},
            flights=tuple(shown),
            findings=(),
            search=SearchResult(
                method="gradient",
                evaluations=30,
                iterations=10,
                wall_time=1.0,
                cost_initial=100.0,
                cost_best=1.0,
                converged=True,
                message="no_further_gain",
            ),
        )
        if effective is not None:
            in_gazebo = best.replace(effects={}).replace(name="in_gazebo")
            in_gazebo = with_values(in_gazebo, effective.coefficients)
            write_vehicle(in_gazebo, folder / "effective.yaml")
        result.write(folder)
        return read_run(folder)

    return make


@pytest.fixture
def run(bag, flight, updated, tmp_path):
    """A result folder that is true of one recording, which it held out."""
    start = with_values(updated, {"rotor_drag_coefficient": 4e-4})
    comparison = Comparison([JobFlight(flight)], ControllerFile())
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


def as_fitted(run):
    """Return a run that fitted the recording which it held out."""
    (flight,) = run.result.flights
    flights = (flight.model_copy(update={"split": "fit"}),)
    return run.model_copy(update={"result": run.result.model_copy(update={"flights": flights})})


def as_the_run_says(run, _vehicle, _flier=None):
    """Stand in for flying again where a test is about something else."""
    return {flight.name: flight.rmse_best for flight in run.result.flights}
