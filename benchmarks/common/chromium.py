"""A headless Chromium, driven over its DevTools pipe: no driver program, no socket."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

CHROMIUM = next(
    (p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None
)
FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-pipe",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--hide-scrollbars", "--disable-extensions", "--no-first-run",
]  # fmt: skip

Point = tuple[float, float]  # of the window


class Page:
    """One page of a browser of its own. ``problems``: console errors, exceptions, failed loads,
    and every request that is not for the page itself, data within it, or its ``site``."""

    def __init__(self, width: int = 1200, height: int = 900, site: str | None = None) -> None:
        assert CHROMIUM is not None
        self.own = ("file:", "data:", "about:", "blob:", *([site] if site else []))
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        read, self.to = os.pipe()
        self.source, write = os.pipe()
        command = [CHROMIUM, *FLAGS, f"--window-size={width},{height}",
                   f"--user-data-dir={self.profile.name}", "about:blank"]  # fmt: skip
        # The pipe is file descriptors 3 and 4 of the browser.
        script = f'exec "$@" 3<&{read} 4>&{write}'
        self.process = subprocess.Popen(
            ["bash", "-c", script, "bash", *command], pass_fds=(read, write),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(read)
        os.close(write)
        self.count, self.buffer, self.loaded = 0, b"", False
        self.session: str | None = None
        self.problems: list[Any] = []
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self.session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self(f"{domain}.enable")

    def __call__(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command and wait for its result."""
        self.count += 1
        message: dict[str, Any] = {"id": self.count, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self.count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            if not select.select([self.source], [], [], 120)[0]:
                raise TimeoutError("the browser does not answer")
            part = os.read(self.source, 1 << 20)
            if not part:
                raise RuntimeError("the browser has ended")
            self.buffer += part
        head, _, self.buffer = self.buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(head)
        self._note(message.get("method", ""), message.get("params", {}))
        return message

    def _note(self, method: str, params: dict[str, Any]) -> None:
        if method == "Page.loadEventFired":
            self.loaded = True
        elif method == "Runtime.exceptionThrown":
            self.problems.append(params["exceptionDetails"])
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning"):
            self.problems.append(params["args"])
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.problems.append(params["entry"])
        elif method == "Network.requestWillBeSent":
            url = params["request"]["url"]
            if not url.startswith(self.own):
                self.problems.append(url)

    def open(self, path: str | Path) -> None:
        """Load a file, or an address."""
        self.loaded = False
        url = str(path) if "://" in str(path) else Path(path).resolve().as_uri()
        self("Page.navigate", url=url)
        while not self.loaded:
            self._receive()

    def js(self, expression: str) -> Any:
        """The value of a JavaScript expression, promises awaited."""
        done = self(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in done:
            raise RuntimeError(str(done["exceptionDetails"]))
        return done["result"].get("value")

    def until(self, expression: str, seconds: float = 60) -> Any:
        """Wait until a JavaScript expression is true; returns its value."""
        end = time.monotonic() + seconds
        plain = f"(v => v instanceof Node ? true : v)({expression})"
        while not (value := self.js(plain)):
            assert time.monotonic() < end, f"{expression}: {self.js('document.body.innerText')}"
            time.sleep(0.05)
        return value

    def click(self, selector: str, seconds: float = 60) -> None:
        """Click the middle of an element with the mouse, once it is there and enabled."""
        element = f"document.querySelector({json.dumps(selector)})"
        self.until(f"{element} && !{element}.disabled && {element}.offsetParent !== null", seconds)
        x, y = self.js(
            f"(() => {{ {element}.scrollIntoView({{ block: 'center', behavior: 'instant' }});"
            f"const b = {element}.getBoundingClientRect();"
            "return [b.left + b.width / 2, b.top + b.height / 2]; })()"
        )
        self.drag((x, y), (x, y))

    def size(self, width: int, height: int, scale: float = 1, dark: bool = False) -> None:
        """Make the window as large as a device's, in its light or dark colours."""
        self("Emulation.setDeviceMetricsOverride", width=width, height=height,
             deviceScaleFactor=scale, mobile=width < 600)  # fmt: skip
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self("Emulation.setEmulatedMedia", features=features)

    def choose_files(self, selector: str, files: Sequence[str | Path]) -> None:
        """Give files to an input, as a person who picks them does."""
        root = self("DOM.getDocument")["root"]["nodeId"]
        node = self("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self("DOM.setFileInputFiles", nodeId=node, files=[str(f) for f in files])

    def drag(self, start: Point, end: Point, button: str = "left") -> None:
        """Press at one point of the window, move to another and let go."""
        held = {"left": 1, "right": 2}[button]
        points = [("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)]
        for kind, (x, y) in points:
            self("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=held,
                 clickCount=1)  # fmt: skip

    def screenshot(self, path: str | Path, whole: bool = False) -> None:
        """Write a PNG or JPEG of the window, or of the whole page."""
        kind: dict[str, Any] = {"format": "jpeg", "quality": 85}
        kind = kind if Path(path).suffix == ".jpg" else {}
        data = self("Page.captureScreenshot", captureBeyondViewport=whole, **kind)["data"]
        Path(path).write_bytes(base64.b64decode(data))

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()
        os.close(self.to)
        os.close(self.source)
        self.profile.cleanup()
