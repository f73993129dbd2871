"""The server as a process: what it listens to, and a clean end."""

from __future__ import annotations

import ipaddress
import logging
from collections.abc import Callable
from dataclasses import replace
from types import FrameType

import uvicorn

from tuner.core.errors import InputError
from tuner.engine.selection import engine_for
from tuner.service import tokens
from tuner.service.app import create_app
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings

LOOPBACK = ("localhost", "127.0.0.1", "::1")
LAST_ANSWERS = 5
"""s that answers under way have when the server ends"""


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
    settings
        See there.
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
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=LAST_ANSWERS,
        h11_max_incomplete_event_size=2**16,
    )
    say(f"Jobs and recordings are kept in {settings.data}.")
    try:
        _Server(config, service, say).run()
    except SystemExit:
        raise InputError(
            "--port", f"{host}:{port} cannot be listened to", "stop what uses it, or name another"
        ) from None
