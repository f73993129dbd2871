"""Recordings on their way in: whole or not at all, inspected apart, bounded in every way."""

import hashlib
import os
import socket
import sys
import threading
from dataclasses import replace
from urllib.parse import urlsplit

import httpx
import pytest

from tests.tuner.service.conftest import FLIGHTS, LIMITS, listening, upload
from tuner.errors import RecordingError
from tuner.service import incoming, inspecting, recordings
from tuner.service.service import Service
from tuner.service.settings import MIB

BAG = FLIGHTS / "yaw_spin_3rps.bag"


def send(client: httpx.Client, content: bytes, name: str = "a.csv") -> httpx.Response:
    return client.post("/api/v1/recordings", files={"file": (name, content)})


def left(service: Service) -> list[str]:
    return [path.name for path in service.settings.incoming.iterdir()]


@pytest.mark.usefixtures("real_inspection")
def test_an_upload_is_answered_with_what_inspect_says(client, service):
    content = BAG.read_bytes()
    answer = send(client, content, BAG.name)
    assert answer.status_code == 201
    found = answer.json()
    assert set(found) == {"id", "name", "inspection"}
    assert found["id"] == hashlib.sha256(content).hexdigest()
    assert found["name"] == found["inspection"]["path"] == "yaw_spin_3rps.bag"
    assert found["inspection"]["missions"][0]["yaw_rate_setpoint"] == pytest.approx(3.0)
    again = send(client, content, "same.bag")
    assert (again.status_code, again.json()["id"]) == (200, found["id"])
    stored = [path for path in (service.settings.data / "store").rglob("*") if path.is_file()]
    assert len(stored) == 1
    assert stored[0].read_bytes() == content
    assert client.get(f"/api/v1/recordings/{found['id']}").json()["name"] == "same.bag"
    assert left(service) == []


@pytest.mark.usefixtures("real_inspection")
def test_what_is_no_recording_is_refused_by_its_name_and_not_kept(client, service):
    answer = send(client, b"\x00\x01 nothing" * 50, "holiday.jpg")
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith("holiday.jpg: is of no known format; known formats")
    assert [path for path in (service.settings.data / "store").rglob("*") if path.is_file()] == []
    assert left(service) == []


def test_a_recording_that_takes_too_long_is_stopped(tmp_path):
    fifo = tmp_path / "endless.bag"
    os.mkfifo(fifo)
    limits = replace(LIMITS, inspection_seconds=2.0)
    with pytest.raises(RecordingError, match=r"endless\.bag: takes more than 2 s to read; split"):
        inspecting.inspect(fifo, limits)


def test_a_recording_that_needs_too_much_memory_is_stopped(tmp_path, monkeypatch):
    hungry = "import sys; from tuner.service.limiting import limit_process as l; "
    hungry += f"l(memory_bytes={300 * MIB}, file_bytes=1)\ntry: b'x' * {2**31}\n"
    hungry += "except MemoryError: sys.exit(3)"
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\nexec {sys.executable} -c "$HUNGRY"\n')
    script.chmod(0o755)
    monkeypatch.setenv("HUNGRY", hungry)
    monkeypatch.setattr(sys, "executable", str(script))
    with pytest.raises(RecordingError, match="needs more than 2 GiB of memory to read"):
        inspecting.inspect(tmp_path / "x.bag", LIMITS)


def test_a_file_beyond_the_limit_is_refused_before_it_is_all_there(settings, table):
    service = Service.open(replace(settings, limits=replace(LIMITS, upload_bytes=MIB)))
    with listening(service) as client:
        answer = send(client, bytes(3 * MIB))
        assert answer.status_code == 413
        assert "is larger than the 1 MiB that this server takes" in answer.text
        assert left(service) == []
        upload(client, table.read_bytes())
    service.close()


def test_another_request_beyond_the_limit_is_refused(client):
    body = b'{"recordings": ["' + b"0" * (2 * MIB) + b'"]}'
    answer = client.post("/api/v1/jobs", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 413
    assert answer.json()["detail"].startswith("the request: is larger than 1 MiB")


@pytest.mark.parametrize(
    ("body", "kind", "said"),
    [
        (b"", "text/plain", "is no form"),
        (b"", "multipart/form-data", "is no form"),
        (b"", "multipart/form-data; boundary=x", "holds no file"),
        (b"junk", "multipart/form-data; boundary=x", "is no form that can be read"),
        (
            b'--x\r\ncontent-disposition: form-data; name="other"; filename="a"\r\n\r\nab\r\n--x--',
            "multipart/form-data; boundary=x",
            "holds no file",
        ),
        (
            b'--x\r\ncontent-disposition: form-data; name="file"; filename="a"\r\n\r\nab',
            "multipart/form-data; boundary=x",
            "was cut off before its end; upload the recording again",
        ),
        (
            b'--x\r\ncontent-disposition: form-data; name="file"; filename="a"\r\n\r\n\r\n--x--',
            "multipart/form-data; boundary=x",
            "a: is empty; check the recording",
        ),
    ],
)
def test_a_body_that_is_no_upload_is_refused_in_words(client, service, body, kind, said):
    answer = client.post("/api/v1/recordings", content=body, headers={"content-type": kind})
    assert answer.status_code == 422
    assert said in answer.json()["detail"]
    assert left(service) == []


def test_an_upload_whose_sender_goes_away_leaves_nothing(client, service, table):
    url = urlsplit(str(client.base_url))
    head = (
        "POST /api/v1/recordings HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-length: 9000000\r\n"
        "content-type: multipart/form-data; boundary=x\r\n\r\n"
        '--x\r\ncontent-disposition: form-data; name="file"; filename="a.bag"\r\n\r\n'
    )
    for _ in range(3):
        with socket.create_connection((url.hostname, url.port)) as connection:
            connection.sendall(head.encode() + bytes(4_000_000))
    waited = threading.Event()
    for _ in range(100):
        if not left(service):
            break
        waited.wait(0.05)
    assert left(service) == []
    upload(client, table.read_bytes())


def test_a_full_disk_refuses_the_upload_and_keeps_the_rest(client, service, table, monkeypatch):
    upload(client, table.read_bytes())

    def refuse(*_: object) -> None:
        with incoming.full_disk():
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(incoming._Receiver, "flush", refuse)
    answer = send(client, b"time,x\n0,0\n" * 1000)
    assert answer.status_code == 507
    assert answer.json()["detail"] == "the server: has no space left; free some space and try again"
    monkeypatch.undo()
    assert left(service) == []
    assert len(recordings.latest(service.database, 10)) == 1


def test_a_disk_that_is_nearly_full_takes_nothing_more(settings, table):
    service = Service.open(replace(settings, limits=replace(LIMITS, free_bytes=2**60)))
    with listening(service) as client:
        assert send(client, table.read_bytes()).status_code == 507
        health = client.get("/healthz")
        assert health.status_code == 503
        assert health.json()["status"] == "failing"
        assert health.json()["uploads"] == "has no space left"
    service.close()


def test_the_number_of_recordings_and_of_uploads_at_once_is_limited(settings, table):
    limits = replace(LIMITS, recordings=1, recordings_of_job=1)
    service = Service.open(replace(settings, limits=limits, workers=0))
    with listening(service) as client:
        first = upload(client, table.read_bytes())
        assert send(client, b"time,x\n1,2\n").status_code == 429
        assert client.get("/healthz").json()["uploads"] == "keeps 1 recordings"
        body = {"recordings": [first, "0" * 64]}
        assert client.post("/api/v1/jobs", json=body).status_code == 429
    service.close()


def test_what_a_killed_server_was_receiving_is_gone_when_it_starts_again(settings):
    settings.incoming.mkdir(parents=True)
    (settings.incoming / "half").write_bytes(bytes(1000))
    service = Service.open(settings)
    assert left(service) == []
    service.close()
