"""HTTP requests to a server; its refusals become `InputError`."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from tuner.core.errors import InputError, ServerFaultError

API = "/api/v1"
DEFAULT_SERVER = "http://127.0.0.1:8000"
PATIENCE = 60.0
"""s for which a server that answers no more is waited for while a job is followed"""


class Connection:
    """One server.

    Parameters
    ----------
    url
        Its address; None takes ``TUNE_SERVER``, or the one that `tune serve` listens to.
    token
        The visitor's; None takes ``TUNE_TOKEN``.

    Raises
    ------
    InputError
        The address is none, or what connects is not installed.
    """

    def __init__(self, url: str | None = None, token: str | None = None) -> None:
        try:
            import httpx  # noqa: PLC0415 (an extra)
        except ModuleNotFoundError:
            raise InputError(
                "--server", "needs httpx", "pip install 'multirotor-tune[service]'"
            ) from None
        url = url or os.environ.get("TUNE_SERVER") or DEFAULT_SERVER
        if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).hostname:
            raise InputError("--server", f"'{url}' is no address", f"write {DEFAULT_SERVER}")
        self.url = url.rstrip("/")
        token = token or os.environ.get("TUNE_TOKEN")
        self._errors = httpx.TransportError
        self._client = httpx.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {token}"} if token else {},
            timeout=httpx.Timeout(30.0, read=300.0, write=300.0),
        )

    def close(self) -> None:
        """Let go of the connection."""
        self._client.close()

    def get(self, path: str, **query: str | None) -> Any:
        """Return what a GET answers, as JSON."""
        given = {name: value for name, value in query.items() if value is not None}
        return self._json("GET", path, params=given)

    def find(self, path: str) -> Any:
        """Return what a GET answers, None where there is nothing."""
        return self._json("GET", path, may_lack=True)

    def post(self, path: str, body: object = None, headers: Mapping[str, str] | None = None) -> Any:
        """Return what a POST of JSON answers."""
        return self._json("POST", path, json=body, headers=dict(headers or {}))

    def upload(self, file: Path) -> Any:
        """Send a file, and return what is answered."""
        with file.open("rb") as stream:
            return self._json("POST", "/recordings", files={"file": (file.name, stream)})

    def download(self, path: str, target: Path) -> None:
        """Write what a GET answers to a file."""
        try:
            with (
                self._client.stream("GET", API + path) as answer,
                target.open("wb") as file,
            ):
                if answer.is_error:
                    answer.read()
                    self._check(answer)
                for block in answer.iter_bytes():
                    file.write(block)
        except self._errors as error:
            raise self._unreachable(error) from None

    def events(self, job: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield a job's events (kind, content) to its end, over a server's restarts too."""
        last, since = "0", time.monotonic()
        while True:
            try:
                headers = {"Last-Event-ID": last}
                path = f"{API}/jobs/{quote(job, safe='')}/events"
                with self._client.stream("GET", path, headers=headers) as answer:
                    if answer.is_error:
                        answer.read()
                        if answer.status_code < 500:
                            self._check(answer)
                        raise self._errors("the server is ending")
                    for number, kind, content in _events(answer.iter_lines()):
                        last, since = number or last, time.monotonic()
                        yield kind, content
                        if kind == "job" and content["ended"] is not None:
                            return
            except self._errors as error:
                if time.monotonic() - since > PATIENCE:
                    raise self._unreachable(error) from None
            time.sleep(1.0)

    def _json(self, method: str, path: str, *, may_lack: bool = False, **more: Any) -> Any:
        try:
            answer = self._client.request(method, API + path, **more)
        except self._errors as error:
            raise self._unreachable(error) from None
        if may_lack and answer.status_code == 404:
            return None
        self._check(answer)
        try:
            return answer.json()
        except ValueError:
            raise self._stranger() from None

    def _check(self, answer: Any) -> None:
        """Raise what a server refuses as if it were refused here."""
        if not answer.is_error:
            return
        try:
            problem = answer.json()
            where, what, remedy = (str(problem[key]) for key in ("where", "what", "remedy"))
        except (ValueError, KeyError, TypeError):
            raise self._stranger() from None
        if answer.status_code == 401:
            raise InputError(
                "--token", f"is none of {self.url}", "ask who runs it, and set TUNE_TOKEN"
            )
        if answer.status_code == 500:
            raise ServerFaultError(f"{self.url}: {what}; {remedy}")
        raise InputError(where, what, remedy)

    def _unreachable(self, error: Exception) -> InputError:
        return InputError(
            "--server",
            f"{self.url} cannot be reached ({error})",
            "check the address, or start a server with: tune serve",
        )

    def _stranger(self) -> InputError:
        return InputError("--server", f"{self.url} is no tuning service", "check the address")


def _events(lines: Iterator[str]) -> Iterator[tuple[str | None, str, dict[str, Any]]]:
    """Yield number, kind and content of each event of a stream."""
    number, kind, data = None, "message", ""
    for line in lines:
        if not line:
            if data:
                yield number, kind, json.loads(data)
            number, kind, data = None, "message", ""
            continue
        field, _, value = line.partition(": ")
        if field == "id":
            number = value
        elif field == "event":
            kind = value
        elif field == "data":
            data += value
