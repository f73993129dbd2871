"""Who may ask, from where, how much; and that names and recordings of users are only data."""

import io
import logging
import re
import socket
from dataclasses import replace
from importlib.resources import files

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import event

from tests.tuner.service.conftest import LIMITS, ended, listening, submit, upload
from tuner.core.errors import InputError
from tuner.report.page import LIBRARIES
from tuner.service import app, jobs, tokens
from tuner.service.app import is_loopback, serve
from tuner.service.request import recording_name
from tuner.service.safety import COOKIE, RateLimit
from tuner.service.service import Service
from tuner.service.web import pages

HOSTILE = '<img src=x onerror="alert(1)">'


@pytest.fixture
def guarded(settings):
    """A server that demands tokens, and a token."""
    service = Service.open(replace(settings, demands_tokens=True, workers=0))
    token = tokens.add(service.database, "alice")
    with listening(service) as client:
        yield client, token, service
    service.close()


@given(st.text(max_size=300))
def test_a_user_s_name_is_never_a_path(name):
    made = recording_name(name)
    assert re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}", made), made
    assert not made.lower().endswith((".yaml", ".yml"))
    assert recording_name(made) == made


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("circle_4mps.bag", "circle_4mps.bag"),
        ("../../etc/passwd", "passwd"),
        ("..\\..\\x.bag", "x.bag"),
        ("tune.yaml", "tune.yaml_"),
        ("….bag", "_-b4935894.bag"),
        ("", "unnamed-e3b0c442"),
        ("..", "unnamed-5ec1f7e7"),
    ],
)
def test_plain_names_are_kept_and_others_made_plain(name, kept):
    assert recording_name(name) == kept


@pytest.mark.parametrize(
    "name",
    ["../../../evil.csv", "/etc/cron.d/x", "a\x00b.csv", HOSTILE, "x" * 3000, "\u202egab.csv"],
)
def test_hostile_names_stay_inside_and_are_escaped(client, settings, table, name):
    outside = sorted(settings.data.parent.iterdir())
    recording = upload(client, table.read_bytes(), name)
    job = ended(client, submit(client, recording, name="plain"))
    assert job["state"] == "done"
    assert sorted(settings.data.parent.iterdir()) == outside
    for page in ("/", f"/jobs/{job['id']}", f"/?r={recording}", "/jobs"):
        text = client.get(page, headers={"accept": "text/html"}).text
        assert "<img" not in text
        assert "\x00" not in text


def test_text_of_a_job_is_escaped_on_every_page(client, table, updated):
    own = updated.model_dump(mode="json", exclude_none=True) | {"name": HOSTILE}
    job = ended(
        client, submit(client, upload(client, table.read_bytes()), name=HOSTILE, vehicle=own)
    )
    for page in ("/", "/jobs", f"/jobs/{job['id']}", f"/jobs/{job['id']}/live", "/vehicles"):
        answer = client.get(page)
        assert answer.status_code == 200
        assert "<img" not in answer.text
    assert "onerror=&#34;alert(1)&#34;" in client.get("/jobs").text


def test_an_address_tells_the_terminal_of_the_log_nothing(client, monkeypatch, caplog):
    monkeypatch.setattr(jobs, "cancel", lambda *_: 1 / 0)
    assert client.post("/api/v1/jobs/a%1B[2J%E2%80%A8/cancel").status_code == 500
    (record,) = [record for record in caplog.records if record.name == app.__name__]
    assert record.getMessage().isprintable()


def test_a_name_of_no_vehicle_is_not_looked_for(client, service):
    asked = []
    event.listen(
        service.database._reader,
        "before_cursor_execute",
        lambda *given: asked.append(given[3]),
    )
    assert client.get("/jobs", params={"vehicle": "a\0b"}).status_code == 200
    assert asked
    assert not any("\0" in repr(parameters) or "\\x00" in repr(parameters) for parameters in asked)


def test_pages_load_nothing_from_elsewhere(client):
    answer = client.get("/")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    libraries = "".join((files("tuner.report") / "assets" / name).read_text() for name in LIBRARIES)
    for name in pages._STATIC:
        ours = [
            line
            for line in client.get(f"/static/{name}").text.splitlines()
            if line not in libraries
        ]
        assert len(ours) > 20
        assert not re.search(r"https?://", "\n".join(ours))
    assert not re.search(r"https?://", answer.text)
    assert client.get("/static/..%2Fpages.py").status_code == 404


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
def test_another_site_s_page_can_start_nothing(client, headers):
    for path in ("/jobs", "/api/v1/jobs", "/recordings"):
        assert client.post(path, headers=headers).status_code == 403


def test_another_name_for_this_machine_reaches_nothing(settings):
    service = Service.open(replace(settings, workers=0, hosts=("127.0.0.1", "localhost")))
    with listening(service) as client:
        assert client.get("/api/v1/jobs").status_code == 200
        answer = client.get("/api/v1/jobs", headers={"host": "evil.example"})
        assert answer.status_code == 403
        assert "another host" in answer.json()["detail"]
    service.close()


def test_without_a_token_there_is_only_the_door(guarded):
    client, token, _ = guarded
    assert client.get("/api/v1/jobs").status_code == 401
    assert client.get("/api/v1/jobs", headers={"authorization": "Bearer tune_x"}).status_code == 401
    assert client.get("/metrics").status_code == 401
    assert client.get("/api/v1/openapi.json").status_code == 401
    assert client.post("/jobs").status_code == 401
    assert client.get("/healthz").status_code == 200
    door = client.get("/", headers={"accept": "text/html"})
    assert (door.status_code, door.headers["location"]) == (303, "/login")
    allowed = client.get("/api/v1/jobs", headers={"authorization": f"Bearer {token}"})
    assert allowed.status_code == 200


def test_logging_in_keeps_no_token_in_the_browser(guarded):
    client, token, _ = guarded
    wrong = client.post("/login", data={"token": "tune_guess"})
    assert wrong.status_code == 401
    assert "is not known to this server" in wrong.text
    answer = client.post("/login", data={"token": token})
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert token.lower() not in cookie
    assert client.get("/").status_code == 200
    client.cookies.clear()
    assert client.get("/", headers={"cookie": f"{COOKIE}={token}"}).status_code == 401


def test_only_hashes_of_tokens_are_kept_and_none_is_logged(guarded, caplog):
    client, token, service = guarded
    caplog.set_level(logging.DEBUG)
    for ours in ("httpx", "httpcore"):  # the visitor's own
        caplog.set_level(logging.WARNING, ours)
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    logging.getLogger().addHandler(handler)
    try:
        client.get("/api/v1/jobs", headers={"authorization": f"Bearer {token}"})
        client.post("/login", data={"token": token})
        client.get("/jobs")
    finally:
        logging.getLogger().removeHandler(handler)
    assert token not in stream.getvalue() + caplog.text
    stored = b"".join(p.read_bytes() for p in service.settings.data.glob("tune.sqlite*"))
    assert token.encode() not in stored
    tokens.remove(service.database, "alice")
    again = client.get("/api/v1/jobs", headers={"authorization": f"Bearer {token}"})
    assert again.status_code == 401


def test_a_token_has_one_owner(idle):
    tokens.add(idle.database, "alice")
    with pytest.raises(InputError, match="'alice' has one already; tune serve token remove alice"):
        tokens.add(idle.database, "alice")
    with pytest.raises(InputError, match="'bob' has none"):
        tokens.remove(idle.database, "bob")


@pytest.mark.parametrize(
    ("host", "inside"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("192.168.1.4", False),
        ("lab", False),
    ],
)
def test_only_loopback_addresses_go_without_tokens(host, inside):
    assert is_loopback(host) is inside


def test_the_server_bounds_headers_whatever_else_is_installed(settings, monkeypatch):
    served = []

    def run(server: app._Server) -> None:
        served.append(server.config.http)
        server._service.close()

    monkeypatch.setattr(app._Server, "run", run)
    serve(replace(settings, workers=0), host="127.0.0.1", port=0, say=lambda _: None)
    assert served == [app.HttpConnection]  # not httptools, which takes headers of any length


def test_a_request_whose_head_does_not_come_is_cut_off(client, monkeypatch):
    monkeypatch.setattr(app, "HEAD_S", 0.2)
    head = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    for before in (b"", head + b"\r\n"):
        with socket.create_connection((client.base_url.host, client.base_url.port), 5) as half:
            half.sendall(before)
            if before:
                half.recv(2**16)
            half.sendall(head)
            while half.recv(2**16):  # until it is closed
                pass


def test_an_address_for_others_demands_a_token_before_it_is_served(settings):
    with pytest.raises(
        InputError, match="demands tokens, and nobody has one; make one with: tune serve token add"
    ):
        serve(replace(settings, demands_tokens=True), host="0.0.0.0", port=0, say=print)


@pytest.mark.parametrize(
    ("store", "said"),
    [
        ("", "Jobs and recordings are kept in {data}."),
        ("{data}/else", "Jobs are kept in {data}, recordings in {data}/else."),
    ],
)
def test_a_server_says_where_it_keeps_what(settings, store, said, monkeypatch):
    monkeypatch.setattr(app._Server, "run", lambda server: server._service.close())
    lines: list[str] = []
    wanted = replace(settings, workers=0, store=store.format(data=settings.data))
    serve(wanted, host="127.0.0.1", port=0, say=lines.append)
    assert lines == [said.format(data=settings.data)]


def test_a_visitor_asks_so_often_and_no_more():
    rate = RateLimit(per_second=1.0, burst=3)
    assert [rate.allows("a", 0.0) for _ in range(4)] == [True, True, True, False]
    assert rate.allows("b", 0.0)
    assert rate.allows("a", 1.0)
    assert not rate.allows("a", 1.5)


def test_too_many_requests_are_told_to_wait(settings):
    few = replace(LIMITS, requests_in_a_burst=3, requests_per_second=0.001)
    service = Service.open(replace(settings, workers=0, limits=few))
    with listening(service) as client:
        statuses = [client.get("/healthz").status_code for _ in range(5)]
        assert statuses == [200, 200, 200, 429, 429]
        assert "retry-after" in client.get("/api/v1/jobs").headers
    service.close()
