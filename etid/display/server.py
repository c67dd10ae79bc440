"""The process that serves the page, and the slot through which the loop hands it what is shown.

Tornado serves it: one package without dependencies, on which Jupyter runs, so that most
laboratories have it. Panel, Dash and NiceGUI bring twenty packages and more, keep a session of each
window in memory, and a picture of theirs takes longer than a pulse. The page is plain SVG and asks
for the picture again when it has drawn the last one. A window that is slow gets fewer pictures, and
one that finds a new server asks for the page again; nothing is kept for a window.
"""

import asyncio
import json
import multiprocessing
import pathlib
import secrets
import signal
import socket
from multiprocessing.context import SpawnContext
from typing import Any

import numpy as np
from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler

from etid.display.stimulator import Output

HEADER = "X-Etid-Token"
ALIVE = 0.5  # [s] between two looks at the loop's process


class Slot:
    """Memory of two processes for one snapshot, which a newer one replaces.

    Attributes:
        stopping: Ready to be read after a stop, and after the end of the page's process.
        press: The other end of `stopping`, for the page's process.
        pressed: Whether someone has stopped; only the page's process knows.
        output: What the stimulator gives.
        electrode: Number of the electrode whose pulse is shown.
    """

    def __init__(self, context: SpawnContext, dtype: np.dtype) -> None:
        self._dtype = dtype
        self._memory = context.RawArray("b", dtype.itemsize)
        self._lock = context.Lock()
        self.stopping, self.press = context.Pipe(duplex=False)
        self.pressed = False
        self.output = context.RawValue("b", 0)
        self.electrode = context.RawValue("l", 0)

    def put(self, snapshot: np.ndarray, *, wait: bool) -> None:
        """Replace the snapshot; unless one waits, it is dropped if the other process just reads."""
        if self._lock.acquire(block=wait, timeout=ALIVE):
            np.frombuffer(self._memory, self._dtype)[:] = snapshot
            self._lock.release()

    def get(self) -> np.void:
        """A copy of the last snapshot."""
        with self._lock:
            return np.frombuffer(self._memory, self._dtype).copy()[0]


class _Handler(RequestHandler):
    """What all requests must have: the loopback address as host, and no other site as origin."""

    def initialize(self, slot: Slot, told: dict[str, Any], hosts: set[str]) -> None:
        self.slot, self.told, self.hosts = slot, told, hosts

    def set_default_headers(self) -> None:
        self.set_header("Cache-Control", "no-store")
        self.set_header("Content-Security-Policy", "frame-ancestors 'none'")

    def prepare(self) -> None:
        """Refuse what comes from another site.

        A name of another site may lead to this address, so that the host is looked at, too. What
        acts needs the token, which only this page has been told; another site cannot read it.
        """
        origin = self.request.headers.get("Origin")
        known = {f"http://{host}" for host in self.hosts}
        if self.request.host not in self.hosts or origin not in {None, *known}:
            raise HTTPError(403)
        token = self.request.headers.get(HEADER, "")
        if self.request.method == "POST" and not secrets.compare_digest(
            token.encode(), self.told["token"].encode()
        ):
            raise HTTPError(403)


class _Page(_Handler):
    def get(self) -> None:
        told = json.dumps(self.told, ensure_ascii=False).replace("<", "\\u003c")
        page = pathlib.Path(__file__).with_name("page.html").read_text("utf-8")
        self.finish(page.replace("{{TOLD}}", told))


class _State(_Handler):
    def get(self) -> None:
        of = self.slot.get()
        shown = {name: _plain(of[name]) for name in of.dtype.names or ()}
        stop, output = self.slot.pressed, self.slot.output.value
        self.finish(shown | {"start": self.told["start"], "stop": stop, "output": output})


class _Stop(_Handler):
    async def post(self) -> None:
        """Pass the stop on; the answer says whether 0 was sent, after which nothing else is."""
        if not self.slot.pressed:
            self.slot.press.send_bytes(b"stop")
            self.slot.pressed = True
        for _ in range(100):
            if self.slot.output.value not in (Output.REST, Output.RUNNING):
                break
            await asyncio.sleep(ALIVE / 100)
        self.finish({"zero": self.slot.output.value == Output.ZERO})


class _Electrode(_Handler):
    def post(self) -> None:
        chosen = self.request.body.decode("ascii", "replace")
        if not chosen.isdecimal() or int(chosen) >= len(self.told["names"]):
            raise HTTPError(400)
        self.slot.electrode.value = int(chosen)
        self.finish({})


def _plain(value: Any) -> Any:
    """A field of a snapshot in types that JSON has; NaN is null."""
    if isinstance(value, np.ndarray):
        return [_plain(each) for each in value]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, np.floating):
        return float(f"{value:.4g}") if np.isfinite(value) else None
    return value.item()


def serve(listening: socket.socket, slot: Slot, told: dict[str, Any]) -> None:
    """Serve the page until the process of the loop ends.

    Args:
        listening: Bound to the loopback address.
        slot: What is shown.
        told: What the page is told once.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the loop, which ends this process
    asyncio.run(_serve(listening, slot, told))


async def _serve(listening: socket.socket, slot: Slot, told: dict[str, Any]) -> None:
    port = listening.getsockname()[1]
    hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
    given = {"slot": slot, "told": told, "hosts": hosts}
    paths = {"/": _Page, "/state": _State, "/stop": _Stop, "/electrode": _Electrode}
    application = Application(
        [(path, handler, given) for path, handler in paths.items()], log_function=lambda _: None
    )
    server = HTTPServer(application, max_body_size=1000)
    listening.setblocking(False)
    server.add_socket(listening)
    loop = multiprocessing.parent_process()
    while loop is not None and loop.is_alive():
        await asyncio.sleep(ALIVE)
