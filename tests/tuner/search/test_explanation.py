"""What a run has found survives whatever explains it, and every finding is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.docs.recorded import write_lab
from tuner.core.errors import OutputError
from tuner.findings.findings import MAX_FINITE, Code, Finding, one_line
from tuner.job.run import run
from tuner.options import Options
from tuner.result import read_run
from tuner.search.listener import Listener, Reporter
from tuner.terms import refit_with_disturbances as disturbances
from tuner.uncertainty.verdict import Verdict

JOB = """
terms: none
disturbances: none
free: [motor_constant, input_scaling, inertia_zz]
"""
CONVERGE = "Eigenvalues did not converge"


def fails(*_: object, **__: object) -> None:
    raise np.linalg.LinAlgError(CONVERGE)


def test_a_part_that_fails_is_named_and_the_rest_goes_on() -> None:
    told: list[str] = []
    reporter = Reporter(Listener(on_message=told.append))
    assert reporter.attempt("intervals", lambda: 1, None) == 1
    assert reporter.attempt("intervals", fails, None) is None
    (finding,) = reporter.findings
    assert (finding.code, finding.subject) == (Code.PART_FAILED, "intervals")
    assert told == [one_line(finding)]
    assert f"LinAlgError, {CONVERGE}" in told[0]


def test_a_full_disk_is_no_part() -> None:
    def full() -> None:
        raise OutputError("folder", "is full", "free some space")

    with pytest.raises(OutputError):
        Reporter().attempt("intervals", full, None)


def test_a_finding_is_reported_once() -> None:
    told: list[str] = []
    reporter = Reporter(Listener(on_message=told.append))
    finding = Finding(Code.SPINS_REVERSED, "warning", "motors")
    reporter.report([finding])
    reporter.add([finding])
    assert told == [one_line(finding)]
    assert reporter.findings == (finding,)


def test_a_finding_holds_numbers_that_json_has() -> None:
    finding = Finding(Code.FLIGHT_WORSE, "warning", "f", {"before": 1.0, "after": np.inf})
    assert finding.numbers == {"before": 1.0, "after": MAX_FINITE}


@pytest.mark.slow
def test_flights_that_hardly_tell_anything_end_in_a_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One flight alone tells of what turns the vehicle about its vertical axis.

    Parts fail where the search goes on from its end.
    """
    job, folder, told = tmp_path / "job.yaml", tmp_path / "run", list[str]()
    job.write_text(JOB)
    write_lab(tmp_path)
    flights = [str(tmp_path / f"{name}.bag") for name in ("circle_3mps", "yaw_spin_3rps")]
    options = Options(flights=flights, vehicle="hovergames", config=str(job))
    for broken in (False, True):
        if broken:
            monkeypatch.setattr(disturbances, "hold_undetermined", fails)
            monkeypatch.setattr("tuner.job.run.propose_logs", fails)
        told.clear()
        listener = Listener(on_message=told.append)
        folder, result = run(options, out=folder, resume=broken, listener=listener)
        assert (folder / "report.html").stat().st_size > 10_000
        assert read_run(folder).result == result
        findings = [one_line(finding) for finding in result.findings]
        assert [line for line in findings if line not in told] == []
        failed = [
            finding.subject for finding in result.findings if finding.code is Code.PART_FAILED
        ]
        assert failed == (["examination"] if broken else [])
        for name in ("motor_constant", "input_scaling"):  # the inertia is no rigid body's
            coefficient = result.coefficients[name]
            assert (coefficient.verdict is Verdict.NOT_EXAMINED) is broken
            assert (coefficient.std_error is None) is broken
        assert not any(finding.code is Code.FLIGHT_CRASHES for finding in result.findings)
