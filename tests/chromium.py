"""Headless Chromium by its DevTools protocol, over a pipe: what a page says of itself."""

import contextlib
import json
import os
import pathlib
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from typing import Any

import pytest


class Page:
    """An open page.

    Attributes:
        complaints: What was logged as a warning or an error, and exceptions.
        requests: Addresses that were asked for, but for those that hold their own data.
    """

    def __init__(self, sending: int, receiving: int):
        self._sending = sending
        self._receiving = os.fdopen(receiving, "rb")
        self._number = 0
        self._session: dict[str, str] = {}
        self._rest = b""
        self.complaints: list[str] = []
        self.requests: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and wait for its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters} | self._session
        os.write(self._sending, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, page: pathlib.Path | str) -> None:
        """Load a file or an address and wait until all its pictures are there."""
        url = page if isinstance(page, str) else page.as_uri()
        self.call("Page.navigate", url=url)
        while self._next().get("method") != "Page.loadEventFired":
            pass

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript, in the page."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")  # undefined has none

    def close(self) -> None:
        """Close the pipe that Chromium wrote to."""
        self._receiving.close()

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            read = self._receiving.read1()
            assert read, "Chromium has ended"
            self._rest += read
        line, self._rest = self._rest.split(b"\0", 1)
        message = json.loads(line)
        about = message.get("params", {})
        match message.get("method"):
            case "Runtime.consoleAPICalled" if about["type"] in ("error", "warning", "assert"):
                self.complaints.append(json.dumps(about["args"]))
            case "Runtime.exceptionThrown":
                self.complaints.append(about["exceptionDetails"]["text"])
            case "Log.entryAdded" if about["entry"]["level"] in ("error", "warning"):
                self.complaints.append(about["entry"]["text"])
            case "Network.requestWillBeSent" if not about["request"]["url"].startswith("data:"):
                self.requests.append(about["request"]["url"])
        return message


@contextlib.contextmanager
def chromium() -> Iterator[Page]:
    """A page of a Chromium of its own; the test is skipped, visibly, where there is none."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("there is no chromium on PATH (Debian's package chromium)")
    to_read, sending = os.pipe()
    receiving, to_write = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        # The protocol is spoken on descriptors 3 and 4, whatever numbers the pipes have here.
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
        command = f'exec "$0" "$@" 3<&{to_read} 4>&{to_write}'
        with subprocess.Popen(
            ["bash", "-c", command, program, *options, f"--user-data-dir={folder}"],
            pass_fds=(to_read, to_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            os.close(to_read)
            os.close(to_write)
            page = Page(sending, receiving)
            try:
                yield page
            finally:
                page.call("Browser.close")
                os.close(sending)
                process.wait(timeout=20)
                page.close()
