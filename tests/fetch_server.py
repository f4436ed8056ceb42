"""A real HTTP server on this machine that can be told to misbehave, request by request."""

from __future__ import annotations

import re
import resource
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from synthetless.fetch import Persistence

QUICK = Persistence(attempts=3, first_wait_s=0.0, timeout_s=5.0)
CONTENT = np.random.default_rng(5).bytes(300_000)


class Handler(BaseHTTPRequestHandler):
    """Answers each request by the next behaviour of the server's script; once that is used up, as a good server."""

    server: Server

    def do_GET(self) -> None:
        self.server.requests.append((self.path, dict(self.headers)))
        behave = self.server.script.pop(0) if self.server.script else serve
        behave(self)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        pass

    def reply(
        self, status: int, body: bytes, headers: Mapping[str, str] | None = None, sent: int | None = None
    ) -> None:
        """A response of which only the first bytes may be sent."""
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | dict(headers or {})).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body[:sent])
        self.wfile.flush()


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.content = CONTENT
        self.etag = '"one"'
        self.script: list[Callable[[Handler], None]] = []
        self.requests: list[tuple[str, dict[str, str]]] = []
        self.over = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/archive.zip"

    @property
    def ranges(self) -> list[str | None]:
        return [headers.get("Range") for _, headers in self.requests]


@contextmanager
def running() -> Iterator[Server]:
    with Server() as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        try:
            yield server
        finally:
            server.over.set()
            server.shutdown()


@contextmanager
def files_of_at_most(size_bytes: int) -> Iterator[None]:
    """A limit on the size of any file written: fails a write half-way, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def answer(handler: Handler) -> tuple[int, bytes, dict[str, str]]:
    content, headers = handler.server.content, {"ETag": handler.server.etag}
    wish = re.fullmatch(r"bytes=(\d+)-", handler.headers.get("Range", ""))
    if not wish or handler.headers.get("If-Range", headers["ETag"]) != headers["ETag"]:
        return 200, content, headers
    start = int(wish[1])
    if start >= len(content):
        return 416, b"", headers
    return 206, content[start:], headers | {"Content-Range": f"bytes {start}-{len(content) - 1}/{len(content)}"}


def serve(handler: Handler) -> None:
    handler.reply(*answer(handler))


def break_off(after: int) -> Callable[[Handler], None]:
    return lambda handler: handler.reply(*answer(handler), sent=after)


def fail(status: int) -> Callable[[Handler], None]:
    return lambda handler: handler.reply(status, b"<html>no</html>")


def redirect(to: str) -> Callable[[Handler], None]:
    return lambda handler: handler.reply(302, b"", {"Location": to})


def ignore_range(handler: Handler, sent: int | None = None) -> None:
    handler.reply(200, handler.server.content, sent=sent)


def stall(handler: Handler) -> None:
    handler.reply(*answer(handler), sent=1000)
    handler.server.over.wait(20)


def trickle(handler: Handler) -> None:
    status, body, headers = answer(handler)
    handler.reply(status, body, headers, sent=0)
    for start in range(0, len(body), 100_000):
        time.sleep(0.05)
        handler.wfile.write(body[start : start + 100_000])
        handler.wfile.flush()


def chunked(*, whole: bool) -> Callable[[Handler], None]:
    def behave(handler: Handler) -> None:
        handler.protocol_version = "HTTP/1.1"
        handler.send_response(200)
        handler.send_header("Transfer-Encoding", "chunked")
        handler.send_header("Connection", "close")
        handler.end_headers()
        body = handler.server.content if whole else handler.server.content[:1000]
        handler.wfile.write(b"%x\r\n%s\r\n" % (len(body), body) + (b"0\r\n\r\n" if whole else b""))
        handler.close_connection = True

    return behave
