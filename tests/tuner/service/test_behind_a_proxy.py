"""A server on the loopback address with a proxy in front, which lets in who shows a token."""

from contextlib import contextmanager
from dataclasses import replace

import httpx
import pytest

from tests.tuner.service.conftest import listening
from tests.tuner.service.proxy import proxied
from tuner.cli import main
from tuner.service import app, tokens
from tuner.service.app import LOOPBACK
from tuner.service.safety import COOKIE
from tuner.service.service import Service

PUBLIC = "tune.lab.example"
OURS = {"origin": f"https://{PUBLIC}", "sec-fetch-site": "same-origin"}


@contextmanager
def visited(settings, *, host=None, tells=True):
    """Yield a visitor of a proxy's public name, and the service behind it."""
    service = Service.open(replace(settings, workers=0))
    with (
        listening(service) as direct,
        proxied(direct.base_url.port, host=host, tells=tells) as url,
        httpx.Client(base_url=url, headers={"host": PUBLIC}, timeout=30) as visitor,
    ):
        yield visitor, service
    service.close()


@pytest.fixture
def safe(settings):
    """Settings as of ``tune serve --tokens always --allow-host tune.lab.example``."""
    return replace(settings, demands_tokens=True, hosts=(*LOOPBACK, PUBLIC))


@pytest.mark.parametrize(
    ("host", "tells", "why"),
    [
        (None, False, "names another host"),
        (None, True, "names another host"),
        ("127.0.0.1", True, "asks nobody for a token; start it with --tokens always"),
    ],
)
def test_a_proxy_opens_no_server_without_tokens(settings, host, tells, why):
    with visited(replace(settings, hosts=LOOPBACK), host=host, tells=tells) as (visitor, _):
        for path in ("/", "/api/v1/jobs", "/healthz"):
            answer = visitor.get(path)
            assert answer.status_code == 403
            assert why in answer.json()["detail"]


@pytest.mark.parametrize("host", [None, "127.0.0.1"])
def test_behind_a_proxy_a_token_is_asked_for(safe, host):
    with visited(safe, host=host) as (visitor, service):
        token = tokens.add(service.database, "anna")
        assert visitor.get("/api/v1/jobs").status_code == 401
        shown = {"authorization": f"Bearer {token}"}
        assert visitor.get("/api/v1/jobs", headers=shown).status_code == 200
        assert visitor.get("/healthz").status_code == 200


def test_a_browser_logs_in_and_out_through_a_proxy(safe, table):
    with visited(safe) as (visitor, service):
        token = tokens.add(service.database, "anna")
        door = visitor.get("/", headers={"accept": "text/html"})
        assert (door.status_code, door.headers["location"]) == (303, "/login")
        answer = visitor.post("/login", data={"token": token}, headers=OURS)
        assert answer.status_code == 303
        cookie = answer.headers["set-cookie"].lower()
        assert all(word in cookie for word in ("httponly", "samesite=strict", "secure"))
        assert token.lower() not in cookie
        session = {"cookie": f"{COOKIE}={visitor.cookies[COOKIE]}"}
        visitor.cookies.clear()
        page = visitor.get("/", headers=session)
        assert "anna" in page.text
        assert "Log out" in page.text
        sent = visitor.post(
            "/recordings", files={"file": ("hop.csv", table.read_bytes())}, headers=OURS | session
        )
        assert sent.status_code == 303
        assert visitor.post("/logout", headers=OURS | session).headers["location"] == "/login"
        assert visitor.get("/api/v1/jobs", headers=session).status_code == 401


def test_a_session_does_nothing_for_a_page_of_another_site(safe):
    with visited(safe) as (visitor, service):
        word = tokens.log_in(service.database, tokens.add(service.database, "anna"))
        session = {"cookie": f"{COOKIE}={word}"}
        for headers in (
            {"origin": "https://evil.example"},
            {"origin": f"https://{PUBLIC}.evil.example"},
            {"origin": "null"},
            {"sec-fetch-site": "cross-site"},
            {},  # a browser that does not say which page sent the form
        ):
            for path in ("/jobs", "/recordings", "/logout", "/api/v1/jobs"):
                assert visitor.post(path, headers=session | headers).status_code in (401, 403)
        assert visitor.get("/jobs", headers=session).status_code == 200
        assert visitor.post("/login", headers={"origin": "https://evil.example"}).status_code == 403


def test_a_session_ends_with_its_token_and_with_time(idle, monkeypatch):
    database = idle.database
    assert tokens.log_in(database, "tune_guess") is None
    token = tokens.add(database, "anna")
    word = tokens.log_in(database, token)
    assert word is not None
    assert tokens.logged_in(database, word) == "anna"
    assert tokens.logged_in(database, token) is None
    monkeypatch.setattr(tokens.time, "time", lambda: 1e11)
    assert tokens.logged_in(database, word) is None
    monkeypatch.undo()
    tokens.remove(database, "anna")
    assert tokens.logged_in(database, word) is None
    tokens.add(database, "anna")
    assert tokens.logged_in(database, word) is None


@pytest.mark.parametrize("host", ["[", "[::1", "a b", "x" * 3000, "127.0.0.1:99999"])
def test_a_host_that_is_none_is_refused(settings, host):
    with visited(replace(settings, hosts=("localhost",)), host=host) as (visitor, _):
        assert visitor.get("/").status_code in (400, 403)


def test_the_command_says_who_is_let_in(monkeypatch, tmp_path, capsys):
    asked = []
    monkeypatch.setattr(app, "serve", lambda settings, **_: asked.append(settings))
    at = ["serve", "--data", str(tmp_path)]
    assert main(at) == 0
    assert main([*at, "--tokens", "always", "--allow-host", "Tune.lab.example"]) == 0
    assert main([*at, "--host", "0.0.0.0"]) == 0
    assert [settings.demands_tokens for settings in asked] == [False, True, True]
    assert [settings.hosts for settings in asked] == [LOOPBACK, (*LOOPBACK, PUBLIC), ()]
    assert main([*at, "--allow-host", "https://tune.lab.example"]) == 2
    assert "is no host name; write tune.lab.example" in capsys.readouterr().err
