"""A tile server on the loopback that misbehaves on request: the world that the downloader must live with."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
from PIL import Image

# What a request does, by name: ok, drop, 429, 500, truncate, half-image, stall, drip, junk, empty, 404, 403, 512px
Behaviour = Callable[[str, int], str]


def tile_image(path: str, size_px: int = 256) -> bytes:
    """A PNG whose pixels depend on the path, so that a mix-up shows."""
    seed = np.frombuffer(path.encode(), np.uint8).astype(np.int64)
    colour = (int((seed * np.arange(1, len(seed) + 1)).sum()) * 37) % (1 << 24)
    image = np.zeros((size_px, size_px, 3), np.uint8)
    image[:] = (colour >> 16, colour >> 8 & 255, colour & 255)
    image[: size_px // 4, : size_px // 2] = np.random.default_rng(colour).integers(0, 255, 3)
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


@dataclass
class TileServer:
    """What the server does and what it has seen. ``behave(path, attempt)`` names the behaviour; attempt counts from 0."""

    behave: Behaviour = lambda path, attempt: "ok"
    retry_after: str | None = None
    stall_s: float = 5.0
    delay_s: float = 0.0
    url: str = ""
    times: list[float] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    attempts: Counter[str] = field(default_factory=Counter)
    open_now: int = 0
    open_most: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)
    stopping: threading.Event = field(default_factory=threading.Event)


@contextlib.contextmanager
def tile_server(behave: Behaviour | None = None, **settings: object) -> Iterator[TileServer]:
    """A server on a free port of 127.0.0.1 for the time of the block."""
    state = TileServer(**({"behave": behave} if behave else {}), **settings)  # type: ignore[arg-type]

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            with state.lock:
                state.open_now += 1
                state.open_most = max(state.open_most, state.open_now)
                state.times.append(time.monotonic())
                state.paths.append(self.path)
                state.headers.append(dict(self.headers))
                attempt = state.attempts[self.path]
                state.attempts[self.path] += 1
            try:
                state.stopping.wait(state.delay_s)
                self.answer(state.behave(self.path, attempt))
            except (BrokenPipeError, ConnectionResetError):
                self.close_connection = True
            finally:
                with state.lock:
                    state.open_now -= 1

        def answer(self, how: str) -> None:
            body = tile_image(self.path)
            status, kind, sent = 200, "image/png", None
            if how == "drop":
                self.close_connection = True
                self.connection.shutdown(socket.SHUT_RDWR)
                return
            if how == "stall":
                self.close_connection = True
                state.stopping.wait(state.stall_s)
                return
            if how in {"429", "500", "404", "403"}:
                status, kind, body = int(how), "text/plain", f"no: {self.path}".encode()
            elif how == "truncate":
                # The connection ends before the promised length.
                sent = body[: len(body) // 2]
            elif how == "half-image":
                # The length is right, the picture is not all there.
                body = body[: len(body) // 2]
            elif how == "junk":
                body, kind = b"<html>please log in</html>", "text/html"
            elif how == "empty":
                body = b""
            elif how == "512px":
                body = tile_image(self.path, 512)
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            if status == 429 and state.retry_after is not None:
                self.send_header("Retry-After", state.retry_after)
            self.end_headers()
            if how == "drip":
                for byte in body:
                    if state.stopping.wait(0.05):
                        break
                    self.wfile.write(bytes([byte]))
                    self.wfile.flush()
                self.close_connection = True
                return
            self.wfile.write(body if sent is None else sent)
            if sent is not None:
                self.wfile.flush()
                self.close_connection = True
                self.connection.shutdown(socket.SHUT_RDWR)

    class Server(ThreadingHTTPServer):
        daemon_threads = True
        block_on_close = False

        def handle_error(self, *args: object) -> None:
            pass

    with Server(("127.0.0.1", 0), Handler) as server:
        state.url = f"http://127.0.0.1:{server.server_address[1]}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield state
        finally:
            state.stopping.set()
            server.shutdown()
            thread.join()
