"""An HTTP server on this machine, for the explorer's page and for the UM-Bridge protocol."""

from __future__ import annotations

import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from emulator.core.errors import InputError

LOOPBACK = "127.0.0.1"
LARGEST_REQUEST = 2**26  # bytes; a theta, or a direction of as many numbers as are observed
_OF_THIS_MACHINE = (LOOPBACK, "localhost")


class Handler(BaseHTTPRequestHandler):
    """Answers one request about the server's ``subject``."""

    server: Server
    timeout = 300.0  # s; a connection that sends nothing for so long ends, and its thread
    protocol_version = "HTTP/1.1"

    def is_foreign(self) -> bool:
        """Return whether the request is from a page of another site.

        A browser sends the page's address as its origin, and with pictures and scripts, which have
        no origin, that the site is another one. A page whose own name resolves to this machine
        sends that name as the host. A server that other machines reach is known by other names,
        and takes every one.
        """
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return True
        site, mode = self.headers.get("Sec-Fetch-Site"), self.headers.get("Sec-Fetch-Mode")
        if site in ("cross-site", "same-site") and mode != "navigate":  # a link leads here, too
            return True
        name = host.rpartition(":")[0] or host
        return self.server.server_address[0] == LOOPBACK and name not in _OF_THIS_MACHINE

    def body(self) -> str:
        """Return the text sent with the request; ValueError where its length cannot be."""
        size = self.headers.get("Content-Length", "0")
        if not size.isdecimal() or int(size) > LARGEST_REQUEST:
            self.close_connection = True  # where the next request begins is unknown
            raise ValueError(f"Content-Length is {size}; give 0 to {LARGEST_REQUEST} bytes")
        return self.rfile.read(int(size)).decode()

    def send(self, code: int, content: Any, kind: str = "application/json") -> None:
        """Answer with ``content`` of the media type ``kind``; what is not bytes becomes JSON."""
        content = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


class Server(ThreadingHTTPServer):
    """A server of several threads that answer requests about one ``subject``."""

    def __init__(self, handler: type[Handler], subject: Any, host: str, port: int) -> None:
        self.subject = subject
        super().__init__((host, port), handler)


def listen(handler: type[Handler], subject: Any, port: int = 0, host: str = LOOPBACK) -> Server:
    """Return a server, ready for ``serve_forever``; port 0 takes a free one.

    :class:`InputError` for a port that is taken, or none, and for an address of another machine.
    """
    try:
        return Server(handler, subject, host, port)
    except (OSError, OverflowError) as error:
        where = f"port {port}" if host == LOOPBACK else f"{host}, port {port}"
        raise InputError(f"{where}: {error}; give another, or 0 for a free one") from error
