"""Draws of the joint posterior: their covariance is the posterior's, their bounds the search's."""

import csv
from datetime import date

import numpy as np
import pytest

from tests.tuner.exporters.conftest import as_the_run_says
from tuner.core.errors import ExportError, InputError
from tuner.exporters.draws import draws_of
from tuner.exporters.export import export_draws
from tuner.exporters.target import module_assignments
from tuner.options import ExportOptions
from tuner.uncertainty.records import Knowledge
from tuner.vehicle import read_vehicle, values_of

NAMES = ("inertia_xx", "motor_constant", "moment_constant", "estimate_latency")
CORRELATION = np.array(
    [[1.0, 0.8, -0.3, 0.0], [0.8, 1.0, 0.1, 0.2], [-0.3, 0.1, 1.0, 0.0], [0.0, 0.2, 0.0, 1.0]]
)
ERRORS = np.array([0.02, 0.05, 0.01, 0.002])  # of logarithms; the latency's in s
TODAY = date(2024, 5, 6)


@pytest.fixture
def run(make_run):
    run = make_run(
        values={"estimate_latency": 0.05},
        coefficients={"estimate_latency": {"lower": 0.0, "upper": 0.1, "fitted": True}},
    )
    rows = run.result.coefficients
    unit = np.array([1.0 if n == "estimate_latency" else rows[n].best for n in NAMES])
    scaled = CORRELATION * np.outer(ERRORS, ERRORS)
    Knowledge(
        coefficients={},
        flights=[],
        channels=[],
        outputs=[],
        effects_over_time=[],
        residuals=[],
        directions=[],
        names=list(NAMES),
        correlation=CORRELATION.tolist(),
        covariance=(scaled * np.outer(unit, unit)).tolist(),
        information=np.eye(4).tolist(),
    ).write(run.folder)
    return run


def test_the_covariance_of_draws_is_the_posteriors(run):
    draws = draws_of(run, 8000)
    assert draws.names == NAMES
    latency = NAMES.index("estimate_latency")
    scaled = np.log(draws.values / draws.best)
    scaled[:, latency] = draws.values[:, latency] - draws.best[latency]
    wanted = CORRELATION * np.outer(ERRORS, ERRORS)
    found = np.cov(scaled.T)
    # that of n draws scatters by sqrt((c_ii c_jj + c_ij²)/n)
    spread = np.sqrt((np.outer(np.diag(wanted), np.diag(wanted)) + wanted**2) / 8000)
    assert (np.abs(found - wanted) / spread).max() < 4.0
    assert (np.abs(scaled.mean(axis=0)) / (ERRORS / np.sqrt(8000))).max() < 4.0
    np.testing.assert_array_equal(draws.values, draws_of(run, 8000).values)


def test_bounds_and_rigid_bodies_are_kept(run):
    rows = dict(run.result.coefficients)
    best = rows["motor_constant"].best
    rows["motor_constant"] = rows["motor_constant"].model_copy(
        update={"lower": 0.99 * best, "upper": 1.02 * best}
    )
    bounded = run.model_copy(
        update={"result": run.result.model_copy(update={"coefficients": rows})}
    )
    constants = draws_of(bounded, 500).values[:, 1]
    assert len(constants) == 500
    assert constants.min() >= 0.99 * best
    assert constants.max() <= 1.02 * best
    rows["motor_constant"] = rows["motor_constant"].model_copy(
        update={"lower": 2 * best, "upper": 3 * best}
    )
    with pytest.raises(ExportError, match="hardly meets"):
        draws_of(bounded.model_copy(
            update={"result": run.result.model_copy(update={"coefficients": rows})}
        ), 5)  # fmt: skip


def test_draws_become_a_table_files_and_ranges(run, tmp_path):
    asked = ExportOptions("isaaclab", draws=30, out=tmp_path / "draws")
    done = export_draws(run, asked, refly=as_the_run_says, today=TODAY)
    assert any("30 draws of the joint posterior" in note for note in done.notes)
    with (tmp_path / "draws" / "draws.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 30
    assert len(list((tmp_path / "draws").glob("draw_*_isaaclab.py"))) == 30
    low, high = module_assignments(tmp_path / "draws" / "ranges_isaaclab.py")["THRUSTER"][
        "thrust_const_range"
    ]
    constants = np.array([float(row["motor_constant"]) for row in rows]) * (2 * np.pi) ** 2
    assert [low, high] == pytest.approx(np.percentile(constants, (2.5, 97.5)).tolist())


def test_each_draw_is_a_vehicle_file(run, tmp_path):
    asked = ExportOptions("yaml", draws=3, out=tmp_path / "d")
    export_draws(run, asked, refly=as_the_run_says, today=TODAY)
    vehicles = [read_vehicle(path) for path in sorted((tmp_path / "d").glob("draw_*.yaml"))]
    assert len({v.aerodynamics.motor_constant for v in vehicles}) == 3
    assert {values_of(v)["mass"] for v in vehicles} == {2.243}


def test_what_cannot_be_drawn_is_said(run):
    for count in (0, 10_001):
        with pytest.raises(ExportError, match="ask for 1 to 10000"):
            draws_of(run, count)
    (run.folder / "sensitivity.json").unlink()
    with pytest.raises(InputError, match=r"sensitivity\.json"):
        draws_of(run, 3)
