"""The pages and their forms; each form answers with a page, so that none needs a script."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import anyio.to_thread
from fastapi import APIRouter, Form, Query, Request
from jinja2 import Environment
from markupsafe import Markup
from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import FormData
from starlette.responses import HTMLResponse, RedirectResponse, Response

from tuner.core.errors import ConfigError, InputError
from tuner.core.shipped import shipped
from tuner.core.yaml_section import config_error, document_of
from tuner.evaluate.records import RMSE_UNITS
from tuner.recordings.notes import Damage, Note, damage_sentence, note_in_words
from tuner.report.outcome import STYLE_OF, flights_table, outcome, warnings_of
from tuner.report.page import LIBRARIES, templates
from tuner.report.section import charts_json, figures
from tuner.service import jobs, recordings, tokens
from tuner.service.database import FINISHED, JobRow, RecordingRow, State
from tuner.service.errors import NoTokenError, ServiceError, on_the_web
from tuner.service.http import JobOfPath, ServiceOfApp, service_of, upload
from tuner.service.jobs import MAX_EVENTS, history, vehicles
from tuner.service.recordings import flight_name
from tuner.service.request import JobRequest
from tuner.service.safety import COOKIE, CURRENT_VISITOR
from tuner.service.service import Service
from tuner.service.settings import size_in_words
from tuner.service.shapes import API, iso
from tuner.service.web import comparison
from tuner.service.web.comparison import history_chart, rmse_chart

#: State -> what is said of it, and the class of its badge, as the report's verdicts have.
STATES: Mapping[str, tuple[str, str]] = {
    State.QUEUED: ("waiting", "kept"),
    State.RUNNING: ("running", "weak"),
    State.DONE: ("done", "well"),
    State.FAILED: ("failed", "not"),
    State.CANCELLED: ("cancelled", "kept"),
}


@cache
def environment() -> Environment:
    """Return the pages' templates, with what they call."""
    made = templates("tuner.service.web", "tuner.report")
    filters: dict[str, Callable[..., object]] = {
        "charts": lambda charts: Markup(charts_json(charts)),
        "figures": figures,
        "short": lambda value: "–" if value is None else f"{value:.2g}",
        "percent": lambda value: "–" if value is None else f"{100 * value:+.2f} %",
        "mm": lambda value: "" if value is None else f"{1000 * value:.2f} mm",
        "megabytes": lambda size: f"{size / 1e6:.1f} MB",
        "ago": _age_in_words,
        "moment": lambda value: "" if value is None else iso(value),
        "lasting": _duration_in_words,
        "flight": flight_name,
        "web": on_the_web,
        "note": lambda raw: note_in_words(TypeAdapter(Note).validate_python(raw)),
        "damage": lambda raw: damage_sentence(TypeAdapter(Damage).validate_python(raw)),
    }
    made.filters |= filters
    made.globals |= {"states": STATES, "looks": STYLE_OF, "visitor": CURRENT_VISITOR.get}
    return made


def render(template: str, status: int = 200, /, **values: object) -> HTMLResponse:
    """Return a page."""
    text = environment().get_template(template).render(**values)
    return HTMLResponse(text, status_code=status)


def _age_in_words(seconds: float | None) -> str:
    """Return the age of a time in words."""
    if seconds is None:
        return ""
    passed = max(0.0, time.time() - seconds)
    for size, word in ((86400.0, "day"), (3600.0, "hour"), (60.0, "minute")):
        if passed >= size:
            count = int(passed / size)
            return f"{count} {word}{'' if count == 1 else 's'} ago"
    return "just now"


def _duration_in_words(seconds: float | None) -> str:
    """Return a duration in words."""
    if seconds is None:
        return ""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


web = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

STATIC_MAX_AGE_S = 60
"""A browser caches style and script for so long."""
MAX_LATEST = 30
"""The pages offer so many recordings and jobs."""
MAX_LOG_LINES = 400
FLIGHT_USES = ("fit", "holdout", "leave out")
_STATIC = {
    "style.css": ("tuner.report:templates/page.css", "tuner.service.web:static/style.css"),
    "page.js": ("tuner.service.web:static/page.js",),
    "figures.js": (
        *(f"tuner.report:assets/{name}" for name in LIBRARIES),
        "tuner.report:templates/figures.js",
    ),
}


@web.get("/static/{name}")
def static(name: str) -> Response:
    """Return the style, which is the report's and a little more, or the script."""
    if name not in _STATIC:
        return render(
            "problem.html.jinja", 404, title="Not here", sentence="There is no such file."
        )
    parts = (place.split(":") for place in _STATIC[name])
    text = "\n".join((files(package) / path).read_text("utf-8") for package, path in parts)
    kind = "text/css" if name.endswith(".css") else "text/javascript"
    return Response(text, media_type=kind, headers={"cache-control": f"max-age={STATIC_MAX_AGE_S}"})


@web.get("/")
def start(
    service: ServiceOfApp, r: Annotated[list[str] | None, Query(max_length=1000)] = None
) -> Response:
    """Show where recordings are dropped and a job begins."""
    chosen = [recordings.recording(service.database, digest) for digest in dict.fromkeys(r or ())]
    return _start(service, [(row, "") for row in chosen])


def _start(
    service: Service,
    chosen: Sequence[tuple[RecordingRow, str]],
    *,
    given: Mapping[str, str] | None = None,
    problem: str = "",
    status: int = 200,
) -> Response:
    """Return the start page, with the values of its form."""
    ids = {row.sha256 for row, _ in chosen}
    given = given or {}
    blank = dict.fromkeys(("name", "vehicle", "mass", "settings", "holdout"), "")
    names = sorted({*shipped("vehicles"), *vehicles(service.database)})
    latest = [
        row for row in recordings.latest(service.database, MAX_LATEST) if row.sha256 not in ids
    ]
    return render(
        "start.html.jinja",
        status,
        chosen=chosen,
        latest=latest,
        vehicles=names,
        given=blank | dict(given),
        key=secrets.token_hex(16),
        problem=problem,
        jobs=jobs.page(service.database, limit=5)[0],
        limit=size_in_words(service.settings.limits.upload_bytes),
    )


@web.post("/recordings")
async def add_recording(request: Request) -> Response:
    """Take a recording in: for the script its card, for a form the start page with it."""
    is_script = request.headers.get("x-requested-with") == "script"
    try:
        row, _ = await upload(request)
    except InputError as error:
        sentence, status = str(error), error.STATUS if isinstance(error, ServiceError) else 422
        if is_script:
            return render("refused.html.jinja", status, sentence=sentence)
        return await anyio.to_thread.run_sync(
            lambda: _start(service_of(request), [], problem=sentence, status=status)
        )
    if is_script:
        return render("card.html.jinja", row=row, use="")
    return RedirectResponse(f"/?r={row.sha256}", status_code=303)


@web.get("/recordings/{recording}/card")
def show_card(service: ServiceOfApp, recording: str) -> Response:
    """Return the card of a stored recording."""
    row = recordings.recording(service.database, recording)
    return render("card.html.jinja", row=row, use="")


@web.post("/jobs")
async def start_job(request: Request) -> Response:
    """Submit the job of the start page's form, and show it."""
    async with request.form(max_files=0, max_fields=1000, max_part_size=2**20) as form:
        service = service_of(request)
        return await anyio.to_thread.run_sync(_submit, service, form)


def _submit(service: Service, form: FormData) -> Response:
    text = {key: value for key, value in form.items() if isinstance(value, str)}
    uses = {
        key.removeprefix("use-"): use
        for key, use in text.items()
        if key.startswith("use-") and use in FLIGHT_USES
    }
    chosen = [(recordings.recording(service.database, d), use) for d, use in uses.items()]
    for recording, _ in chosen:
        recording.name = text.get(f"name-{recording.sha256}") or recording.name
    used = [(row, use) for row, use in chosen if use != "leave out"]
    try:
        settings = typed_settings(text.get("settings", ""))
        if (held := _form_values(settings)) and " ".join(held) != text.get("holdout", ""):
            chosen = [(r, "holdout" if flight_name(r.name) in held else use) for r, use in chosen]
            text["holdout"] = " ".join(held)
            what = f"hold out {', '.join(held)}"
            raise InputError("settings", what, "see what checks the fit below, and start again")
        row, _ = jobs.submit(
            service.database,
            _request(text, settings, used),
            service.settings.limits,
            submission=text.get("key") or None,
        )
    except InputError as error:
        status = error.STATUS if isinstance(error, ServiceError) else 422
        return _start(service, chosen, given=text, problem=str(error), status=status)
    service.dispatcher.call()
    return RedirectResponse(f"/jobs/{row.id}", status_code=303)


def _form_values(settings: Mapping[str, Any]) -> list[str]:
    """Return the flights that some settings hold out."""
    held = settings.get("holdout")
    return [str(name) for name in held] if isinstance(held, list) else []


def _request(
    text: Mapping[str, str], settings: dict[str, Any], used: Sequence[tuple[RecordingRow, str]]
) -> JobRequest:
    """Return the request that a form makes."""
    if not used:
        raise InputError("recordings", "are missing", "drop some, or choose one to fit")
    values: dict[str, Any] = {
        "recordings": [row.sha256 for row, _ in used],
        "names": {row.sha256: row.name for row, _ in used},
        "settings": settings,
        "name": text.get("name", "").strip(),
    }
    held = [flight_name(row.name) for row, use in used if use == "holdout"]
    if held or _form_values(settings):  # which the page has shown
        values["holdout"] = held
    if vehicle := text.get("vehicle", "").strip():
        values["vehicle"] = vehicle
    if mass := text.get("mass", "").strip():
        try:
            values["mass"] = float(mass.replace(",", "."))
        except ValueError:
            raise InputError("mass", f"'{mass}' is no number", "give kg, as 2.243") from None
    try:
        return JobRequest.model_validate(values)
    except ValidationError as error:
        raise config_error(error, Path("the form")) from None


@web.get("/jobs")
def list_jobs(
    service: ServiceOfApp,
    vehicle: Annotated[str, Query(max_length=200)] = "",
    state: str = "",
    after: str = "",
    fragment: bool = False,
) -> Response:
    """Show a page of jobs; as a fragment its table alone."""
    wanted = State(state) if state in set(State) else None
    rows, following = jobs.page(
        service.database, vehicle=vehicle or None, state=wanted, after=after or None
    )
    values = {
        "jobs": rows,
        "next": following,
        "by": {"vehicle": vehicle, "state": state, "after": after},
    }
    if fragment:
        return render("job_table.html.jinja", **values)
    counts, named = jobs.counts(service.database), vehicles(service.database)
    return render("jobs.html.jinja", counts=counts, vehicles=named, **values)


@web.get("/jobs/{job}")
def show_job(service: ServiceOfApp, row: JobOfPath) -> Response:
    """Show a job: live until it ends, then with its report."""
    done, _ = jobs.page(service.database, vehicle=row.vehicle, state=State.DONE)
    others = [other for other in done if other.id != row.id]
    box: dict[str, object] = {"outcome": None}
    with suppress(InputError):  # the report, if it is there, says what it can
        if row.state == State.DONE:
            result = comparison.result_of(service.store, row)
            exports = comparison.exports_of(service.store, row)
            found = outcome(result, exports=exports)
            box = {
                "outcome": found,
                "flights": flights_table(found.checks),
                "warnings": [
                    replace(warning, text=on_the_web(warning.text), small=on_the_web(warning.small))
                    for warning in warnings_of(result.findings)
                ],
                "exports": exports,
            }
    return render("job.html.jinja", others=others, **box, **_live(service, row))


@web.get("/jobs/{job}/live")
def show_live(service: ServiceOfApp, row: JobOfPath) -> Response:
    """Return the part of a job's page that moves."""
    return render("live.html.jinja", **_live(service, row))


def _live(service: Service, row: JobRow) -> dict[str, object]:
    events = jobs.events(service.database, row, most=2 * MAX_EVENTS)
    iterations = [
        float(event.content["position_rmse"])
        for event in events
        if event.kind == "iteration" and event.content.get("position_rmse") is not None
    ]
    log = [str(event.content["text"]) for event in events if event.kind == "message"]
    return {
        "job": row,
        "chart": rmse_chart(iterations),
        "log": log[-MAX_LOG_LINES:],
        "event": row.events,
        "files": f"{API}/jobs/{row.id}/files",
        "ended": row.state in FINISHED,
    }


@web.post("/jobs/{job}/cancel")
def cancel_job(service: ServiceOfApp, job: str) -> Response:
    """Cancel a job, and show it."""
    return RedirectResponse(f"/jobs/{jobs.cancel(service.database, job).id}", status_code=303)


@web.post("/jobs/{job}/retry")
def retry_job(service: ServiceOfApp, job: str) -> Response:
    """Try a job again, and show it."""
    row = jobs.retry(service.database, job)
    service.dispatcher.call()
    return RedirectResponse(f"/jobs/{row.id}", status_code=303)


@web.get("/vehicles")
def list_vehicles(service: ServiceOfApp) -> Response:
    """List the vehicles that have jobs."""
    return render("vehicles.html.jinja", vehicles=vehicles(service.database))


@web.get("/vehicles/{name:path}")
def show_vehicle(service: ServiceOfApp, name: str) -> Response:
    """Show every coefficient of a vehicle over time."""
    found = history(service.database, name)
    charts = [history_chart(key, of) for key, of in found.coefficients.items()]
    return render("vehicle.html.jinja", vehicle=name, history=found, charts=charts)


@web.get("/compare")
def compare(service: ServiceOfApp, a: str = "", b: str = "") -> Response:
    """Show two jobs side by side."""
    rows = [jobs.job(service.database, job) for job in (a, b)]
    first, second = (comparison.result_of(service.store, row) for row in rows)
    return render(
        "compare.html.jinja",
        a=rows[0],
        b=rows[1],
        masses=[comparison.mass_of(result) for result in (first, second)],
        pairs=comparison.pairs(first, second),
        flights=comparison.flight_pairs(first, second),
        units=RMSE_UNITS,
    )


@web.get("/api")
def show_interface(request: Request) -> Response:
    """Show the calls of the HTTP interface, as the application describes them."""
    described = request.app.openapi()
    shapes = described["components"]["schemas"]
    calls = [call for path in described["paths"].values() for call in path.values()]
    meanings = {s: of["description"] for call in calls for s, of in call["responses"].items()}
    return render(
        "api.html.jinja",
        paths=described["paths"],
        shapes=shapes,
        source=request.app.openapi_url,
        refusals={status: meanings[status] for status in sorted(meanings) if status >= "4"},
    )


@web.get("/login")
def login_page() -> Response:
    """Ask for a token."""
    return render("login.html.jinja", problem="")


@web.post("/login")
def login(
    service: ServiceOfApp, request: Request, token: Annotated[str, Form(max_length=1000)] = ""
) -> Response:
    """Open a session, which a cookie names that no script reads and no other site sends."""
    word = tokens.log_in(service.database, token.strip())
    if word is None:
        error = NoTokenError("the token", "is not known to this server", "ask who runs it for one")
        return render("login.html.jinja", 401, problem=str(error))
    answer = RedirectResponse("/", status_code=303)
    answer.set_cookie(
        COOKIE,
        word,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
        max_age=tokens.SESSION_S,
    )
    return answer


@web.post("/logout")
def logout(service: ServiceOfApp, request: Request) -> Response:
    """End the browser's session, here and there."""
    tokens.log_out(service.database, request.cookies.get(COOKIE, ""))
    answer = RedirectResponse("/login", status_code=303)
    answer.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return answer


def typed_settings(text: str) -> dict[str, Any]:
    """Return the keys of a job file that was typed.

    Raises
    ------
    ConfigError
        It is no YAML, or no mapping of keys to values.
    """
    if not text.strip():
        return {}
    data = document_of(text.encode(errors="replace"), Path("settings")).data
    if not isinstance(data, dict):
        raise ConfigError("settings", "are no keys with values", "write them as in tune.yaml")
    return data
