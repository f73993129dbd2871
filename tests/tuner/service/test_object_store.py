"""Recordings, results and checkpoints in an object store: S3 as moto's server speaks it.

moto and s3fs ask for other versions of python-dateutil than kubernetes does, which comes with the
extra 'cluster': where these are to run, ``pip install s3fs 'moto[server]'`` beside the rest.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace

import pytest

from tests.tuner.service.conftest import ended, listening, submit, upload
from tuner.core.content_store import ContentStore
from tuner.service.service import Service

pytest.importorskip("s3fs", reason="needs s3fs")
moto = pytest.importorskip("moto.server", reason="needs moto[server]")


@pytest.fixture
def bucket(monkeypatch):
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    yield "s3://lab/tune"
    server.stop()


@pytest.mark.slow
def test_a_server_keeps_everything_in_a_bucket(bucket, settings, table):
    service = Service.open(replace(settings, store=bucket))
    with listening(service) as client:
        recording = upload(client, table.read_bytes())
        assert recording == hashlib.sha256(table.read_bytes()).hexdigest()
        assert upload(client, table.read_bytes(), name="again.csv") == recording
        job = ended(client, submit(client, recording, namespace="die once"))
        assert job["state"] == "done"
        found = client.get(job["links"]["files"]["result.json"])
        assert found.json()["coefficients"]["motor_constant"]["best"] == sum(range(5)) * 1e-8
    service.close()
    store = ContentStore(bucket)
    assert not store.is_folder
    with store.reading(recording) as file:
        assert file.read() == table.read_bytes()
    assert not (settings.data / "store").exists()
