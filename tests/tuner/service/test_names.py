"""A job over HTTP, whatever it calls things: all that becomes of it lies in its own folder."""

from datetime import date

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tuner.exporters.conftest import as_the_run_says, make_run
from tests.tuner.service.conftest import listening
from tests.tuner.test_names import EXAMPLES, NAMES, nothing_outside
from tuner.config import ExportSettings, resolve_settings
from tuner.exporters.export import export_formats_of_job
from tuner.result import BEST_FIT_FILE
from tuner.service.dispatcher import prepare
from tuner.service.jobs import JobQueue
from tuner.vehicle import ControllerFile, write_vehicle

__all__ = ["make_run"]

CALLED = ("file", "vehicle", "controller", "job", "topics")


@pytest.fixture
def client(idle):
    with listening(idle) as opened:
        yield opened


@settings(EXAMPLES, max_examples=25)
@given(st.fixed_dictionaries(dict.fromkeys(CALLED, NAMES)))
def test_a_job_over_http_stays_in_its_folder(idle, client, make_run, called):
    run = make_run()
    vehicle = run.vehicle.model_dump(mode="json", exclude_none=True) | {"name": called["vehicle"]}
    flying = ControllerFile().model_dump(mode="json", exclude_none=True)
    topics = {"name": called["topics"], "format": "table", "signals": {"position": ["x", "y", "z"]}}
    more = {"controller": flying | {"name": called["controller"]}, "name": called["job"]}
    queue, claims = JobQueue(idle.database, "test", 30.0), []
    with nothing_outside(idle.settings.data):
        sent = client.post("/api/v1/recordings", files={"file": (called["file"] or "x", b"x\n0\n")})
        job = {"recordings": [sent.json()["id"]], "vehicle": vehicle}
        client.post("/api/v1/jobs", json=job)
        client.post("/api/v1/jobs", json=job | more | {"settings": {"topics": topics}})
        while (claim := queue.claim()) is not None:
            claims.append(claim)
            folder = idle.settings.work / claim.id
            asked = prepare(folder, claim, idle.store)
            flown = resolve_settings(asked.options(folder, tuple(claim.flights))).vehicle
            result = folder / "result"
            result.mkdir()
            for file in run.folder.glob("*.*"):
                (result / file.name).write_bytes(file.read_bytes())
            write_vehicle(flown, result / BEST_FIT_FILE)
            wanted = ExportSettings(formats=("yaml", "px4"))
            list(
                export_formats_of_job(result, wanted, refly=as_the_run_says, today=date(2024, 5, 6))
            )
    assert bool(claims) == called["vehicle"].isprintable() & bool(called["vehicle"].strip()) & (
        len(called["vehicle"]) <= 100
    )
