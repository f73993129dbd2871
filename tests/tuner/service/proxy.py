"""A reverse proxy as small as one can be: a request goes on as it came, the answer back."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

ALONE = ("connection", "transfer-encoding", "host", "content-length", "date")


@contextmanager
def proxied(port: int, *, host: str | None = None, tells: bool = True) -> Iterator[str]:
    """Yield the URL of a proxy in front of a port of this machine.

    Parameters
    ----------
    port
        Of the server.
    host
        The name that the server is told, as proxies do unless they are told not to; None passes on
        what the visitor typed.
    tells
        Whether it says for whom it asks, over TLS.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def answer(self) -> None:
            headers = {k: v for k, v in self.headers.items() if k.lower() not in ALONE}
            headers["Host"] = host or self.headers["Host"]
            if tells:
                headers |= {"X-Forwarded-For": "192.0.2.7", "X-Forwarded-Proto": "https"}
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            there = http.client.HTTPConnection("127.0.0.1", port)
            there.request(self.command, self.path, body=body, headers=headers)
            answer = there.getresponse()
            content = answer.read()
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in ALONE:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)
            there.close()

        do_GET = do_POST = answer  # noqa: N815 (as http.server calls them)

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
