"""The application and its process: calls, pages, refusals in sentences, an address, a clean end."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from http import HTTPStatus
from types import FrameType

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy import make_url
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from tuner.core.errors import InputError
from tuner.core.runtime import installed
from tuner.core.yaml_section import first_complaint
from tuner.engine.engine import engine_for
from tuner.service import tokens
from tuner.service.errors import ServiceError, on_the_web, over_http
from tuner.service.http import api, watching
from tuner.service.safety import Guard
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings
from tuner.service.shapes import API, Problem
from tuner.service.web.pages import render, web

logger = logging.getLogger(__name__)


def create_app(service: Service) -> FastAPI:
    """Return the application of a service; it starts and closes the service."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        service.dispatcher.start()
        try:
            yield
        finally:
            service.close()

    app = FastAPI(
        title="tune: multirotor coefficients from recorded flights",
        version=installed(),
        openapi_url=f"{API}/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.service = service
    app.include_router(api)
    app.include_router(watching)
    app.include_router(web)
    app.add_exception_handler(InputError, _refused)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(Exception, _fault)
    app.add_middleware(Guard, service=service, refuse=refused)
    return app


async def refused(request: Request, error: InputError) -> ASGIApp:
    """Return the answer to a request that cannot be met."""
    status = error.STATUS if isinstance(error, ServiceError) else 422
    if status == 401 and _wants_page(request) and request.method == "GET":
        return RedirectResponse("/login", status_code=303)
    return _problem(request, status, error.where, error.what, error.remedy)


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, InputError)
    answer = await refused(request, error)
    assert isinstance(answer, Response)
    return answer


async def _invalid(request: Request, error: Exception) -> Response:
    """Return the first complaint about a request's form, as a sentence."""
    assert isinstance(error, RequestValidationError)
    details = [
        {**detail, "loc": detail["loc"][1:]} for detail in error.errors()
    ]  # from body, query
    if details[0]["type"] == "json_invalid":
        return _problem(request, 422, "the request", "is not JSON", "correct it")
    if isinstance(details[0]["input"], bytes):  # as curl -d sends it
        remedy = "send the header Content-Type: application/json"
        return _problem(request, 422, "the request", "is not sent as JSON", remedy)
    what, remedy = first_complaint(details, "its body")  # type: ignore[arg-type]
    return _problem(request, 422, "the request", what, remedy)


async def _http(request: Request, error: Exception) -> Response:
    """Return the answer to an unknown address or method, or to a body that is no JSON."""
    assert isinstance(error, HTTPException)
    words = {
        400: ("cannot be understood", "correct it"),
        404: ("asks for what is not here", "see the start page"),
        405: ("uses a method that this address does not take", "see /api/v1/openapi.json"),
    }
    fallback = (HTTPStatus(error.status_code).phrase.lower(), "correct it")
    what, remedy = words.get(error.status_code, fallback)
    answer = _problem(request, error.status_code, "the request", what, remedy)
    answer.headers.update(error.headers or {})
    return answer


async def _fault(request: Request, error: Exception) -> Response:
    logger.error("%s %r", request.method, request.url.path, exc_info=error)
    what = f"internal error ({type(error).__name__})"
    return _problem(request, 500, "the server", what, "please report it, with its log")


def _wants_page(request: Request) -> bool:
    """Return whether a request is answered with a page: it is none to the interface."""
    is_call = request.url.path.startswith((API, "/healthz", "/metrics"))
    return not is_call and "text/html" in request.headers.get("accept", "")


def _problem(request: Request, status: int, where: str, what: str, remedy: str) -> Response:
    """Return a refusal as a page, or as JSON."""
    detail = " ".join(f"{where}: {what}; {remedy}".split())
    if _wants_page(request):
        sentence = on_the_web(detail)
        return render("problem.html.jinja", status, title="This does not work", sentence=sentence)
    where, what, remedy, detail = map(over_http, (where, what, remedy, detail))
    problem = Problem(where=where, what=what, remedy=remedy, detail=detail)
    headers = {"retry-after": "5"} if status in (429, 503) else {}
    if status == 401:
        headers["www-authenticate"] = "Bearer"
    return JSONResponse(problem.model_dump(), status_code=status, headers=headers)


LOOPBACK = ("localhost", "127.0.0.1", "::1")
SHUTDOWN_S = 5
"""Answers under way get so long when the server ends."""


HEAD_S = 10.0
"""The line and the headers of a request get so long, from the connection or their first byte on."""


class HttpConnection(H11Protocol):
    """A connection that is closed if the head of a request has not come in time."""

    _closing: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request."""
        super().connection_made(transport)
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Take in bytes, and wait for the rest of a head that they may begin."""
        super().data_received(data)
        self._wait_for_head()

    def _wait_for_head(self) -> None:
        lacks_head = self.cycle is None or self.cycle.response_complete
        if lacks_head and self._closing is None:
            self._closing = self.loop.call_later(HEAD_S, self.transport.close)
        elif not lacks_head and self._closing is not None:
            self._closing.cancel()
            self._closing = None


class _Server(uvicorn.Server):
    """A server that lets answers which follow a job end once it is told to stop."""

    def __init__(self, config: uvicorn.Config, service: Service, say: Callable[[str], None]):
        super().__init__(config)
        self._service = service
        self._say = say

    async def startup(self, sockets: list[object] | None = None) -> None:  # type: ignore[override]
        await super().startup(sockets)  # type: ignore[arg-type]
        if self.started:
            port = self.servers[0].sockets[0].getsockname()[1]
            host = self.config.host
            if host in ("0.0.0.0", "::"):  # all addresses: what others type is a name
                host = socket.gethostname()
            self._say(f"Open http://{f'[{host}]' if ':' in host else host}:{port}/ in a browser.")

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._service.stopping.set()
        super().handle_exit(sig, frame)


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def serve(
    settings: ServiceSettings,
    *,
    host: str,
    port: int,
    say: Callable[[str], None],
    cluster: str | None = None,
) -> None:
    """Run a server until it is told to end (SIGINT or SIGTERM).

    Parameters
    ----------
    host, port
        To listen to; port 0 takes a free one.
    say
        Gets sentences for who has started it.
    cluster
        A cluster file, or the address of a scheduler, whose machines do the work; the store must
        be one that they reach. None for processes of this machine.

    Raises
    ------
    InputError
        Something cannot be used, the address is taken, or tokens are demanded and there are none.
    """
    if cluster is not None:
        with engine_for(None, cluster) as engine:
            wide = replace(settings, workers=engine.at_once)
            _serve(Service.open(wide, engine), host=host, port=port, say=say)
        return
    _serve(Service.open(settings), host=host, port=port, say=say)


def _serve(service: Service, *, host: str, port: int, say: Callable[[str], None]) -> None:
    """Run a service that is open until it is told to end."""
    settings = service.settings
    if settings.demands_tokens and not tokens.names(service.database):
        service.close()
        raise InputError(
            "tune serve",
            "demands tokens, and nobody has one",
            "make one with: tune serve token add NAME",
        )
    logging.getLogger("tuner.service").setLevel(logging.INFO)
    config = uvicorn.Config(
        create_app(service),
        host=host,
        port=port,
        http=HttpConnection,  # whose headers are bounded, too
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=SHUTDOWN_S,
        h11_max_incomplete_event_size=2**16,
    )
    url = make_url(settings.database_url).render_as_string(hide_password=True)
    table, store = settings.database and url, settings.store
    places = f"Jobs are kept in {table or settings.data}, recordings in {store or settings.data}."
    say(places if table or store else f"Jobs and recordings are kept in {settings.data}.")
    try:
        _Server(config, service, say).run()
    except SystemExit:
        raise InputError(
            "--port", f"{host}:{port} cannot be listened to", "stop what uses it, or name another"
        ) from None
