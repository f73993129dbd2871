"""The HTTP interface asked whatever its own description allows, by Schemathesis."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from markupsafe import escape
from schemathesis.checks import CHECKS, load_all_checks

from tests.tuner.service.conftest import LIMITS, ended, listening, submit, upload
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings

EXAMPLES = 25
"""Requests for each operation, and as many that break its description."""
MANY = 400
RIGHTLY, WRONGLY = schemathesis.GenerationMode.POSITIVE, schemathesis.GenerationMode.NEGATIVE
load_all_checks()
logger = logging.getLogger(__name__)
NAMES = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_schema_conformance",
    "response_headers_conformance",
)


@pytest.fixture
def served(tmp_path, table):
    """A server with a job that is done, which has a name that requests may hit upon."""
    limits = replace(LIMITS, requests_in_a_burst=10**9)
    service = Service.open(ServiceSettings(tmp_path / "data", limits=limits))
    with listening(service) as client:
        job = ended(client, submit(client, upload(client, table.read_bytes())))
        yield client, job["id"]
    service.close()


@pytest.mark.slow
@pytest.mark.parametrize("examples", [EXAMPLES, pytest.param(MANY, marks=pytest.mark.long)])
def test_no_answer_is_a_fault_or_undocumented(served, examples):
    client, job = served
    schema = schemathesis.openapi.from_url(f"{client.base_url}/api/v1/openapi.json")
    checks = [CHECKS.get_one(name) for name in NAMES]
    statuses: Counter[int] = Counter()

    def ask(case: schemathesis.Case) -> None:
        if "job" in case.path_parameters and case.method == "GET" and len(statuses) % 2:
            case.path_parameters["job"] = job
        answer = case.call(session=None)
        statuses[answer.status_code] += 1
        case.validate_response(answer, checks=checks)

    for result in schema.get_all_operations():
        operation = result.ok()
        # any text is a path's part: what has no parameter beside cannot be asked wrongly
        beside = operation.body or [p for p in operation.iter_parameters() if p.location != "path"]
        for mode in (RIGHTLY, WRONGLY) if beside else (RIGHTLY,):
            strategy = operation.as_strategy(generation_mode=mode)
            run = settings(
                max_examples=examples,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
                deadline=None,
                derandomize=True,
            )
            run(given(strategy)(ask))()
    logger.info("%d requests, by status %s", sum(statuses.values()), dict(sorted(statuses.items())))
    assert sum(statuses.values()) > 300
    assert max(statuses) < 500
    assert {200, 404, 422} <= set(statuses)


def test_the_description_is_a_page_that_needs_nothing_else(served):
    client, _ = served
    described = client.get("/api/v1/openapi.json").json()
    page = client.get("/api").text
    for path, calls in described["paths"].items():
        for method, call in calls.items():
            assert f"{method.upper()} {escape(path)}</code>" in page
            assert all(
                f"<code>{given['name']}</code>" in page for given in call.get("parameters", ())
            )
    assert all(
        f"<code>{key}</code>" in page
        for key in described["components"]["schemas"]["JobRequest"]["properties"]
    )
    assert "http://" not in page
    assert "https://" not in page
