"""What a job asks for is checked at once: each refusal names the key and what to do."""

import pytest

from tests.tuner.service.conftest import LIMITS, listening, submit, upload
from tuner.service.request import FLIGHTS, JobRequest, check_request
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings
from tuner.vehicle import ControllerFile, VehicleFile

FLIGHT = ("circle_3.bag", "circle_4.bag")
IDS = ("0" * 64, "1" * 64)


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    """A server that works on nothing, one for all."""
    data = tmp_path_factory.mktemp("service")
    service = Service.open(ServiceSettings(data, workers=0, limits=LIMITS))
    with listening(service) as opened:
        yield opened
    service.close()


@pytest.fixture
def recording(client, table):
    return upload(client, table.read_bytes())


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"settings": {"mas": 2}}, "settings: unknown key 'mas'; did you mean 'mass'?"),
        ({"settings": {"mass": -1}}, "settings: mass is -1"),
        ({"settings": {"search": {"starts": 0}}}, "settings: search.starts is 0"),
        (
            {"settings": {"free": ["mss"]}},
            "settings: unknown coefficient 'mss'; did you mean 'mass'?",
        ),
        ({"settings": {"export": {"into": "/etc/x.sdf"}}}, "settings: export.into names a file"),
        ({"settings": {"vehicle": "../../etc/passwd"}}, "vehicle: '../../etc/passwd' is not known"),
        ({"settings": {"topics": "/etc/passwd"}}, "topics: '/etc/passwd' is not known here"),
        ({"settings": {"topics": {"name": "x"}}}, "topics: key 'format' is missing; add it"),
        ({"vehicle": "hovergame"}, "vehicle: 'hovergame' is not known here; did you mean 'hover"),
        ({"vehicle": {"name": "x"}}, "vehicle: key 'mass' is missing; add it"),
        ({"controller": {"rate": 5}}, "controller: rate is 5"),
        ({"holdout": ["hop"]}, "holdout: holds out all flights; leave one to fit"),
        ({"holdout": ["hip"]}, "holdout: there is no flight 'hip'; did you mean 'hop'?"),
        ({"holdout": ["/etc/passwd"]}, "holdout: there is no flight '/etc/passwd'"),
        ({"fit": ["mass"], "fix": ["mass"]}, "fit: cannot stand beside fix; give one of them"),
        ({"fit": ["mss"]}, "fit: unknown coefficient 'mss'"),
        ({"mass": "heavy"}, "the request: mass is 'heavy'; it should be a number"),
        ({"method": "magic"}, "the request: method is 'magic'"),
        ({"name": "a\x07b"}, "the request: a name holds characters that cannot be printed"),
        ({"nam": "x"}, "the request: unknown key 'nam'; did you mean 'name'?"),
        ({"recordings": []}, "the request: recordings is []; it should have at least 1"),
        (
            {"recordings": ["x"]},
            "the request: recordings[0] is 'x'; it should be a recording's id: 64 digits",
        ),
        ({"recordings": ["f" * 64]}, "recordings: ffffffffffff… was not uploaded here; upload"),
    ],
    ids=str,
)
def test_a_request_is_refused_in_one_sentence(client, recording, more, said):
    answer = client.post("/api/v1/jobs", json={"recordings": [recording], **more})
    assert answer.status_code == 422
    problem = answer.json()
    assert problem["detail"].startswith(said)
    assert problem["detail"] == f"{problem['where']}: {problem['what']}; {problem['remedy']}"
    assert "/tmp" not in problem["detail"]


@pytest.mark.parametrize("body", [b"", b"{", b"[" * 100_000, b"\xff", b"null", b"[]", b'"x"'])
def test_a_body_that_is_no_request_is_refused(client, body):
    answer = client.post("/api/v1/jobs", content=body, headers={"content-type": "application/json"})
    assert answer.status_code in (400, 422)
    assert set(answer.json()) == {"where", "what", "remedy", "detail"}
    assert "the file" not in answer.json()["detail"]


def test_a_request_that_is_not_sent_as_json_is_told_how_to_be(client):
    form = {"content-type": "application/x-www-form-urlencoded"}  # as curl -d has it
    answer = client.post("/api/v1/jobs", content=b'{"recordings": []}', headers=form)
    assert answer.status_code == 422
    assert answer.json()["detail"] == (
        "the request: is not sent as JSON; send the header Content-Type: application/json"
    )


def test_two_recordings_of_one_name_are_refused(client, table):
    ids = [upload(client, table.read_bytes() + extra, "a/hop.csv") for extra in (b"", b"3,1,1")]
    answer = client.post("/api/v1/jobs", json={"recordings": ids})
    assert answer.json()["detail"] == (
        "hop.csv: is the name of two recordings; rename one and upload it again"
    )


def test_what_is_asked_becomes_what_tune_would_have_been_called_with(tmp_path, updated):
    request = JobRequest(
        recordings=IDS,
        holdout=("circle_4.bag",),
        vehicle=updated.model_dump(mode="json", exclude_none=True),
        controller="hovergames_sitl",
        settings={"mass": 2.3, "topics": {"name": "t", "format": "ros", "signals": {}}},
        seed=3,
    )
    asked, vehicle, holdout = check_request(request, FLIGHT, {})
    assert (vehicle, holdout) == (updated.name, {"circle_4"})
    (tmp_path / FLIGHTS).mkdir()
    asked.lay_out(tmp_path)
    options = asked.options(tmp_path, FLIGHT)
    assert options.flights == [str(tmp_path / FLIGHTS / name) for name in FLIGHT]
    assert options.vehicle == updated
    assert (options.controller, options.seed, options.holdout) == (
        "hovergames_sitl",
        3,
        ("circle_4",),
    )
    assert "mass: 2.3" in (tmp_path / FLIGHTS / "tune.yaml").read_text()
    assert options.topics == str(tmp_path / "topics.yaml")


def test_content_survives_the_table(client, recording, updated):
    own = updated.model_dump(mode="json", exclude_none=True)
    job = submit(
        client, recording, vehicle=own, controller=ControllerFile().model_dump(mode="json")
    )
    assert client.get(f"/api/v1/jobs/{job}").json()["vehicle"] == updated.name
    assert VehicleFile.model_validate(own) == updated
