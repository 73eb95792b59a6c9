"""A real browser, headless, driven by its DevTools protocol. It can reach this machine and nothing else."""

from __future__ import annotations

import base64
import itertools
import json
import re
import shutil
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self
from urllib.request import urlopen

from websockets.sync.client import connect

from conftest import unavailable


class Browser:
    """One page. requests: the URL of everything it asked for. said: what it wrote to its console, errors included."""

    def __init__(self, folder: Path) -> None:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        if program is None:
            unavailable("there is no chromium")
        self._errors = folder / "chromium.log"
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                [str(program), "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                 "--no-first-run", "--disable-background-networking", "--disable-component-update",
                 "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost",
                 f"--user-data-dir={folder / 'profile'}", "--remote-debugging-port=0", "about:blank"],
                stderr=errors,
            )  # fmt: skip
        self._ids, self.requests, self.said = itertools.count(1), list[str](), list[str]()
        [target] = [one for one in json.load(urlopen(self._debugger() + "/json")) if one["type"] == "page"]
        self._open = ExitStack()
        self._socket = self._open.enter_context(connect(target["webSocketDebuggerUrl"], max_size=None))
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.ask(f"{domain}.enable")

    def _debugger(self) -> str:
        deadline = time.monotonic() + 60
        while not (found := re.search(r"listening on ws://([^/]+)/", self._errors.read_text(errors="replace"))):
            assert time.monotonic() < deadline and self._process.poll() is None, self._errors.read_text()
            time.sleep(0.05)
        return f"http://{found[1]}"

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(60))
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return dict(answer["result"])
            match answer.get("method"):
                case "Network.requestWillBeSent":
                    self.requests.append(answer["params"]["request"]["url"])
                case "Runtime.consoleAPICalled" | "Runtime.exceptionThrown" | "Log.entryAdded":
                    self.said.append(json.dumps(answer["params"]))

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        got = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in got, got
        return got["result"].get("value")

    def open(self, url: str) -> None:
        self.ask("Page.navigate", url=url)
        self.until("document.readyState === 'complete'")

    def until(self, condition: str, seconds: float = 30.0) -> None:
        """Wait until an expression in the page is true."""
        deadline = time.monotonic() + seconds
        while not self.run(condition):
            assert time.monotonic() < deadline, f"{condition}: {self.run('document.body.innerText')[:2000]} {self.said}"
            time.sleep(0.05)

    def looks(self, width: int = 1280, height: int = 900, *, dark: bool = False, still: bool = False) -> None:
        """The window's size, and what its owner prefers."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.ask("Emulation.setEmulatedMedia", features=[
            {"name": "prefers-color-scheme", "value": "dark" if dark else "light"},
            {"name": "prefers-reduced-motion", "value": "reduce" if still else "no-preference"},
        ])  # fmt: skip

    def press(self, key: str, code: int) -> None:
        for kind in ("rawKeyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def picture(self, file: Path) -> None:
        got = self.ask("Page.captureScreenshot", captureBeyondViewport=True)
        file.write_bytes(base64.b64decode(got["data"]))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        self._process.terminate()
        self._process.wait(20)
