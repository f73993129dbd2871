"""Checks of every request: host, origin, token, rate and size; and headers of every answer.

A page elsewhere on the web must not reach a server on this machine through its user's browser: not
under a name that it made point here (the host is checked), and not with a form of its own (the
origin is checked, and a session counts for a form only where the browser says which page sent it).
A proxy that lets others in is not for a server without tokens.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from http import HTTPStatus
from urllib.parse import urlsplit

import anyio
import anyio.to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from tuner.service import tokens
from tuner.service.errors import (
    NotAllowedError,
    NoTokenError,
    ServiceError,
    TooLargeError,
    TooManyError,
)
from tuner.service.service import Service
from tuner.service.settings import size_in_words

COOKIE = "tune_session"
PUBLIC_PATHS = ("/healthz", "/login", "/static/")
PROXY_HEADERS = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via")
"""Headers by which a request shows that it came through a proxy."""
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
UPLOAD_PATHS = ("/api/v1/recordings", "/recordings")
FORM_BYTES = 2**16
"""Bytes around the recording of an upload."""
CURRENT_VISITOR: ContextVar[str | None] = ContextVar("VISITOR", default=None)
"""The owner of the current request's session."""
MAX_VISITORS = 10_000
#: Pages run the service's own scripts and style, and load nothing from elsewhere. The digest is of
#: the one style that the plotting library puts into a figure.
PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; "
    "style-src 'self' 'sha256-jSYQUrW7J0b3jPqhZP9C2Xh1PyJKHKXd4s0fpGGKrww='; img-src 'self' data:; "
    "connect-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
#: A report runs its own scripts in a world of its own: no cookies, no connection, no form.
REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads allow-popups; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
Answer = Callable[[Request, ServiceError], Awaitable[ASGIApp]]


class Guard:
    """Middleware around the application.

    Parameters
    ----------
    refuse
        Makes the answer to a request that is refused.
    """

    def __init__(self, app: ASGIApp, service: Service, refuse: Answer) -> None:
        limits = service.settings.limits
        self._app = app
        self._service = service
        self._refuse = refuse
        self._rates = RateLimit(limits.requests_per_second, limits.requests_in_a_burst)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began, status = time.perf_counter(), 500

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                _add_headers(MutableHeaders(scope=message))
            await send(message)

        request = Request(scope)
        try:
            await self._check(request)
            body = await self._body(request, receive)
            await self._app(scope, body, send_with_headers)
        except ServiceError as error:
            answer = await self._refuse(request, error)
            await answer(scope, receive, send_with_headers)
        finally:
            route = getattr(scope.get("route"), "path", "none")
            is_known = route != "none" and status != HTTPStatus.METHOD_NOT_ALLOWED
            labels = (scope["method"] if is_known else "any", route, str(status))
            self._service.metrics.seconds.labels(*labels).observe(time.perf_counter() - began)

    async def _check(self, request: Request) -> None:
        settings = self._service.settings
        if settings.hosts and _host_name(request.headers) not in settings.hosts:
            remedy = "open the server's own URL, or start it with --allow-host"
            raise NotAllowedError("the request", "names another host", remedy)
        if not settings.demands_tokens and any(name in request.headers for name in PROXY_HEADERS):
            raise NotAllowedError(
                "the request",
                "came through a proxy, and this server asks nobody for a token",
                "start it with --tokens always",
            )
        if request.method not in SAFE_METHODS:
            _check_origin(request.headers)
        visitor = request.client.host if request.client else "unknown"
        if settings.demands_tokens:
            name = await anyio.to_thread.run_sync(self._owner, request)
            CURRENT_VISITOR.set(name if COOKIE in request.cookies else None)
            if name is not None:
                visitor = f"token {name}"
            elif not request.url.path.startswith(PUBLIC_PATHS):
                raise NoTokenError("the request", "shows no token of this server", "log in with it")
        if not self._rates.allows(visitor):
            raise TooManyError("the server", "is asked too often by you", "wait some seconds")

    def _owner(self, request: Request) -> str | None:
        database, headers = self._service.database, request.headers
        kind, _, word = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            return tokens.owner(database, word.strip())
        session = request.cookies.get(COOKIE, "")
        is_ours = (
            request.method in SAFE_METHODS or "origin" in headers or "sec-fetch-site" in headers
        )
        return tokens.logged_in(database, session) if session and is_ours else None

    async def _body(self, request: Request, receive: Receive) -> Receive:
        """Return a function that passes on a body of limited size that does not come too slowly.

        Any but a recording's is complete before.
        """
        if request.method in SAFE_METHODS:
            return receive
        limits, is_upload = self._service.settings.limits, request.url.path in UPLOAD_PATHS
        most = limits.upload_bytes if is_upload else limits.body_bytes
        began, size, more = time.monotonic(), 0, True

        async def part() -> Message:
            nonlocal size, more
            if not more:
                return await receive()
            credit = began + size / limits.bytes_per_second - time.monotonic()
            try:
                with anyio.fail_after(limits.stall_seconds + min(0.0, credit)):
                    message = await receive()
            except TimeoutError:
                raise ServiceError("the request", "came too slowly", "send it again") from None
            size, more = size + len(message.get("body", b"")), message.get("more_body", False)
            if size > most + is_upload * FORM_BYTES:
                what = f"is larger than the {size_in_words(most)} that this server takes"
                remedy = "split recordings, or leave out topics such as images"
                raise TooLargeError("the request", what, remedy)
            return message

        if is_upload:
            return part
        parts = [await part()]
        while more:
            parts.append(await part())

        async def replay() -> Message:
            return parts.pop(0) if parts else await receive()

        return replay


def _host_name(headers: Headers) -> str:
    """Return the name under which a request addresses the server, without its port."""
    try:
        return urlsplit(f"//{headers.get('host', '')}").hostname or ""
    except ValueError:  # half of an IPv6 address
        return ""


def _check_origin(headers: Headers) -> None:
    """Refuse a request from a page of another site."""
    origin = headers.get("origin")
    elsewhere = origin is not None and origin.partition("://")[2] != headers.get("host")
    if elsewhere or headers.get("sec-fetch-site") in ("cross-site", "same-site"):
        raise NotAllowedError(
            "the request", "comes from a page of another site", "use the server's own pages"
        )


def _add_headers(headers: MutableHeaders) -> None:
    headers.setdefault("content-security-policy", PAGE_POLICY)
    headers.setdefault("x-content-type-options", "nosniff")
    headers.setdefault("referrer-policy", "same-origin")  # without one, forms have no origin
    headers.setdefault("cache-control", "no-store")
    headers.setdefault("cross-origin-resource-policy", "same-origin")


class RateLimit:
    """A bucket for each visitor."""

    def __init__(self, per_second: float, burst: float) -> None:
        self._per_second = per_second
        self._burst = burst
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def allows(self, visitor: str, now: float | None = None) -> bool:
        """Take one request out of a visitor's bucket, if there is one in it."""
        now = time.monotonic() if now is None else now
        left, seen = self._buckets.pop(visitor, (self._burst, now))
        left = min(self._burst, left + (now - seen) * self._per_second)
        allowed = left >= 1.0
        self._buckets[visitor] = (left - float(allowed), now)
        while len(self._buckets) > MAX_VISITORS:
            self._buckets.popitem(last=False)
        return allowed
