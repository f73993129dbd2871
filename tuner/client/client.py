"""A tuning service from Python: ``tuner.connect(url).fit([...])`` is `tuner.fit` elsewhere."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tuner.client.connection import Connection
from tuner.client.job_request import request_of
from tuner.core.disk import inside, make_folder, whole_file
from tuner.core.errors import InputError, ServerFaultError
from tuner.job.folder import folder_for
from tuner.options import FitOptions, taking
from tuner.recordings.cache import digest
from tuner.result import Run, read_run

Named = str | Path
Event = tuple[str, dict[str, Any]]


class Client:
    """A tuning service.

    Parameters
    ----------
    connection
        To its server.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    @property
    def url(self) -> str:
        """The server's address."""
        return self._connection.url

    @taking(FitOptions)
    def fit(
        self, flights: Sequence[Named], *, name: str = "", out: Named | None = None, **options: Any
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
        given = FitOptions.of(flights, **options)
        folder = folder_for(None if out is None else Path(out))
        job = self.submit(given, name=name)
        self.wait(job)
        return self.fetch(job, folder)

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
        recordings, request = request_of(options)
        request["name"] = name
        request["recordings"] = [self.upload(path, on_upload) for path in recordings]
        names = (path.name for path in recordings)
        request["names"] = dict(zip(request["recordings"], names, strict=True))
        headers = {"Idempotency-Key": key or uuid.uuid4().hex}
        return str(self._connection.post("/jobs", request, headers)["id"])

    def upload(self, path: Path, on_upload: Callable[[Path], None] = lambda _: None) -> str:
        """Send a recording unless the server has it, and return its id."""
        if path.is_dir():
            raise InputError(
                path, "is a folder, and a server takes single files", "give the .db3 or .mcap in it"
            )
        sha256 = digest(path)
        known = self._connection.find(f"/recordings/{sha256}")
        if known is not None:
            return sha256
        on_upload(path)
        return str(self._connection.upload(path)["id"])

    def jobs(
        self, *, vehicle: str | None = None, state: str | None = None, after: str | None = None
    ) -> dict[str, Any]:
        """Return a page of jobs, the newest first, and where the next begins."""
        page: dict[str, Any] = self._connection.get(
            "/jobs", vehicle=vehicle, state=state, after=after
        )
        return page

    def job(self, job: str) -> dict[str, Any]:
        """Return a job as it stands."""
        found: dict[str, Any] = self._connection.get(_at(job))
        return found

    def follow(self, job: str) -> Iterator[Event]:
        """Yield what happens to a job, from its beginning to its end: kind and content."""
        return self._connection.events(job)

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
        return ended_well(self.job(job))

    def cancel(self, job: str) -> dict[str, Any]:
        """Let a job end without a result."""
        ended: dict[str, Any] = self._connection.post(f"{_at(job)}/cancel")
        return ended

    def retry(self, job: str) -> dict[str, Any]:
        """Let a job that failed or was cancelled go on."""
        waiting: dict[str, Any] = self._connection.post(f"{_at(job)}/retry")
        return waiting

    def fetch(self, job: str, out: Named | None = None) -> Run:
        """Write a job's result into a folder, and read it.

        Raises
        ------
        InputError
            The job is not done, or the folder cannot be written to.
        """
        found = ended_well(self.job(job))
        if found["state"] != "done":
            raise InputError(f"job {job}", f"is {found['state']}", f"tune watch {job}")
        folder = folder_for(None if out is None else Path(out))
        for name in found["files"]:
            target = inside(folder, name)
            make_folder(target.parent)
            with whole_file(target) as unfinished:
                self._connection.download(f"{_at(job)}/files/{quote(name)}", unfinished)
        return read_run(folder)

    def history(self, vehicle: str) -> dict[str, Any]:
        """Return each coefficient over a vehicle's jobs."""
        found: dict[str, Any] = self._connection.get(f"/vehicles/{quote(vehicle, safe='')}/history")
        return found

    def close(self) -> None:
        """Let go of the connection."""
        self._connection.close()


def ended_well(job: dict[str, Any]) -> dict[str, Any]:
    """Return a job unless it failed or was cancelled.

    Raises
    ------
    InputError
        Its input cannot be used, or it was cancelled.
    ServerFaultError
        The server could not finish it.
    """
    if job["state"] == "cancelled":
        raise InputError(f"job {job['id']}", "was cancelled", "submit it again, or retry it")
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


def _at(job: str) -> str:
    return f"/jobs/{quote(job, safe='')}"
