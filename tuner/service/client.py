"""A tuning service as its users reach it: ``tuner.connect(url).fit([...])`` is `tuner.fit` there.

A folder that fills with recordings can be watched: those that have settled become a job.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from pydantic import Field

from tuner.config import Settings, resolve_settings
from tuner.core.disk import exists, inside, result_folder, whole_file
from tuner.core.errors import InputError, ServerFaultError
from tuner.core.files import ResultFile
from tuner.core.runtime import extra
from tuner.core.shipped import KINDS, configs_folder, find_config
from tuner.core.yaml_section import Section, read_yaml
from tuner.options import FILES, MODELS, FitOptions, taking
from tuner.recordings.cache import digest
from tuner.recordings.formats import READERS
from tuner.recordings.topics import TopicMap, load_topic_map
from tuner.result import Run, RunResult, forget, place_for, read_run
from tuner.vehicle import read_vehicle
from tuner.vehicle.controller import read_controller

Named = str | Path
Event = tuple[str, dict[str, Any]]
API = "/api/v1"
UNNAMED = "the server"
DEFAULT_SERVER = "http://127.0.0.1:8000"
EVENT_STREAM = "text/event-stream"
MAX_SILENCE_S = 60.0
"""A followed job's server may be silent for so long."""


class Client:
    """A tuning service; a refusal of its server becomes an `InputError`.

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
        with extra("service", "a tuning service"):
            import httpx  # noqa: PLC0415 (an extra)
        self._named_by, url = _first(("--server", url), "TUNE_SERVER", UNNAMED, DEFAULT_SERVER)
        self.url = url.rstrip("/")
        self._token_by, token = _first(("--token", token), "TUNE_TOKEN", "", "")
        if not (token.isascii() and token.isprintable()):
            raise self._no_token()
        try:
            address = httpx.URL(self.url)
            if address.scheme not in ("http", "https") or not address.host.encode("idna"):
                raise ValueError(url)
        except (ValueError, httpx.InvalidURL):
            what = f"{url!r} is no address"
            raise InputError(self._named_by, what, f"write {DEFAULT_SERVER}") from None
        self._errors = httpx.RequestError
        self._http = httpx.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {token}"} if token else {},
            timeout=httpx.Timeout(30.0, read=300.0, write=300.0),
            verify=address.scheme == "https",  # without, no certificates are read
        )

    @taking(FitOptions)
    def fit(
        self,
        flights: Named | Sequence[Named],
        *,
        name: str = "",
        out: Named | None = None,
        **options: Any,
    ) -> Run:
        """Fit the coefficients of a vehicle to recordings, on the server; see `tuner.fit`.

        Parameters
        ----------
        flights
            As of `tuner.fit`; paths are of this machine.
        name
            What the server's lists call the job.
        out
            Folder that the result is fetched into; None makes one under ``runs/``.
        options
            As of `tuner.fit`: all fields of `tuner.options.FitOptions`.

        Returns
        -------
        Run
            As of `tuner.fit`.

        Raises
        ------
        InputError
            The input cannot be used, or the server cannot be reached.
        ServerFaultError
            The server could not finish the job.
        """
        given = FitOptions.of(flights=flights, **options)
        place_for(None if out is None else Path(out))
        job = self.submit(given, name=name)
        self.wait(job)
        return self.fetch(job, out)

    def submit(
        self,
        options: FitOptions,
        *,
        name: str = "",
        key: str | None = None,
        on_upload: Callable[[Path], None] = lambda _: None,
    ) -> str:
        """Send recordings that the server does not have, submit a job, and return its id.

        Parameters
        ----------
        options
            As of the command line.
        name
            What lists call the job.
        key
            Of this submission: with the same key there is one job; None makes one up.
        on_upload
            Called with each recording before it is sent.

        Raises
        ------
        InputError
            The input cannot be used, or the server cannot be reached.
        """
        recordings, request = job_request_of(options)
        request["name"] = name
        request["recordings"] = [self.upload(path, on_upload) for path in recordings]
        names = (path.name for path in recordings)
        request["names"] = dict(zip(request["recordings"], names, strict=True))
        headers = {"Idempotency-Key": key or uuid.uuid4().hex}
        return str(self._json("POST", "/jobs", json=request, headers=headers)["id"])

    def upload(self, path: Path, on_upload: Callable[[Path], None] = lambda _: None) -> str:
        """Send a recording unless the server has it, and return its id.

        Raises
        ------
        InputError
            It is a folder or cannot be read, or the server does not take it.
        """
        if path.is_dir():
            raise InputError(
                path, "is a folder, and a server takes single files", "give the .db3 or .mcap in it"
            )
        sha256 = digest(path)
        if self._json("GET", f"/recordings/{sha256}", may_lack=True):
            return sha256
        on_upload(path)
        with path.open("rb") as stream:
            answer = self._json("POST", "/recordings", files={"file": (path.name, stream)})
        return str(answer["id"])

    def jobs(
        self, *, vehicle: str | None = None, state: str | None = None, after: str | None = None
    ) -> dict[str, Any]:
        """Return a page of jobs, the newest first, and where the next begins."""
        given = {"vehicle": vehicle, "state": state, "after": after}
        return self._json("GET", "/jobs", params={k: v for k, v in given.items() if v is not None})

    def job(self, job: str) -> dict[str, Any]:
        """Return a job as it stands."""
        return self._json("GET", _job_path(job))

    def follow(self, job: str) -> Iterator[Event]:
        """Yield kind and content of what happens to a job, to its end, over a server's restarts."""
        last, since = "0", time.monotonic()
        while True:
            try:
                headers = {"Last-Event-ID": last}
                path = f"{API}{_job_path(job)}/events"
                with self._http.stream("GET", path, headers=headers) as answer:
                    if answer.is_error:
                        answer.read()
                        if answer.status_code < 500:
                            self._check(answer)
                        raise self._errors("the server is ending")
                    if not answer.headers.get("content-type", "").startswith(EVENT_STREAM):
                        raise self._not_a_service()
                    for number, kind, data in _events(answer.iter_lines()):
                        content = self._content_of_answer(data)
                        last, since = number or last, time.monotonic()
                        yield kind, content
                        if kind == "job" and content["ended"] is not None:
                            return
            except self._errors as error:
                if time.monotonic() - since > MAX_SILENCE_S:
                    raise self._unreachable(error) from None
            time.sleep(1.0)

    def wait(self, job: str) -> dict[str, Any]:
        """Wait for the end of a job, and return it.

        Raises
        ------
        InputError
            Its input cannot be used, or it was cancelled.
        ServerFaultError
            The server could not finish it.
        """
        for _ in self.follow(job):
            pass
        return is_success(self.job(job))

    def cancel(self, job: str) -> dict[str, Any]:
        """Let a job end without a result."""
        return self._json("POST", f"{_job_path(job)}/cancel")

    def retry(self, job: str) -> dict[str, Any]:
        """Let a job that failed or was cancelled go on."""
        return self._json("POST", f"{_job_path(job)}/retry")

    def fetch(self, job: str, out: Named | None = None) -> Run:
        """Write a job's result into a folder, and read it.

        Raises
        ------
        InputError
            The job is not done, or the folder cannot be written to.
        """
        found = is_success(self.job(job))
        if found["state"] != "done":
            raise InputError(f"job {job}", f"is {found['state']}", f"tune watch {job}")
        place = None if out is None else Path(out)
        place_for(place)
        with result_folder(place) as folder, TemporaryDirectory(prefix=".", dir=folder) as part:
            names = sorted(found["files"], key=lambda name: name != RunResult.FILE)
            targets = {inside(Path(part), name): inside(folder, name) for name in names}
            for name, fetched in zip(names, targets, strict=True):
                with whole_file(fetched) as unfinished:
                    self._download(f"{_job_path(job)}/files/{quote(name)}", unfinished)
            forget(folder)  # once all is here
            for fetched, target in targets.items():
                with whole_file(target) as unfinished:
                    fetched.replace(unfinished)
            return read_run(folder)

    def history(self, vehicle: str) -> dict[str, Any]:
        """Return each coefficient over a vehicle's jobs."""
        return self._json("GET", f"/vehicles/{quote(vehicle, safe='')}/history")

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()

    def _download(self, path: str, target: Path) -> None:
        try:
            with self._http.stream("GET", API + path) as answer, target.open("wb") as file:
                if answer.is_error:
                    answer.read()
                    self._check(answer)
                for block in answer.iter_bytes():
                    file.write(block)
        except self._errors as error:
            raise self._unreachable(error) from None

    def _json(
        self, method: str, path: str, *, may_lack: bool = False, **more: Any
    ) -> dict[str, Any]:
        try:
            answer = self._http.request(method, API + path, **more)
        except self._errors as error:
            raise self._unreachable(error) from None
        if may_lack and answer.status_code == 404:
            return {}
        self._check(answer)
        return self._content_of_answer(answer.content)

    def _content_of_answer(self, text: str | bytes) -> dict[str, Any]:
        """Return the JSON content of a server's answer."""
        try:
            found = json.loads(
                text, object_hook=lambda said: _AnswerFields(said, self._not_a_service())
            )
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise self._not_a_service()
        return found

    def _check(self, answer: Any) -> None:
        """Raise a refusal of the server as if it were refused here."""
        if not answer.is_error:
            return
        try:
            problem = answer.json()
            where, what, remedy = (str(problem[key]) for key in ("where", "what", "remedy"))
        except (ValueError, KeyError, TypeError):
            raise self._not_a_service() from None
        if answer.status_code == 401:
            raise self._no_token()
        if answer.status_code == 500:
            raise ServerFaultError(f"{self.url}: {what}; {remedy}")
        if answer.status_code in PASSING:  # there, not here
            raise PassingError(self.url, f"{where} {what}", remedy)
        raise InputError(where, what, remedy)

    def _unreachable(self, error: Exception) -> PassingError:
        why = _OF_LIBRARIES.sub("", str(error)).strip() or "no answer"
        remedy = "check the address, and that tune serve runs there"
        if self._named_by == UNNAMED:
            remedy = "start it with tune serve, or name another with --server or TUNE_SERVER"
        return PassingError(self._named_by, f"{self.url} cannot be reached ({why})", remedy)

    def _no_token(self) -> InputError:
        if not self._token_by:
            remedy = "ask who runs it for one, and set TUNE_TOKEN"
            return InputError(self._named_by, f"{self.url} demands a token", remedy)
        remedy = "ask who runs it, and set TUNE_TOKEN"
        return InputError(self._token_by, f"is not known to {self.url}", remedy)

    def _not_a_service(self) -> InputError:
        return InputError(self._named_by, f"{self.url} is no tuning service", "check the address")


class PassingError(InputError):
    """A refusal that may pass by itself: the server is away, ending, busy or full."""


PASSING = (429, 503, 507)
"""Statuses of such refusals."""
_OF_LIBRARIES = re.compile(r"\[[^]]*\]|\(_ssl\.c:\d+\)")
"""Numbers and places in what a system's or a library's error says."""


def _first(option: tuple[str, str | None], variable: str, *usual: str) -> tuple[str, str]:
    """Return where a value comes from, and the value: an option, the environment, or as usual."""
    named, value = option
    if value:
        return named, value
    value = os.environ.get(variable)
    return (variable, value) if value else (usual[0], usual[1])


class _AnswerFields(dict[str, Any]):
    """A server's answer; a missing key means that it is no tuning service."""

    def __init__(self, content: dict[str, Any], otherwise: InputError) -> None:
        super().__init__(content)
        self._otherwise = otherwise

    def __missing__(self, key: str) -> Any:
        raise self._otherwise


def is_success(job: dict[str, Any]) -> dict[str, Any]:
    """Return a job unless it failed or was cancelled.

    Raises
    ------
    InputError
        Its input cannot be used, or it was cancelled.
    ServerFaultError
        The server could not finish it.
    """
    if job["state"] == "cancelled":
        raise InputError(
            f"job {job['id']}", "was cancelled", "submit it again, or retry it on its page"
        )
    if job["state"] != "failed":
        return job
    if job["exit_status"] == 2:
        raise JobRefusedError(str(job["error"]))
    raise ServerFaultError(f"job {job['id']}: {job['error']}")


class JobRefusedError(InputError):
    """A job whose input could not be used; the message is the one that `tune` gives for it."""

    def __init__(self, message: str) -> None:
        where, _, rest = message.partition(": ")
        what, _, remedy = rest.partition("; ")
        super().__init__(where, what, remedy)
        self.args = (message,)


def _job_path(job: str) -> str:
    server, _, name = job.partition("/jobs/")
    if name:
        raise InputError(job, "is the address of a job", f"give {name} and --server {server}")
    return f"/jobs/{quote(job, safe='')}"


def _events(lines: Iterator[str]) -> Iterator[tuple[str | None, str, str]]:
    """Yield number, kind and data of each event of a stream."""
    number, kind, data = None, "message", ""
    for line in lines:
        if not line:
            if data:
                yield number, kind, data
            number, kind, data = None, "message", ""
            continue
        field, _, value = line.partition(": ")
        if field == "id":
            number = value
        elif field == "event":
            kind = value
        elif field == "data":
            data += value


def job_request_of(options: FitOptions) -> tuple[tuple[Path, ...], dict[str, Any]]:
    """Return the recordings to send and the request that names them, but for their ids.

    Raises
    ------
    InputError
        A path, name or value cannot be used, here or by any server.
    """
    settled = resolve_settings(options)
    names = (field.name for field in fields(FitOptions) if field.name not in FILES)
    request = {name: getattr(options, name) for name in names}
    request |= {key: _content_of(key, getattr(options, key), Path()) for key in MODELS}
    request["settings"] = _settings(settled)
    if options.holdout is not None:
        request["holdout"] = list(settled.job.holdout)
    if options.topics is not None:
        request["settings"]["topics"] = _content_of("topics", options.topics, Path())
    return settled.flights, {key: value for key, value in request.items() if value is not None}


def _settings(settled: Settings) -> dict[str, Any]:
    """Return the keys of the job file, the files that it names as their contents.

    A lab's job file may speak of recordings beside it that are not sent; a server knows none of
    them.
    """
    if settled.job_path is None:
        return {}
    data = read_yaml(settled.job_path).data
    settings = dict(data) if isinstance(data, dict) else {}
    base = settled.job_path.parent
    sent = {flight.stem for flight in settled.flights}
    settings["holdout"] = list(settled.job.holdout)
    settings["flights"] = {n: v for n, v in (settings.get("flights") or {}).items() if n in sent}
    if settled.job.export.into is not None:
        raise InputError(
            settled.job_path,
            "export.into names a file of this machine",
            "leave it out, and use tune export --into on what you fetch",
        )
    named = {key: settings[key] for key in KINDS if settings.get(key) is not None}
    return settings | {key: _content_of(key, str(file), base) for key, file in named.items()}


def _content_of(key: str, named: str | Section | None, base: Path) -> str | dict[str, Any] | None:
    """Return the name of a file that every server ships, or else the file's content."""
    if isinstance(named, str):
        path = find_config(KINDS[key], named, base)
        if path.resolve().parent == (configs_folder() / KINDS[key]).resolve():
            return path.stem
        named = PARAMETER_FILES[key](path)
    return None if named is None else named.model_dump(mode="json", exclude_none=True)


def _read_topics(path: Path) -> TopicMap:
    """Read a topic map with all that it extends."""
    topics = load_topic_map(path)
    if topics.messages:
        raise InputError(
            path, "names .msg files, which no server takes", "fit with tune on this machine"
        )
    return topics.replace(extends=None)


PARAMETER_FILES: Mapping[str, Callable[[Path], Section]] = {
    "vehicle": read_vehicle,
    "controller": read_controller,
    "topics": _read_topics,
}
"""Key of a job file -> reader of a file that it names."""


SUFFIXES = {suffix for reader in READERS for suffix in reader.suffixes}
"""Of recordings in a folder that is watched."""
MAX_SETTLE_S = 86400.0
LOOK_INTERVAL_S = 2.0
"""Between two looks into the folder."""
Marks = tuple[int, int]
"""bytes, and ns of the last change"""


class SubmissionRecord(ResultFile):
    """Submitted recordings of a folder: name -> its marks and its job."""

    FILE = ".tune-submitted.json"

    recordings: dict[str, tuple[int, int, str]] = Field(default_factory=dict)


def watch(
    client: Client, folder: Path, *, settle: float, once: bool, say: Callable[[str], None]
) -> None:
    """Submit a job whenever new recordings have settled, until interrupted.

    Parameters
    ----------
    client
        Of the server.
    folder
        To look into.
    settle
        s for which no new recording has changed.
    once
        End after the first submission, or when nothing is new.
    say
        Gets a line for each submission and refusal.

    Raises
    ------
    InputError
        The folder is none or, with ``once``, the job is refused.
    """
    if not 0 <= settle <= MAX_SETTLE_S:
        raise InputError("--settle", f"is {settle:g}", f"give 0 to {MAX_SETTLE_S:g} s")
    if not (exists(folder) and folder.is_dir()):
        raise InputError(folder, "is no folder", "name the folder that recordings arrive in")
    seen: Mapping[Path, Marks] = {}
    still_since = time.monotonic()
    refused: Mapping[Path, Marks] = {}
    told = ""
    while True:
        new = _new_recordings(folder)
        if new != seen:
            seen, still_since = new, time.monotonic()
        settled = time.monotonic() - still_since >= settle
        if new and settled and new != refused:
            try:
                say(_submit(client, folder, new, say))
                refused, told = {}, ""
            except InputError as error:
                if once:
                    raise
                line = f"tune: {error}"
                if line != told:  # of a server that is away all night, once
                    say(line)
                told = line
                refused = {} if isinstance(error, PassingError) else new
        if once and (not new or settled):
            return
        time.sleep(min(LOOK_INTERVAL_S, settle) if new else LOOK_INTERVAL_S)


def _new_recordings(folder: Path) -> dict[Path, Marks]:
    """Return the recordings that were not submitted as they are now."""
    before = SubmissionRecord.read_if_any(folder) or SubmissionRecord()
    found = {}
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:
        what = f"cannot be read any more ({error.strerror})"
        raise InputError(folder, what, "check the folder and the disk") from None
    for path in paths:
        if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or not path.is_file():
            continue
        try:
            about = path.stat()
        except FileNotFoundError:  # it was moved away just now
            continue
        marks = (about.st_size, about.st_mtime_ns)
        if before.recordings.get(path.name, (0, 0, ""))[:2] != marks:
            found[path] = marks
    return found


def _submit(
    client: Client, folder: Path, new: Mapping[Path, Marks], say: Callable[[str], None]
) -> str:
    """Submit one job of recordings, note it, and return a line about it.

    Those that the server cannot read are named and left out, unless there are no others.
    """
    arrived = new
    for path in arrived:
        try:
            client.upload(path)
        except InputError as error:
            if error.where not in (path.name, str(path)) or len(new) == 1:
                raise
            say(f"tune: {error}")
            new = {other: marks for other, marks in new.items() if other != path}
    key = hashlib.sha256(repr([(str(path.absolute()), *new[path]) for path in new]).encode())
    job = client.submit(FitOptions([str(path) for path in new]), key=key.hexdigest())
    before = SubmissionRecord.read_if_any(folder) or SubmissionRecord()
    done = {path.name: (*marks, job if path in new else "") for path, marks in arrived.items()}
    SubmissionRecord(recordings=before.recordings | done).write(folder)
    return f"{', '.join(path.name for path in new)}: job {job}"
