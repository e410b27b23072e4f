"""A headless Chromium for tests, driven by the DevTools protocol through a pipe."""

import base64
import contextlib
import io
import itertools
import json
import os
import select
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from PIL import Image

from capture.input_error import InputError
from export import player_page
from instant_avatar.animation.web_server import make_server

FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--mute-audio", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--enable-unsafe-swiftshader", "--hide-scrollbars",
    "--force-color-profile=srgb", "--remote-debugging-pipe",
]  # fmt: skip

LAUNCH = """
import fcntl, os, sys
hears, says = (fcntl.fcntl(int(pipe), fcntl.F_DUPFD, 10) for pipe in sys.argv[1:3])
os.dup2(hears, 3)
os.dup2(says, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Chromium listens on descriptor 3 and answers on 4."""
COMPLAINTS = ("Runtime.exceptionThrown", "Log.entryAdded", "Inspector.targetCrashed")
"""Events that say why a page does not work."""


def chromium() -> str | None:
    """Where it is, if it is here."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


def has_runtime() -> bool:
    """Whether onnxruntime-web is here."""
    try:
        player_page.runtime_files()
    except InputError:
        return False
    return True


with_chromium = pytest.mark.skipif(chromium() is None, reason="there is no Chromium here")
with_runtime = pytest.mark.skipif(
    not has_runtime(), reason="onnxruntime-web is not here (make web)"
)


def in_browser(test: Any) -> Any:
    """Marks a slow test of the player's page."""
    return pytest.mark.slow(with_chromium(with_runtime(test)))


@contextlib.contextmanager
def serving(files: dict[str, bytes], port: int) -> Iterator[str]:
    """The address of some files during a block."""
    server = make_server(files, port)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


class Browser:
    """One page of a fresh browser; use it in a `with` block."""

    def __init__(
        self, folder: Path, *, size: tuple[int, int] = (1200, 800), flags: list[str] | None = None
    ) -> None:
        program = chromium()
        assert program is not None
        window = f"--window-size={size[0]},{size[1]}"
        hears, self._says = os.pipe()
        self._hears, says = os.pipe()
        launch = [sys.executable, "-S", "-c", LAUNCH, str(hears), str(says)]
        profile = f"--user-data-dir={folder}"
        self._process = subprocess.Popen(
            [*launch, program, *FLAGS, *(flags or []), window, profile, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(hears, says),
        )
        os.close(hears)
        os.close(says)
        self._session, self._held, self._numbers = "", b"", itertools.count(1)
        self.complaints: list[dict[str, Any]] = []

    def __enter__(self) -> "Browser":
        until(self._pages, 60.0)
        target = self._pages()[0]  # the window's own: one behind it is not always painted
        attached = self._ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        self._ask("Page.bringToFront")
        self._ask("Runtime.enable")
        self._ask("Log.enable")
        return self

    def _pages(self) -> list[str]:
        found = self._ask("Target.getTargets", whole=True)["targetInfos"]
        return [target["targetId"] for target in found if target["type"] == "page"]

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            if error is not None:
                error.add_note(f"The page: {self.text()}\nThe browser: {self.complaints}")
        finally:
            self._close()

    def _close(self) -> None:
        self._process.terminate()
        self._process.wait(timeout=20.0)
        os.close(self._says)
        os.close(self._hears)

    def go(self, address: str) -> None:
        self._ask("Page.navigate", url=address)

    def run(self, script: str, *, seconds: float = 60.0) -> Any:
        """The value of an expression in the page; what it promises is waited for."""
        question = {"expression": script, "returnByValue": True, "awaitPromise": True}
        answer = self._ask("Runtime.evaluate", seconds=seconds, **question)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self) -> str:
        """All words on the page."""
        return self.run("document.body ? document.body.innerText : ''")

    def click(self, label: str) -> None:
        """Presses the button that bears these words."""
        found = self.run(
            "(() => { const b = [...document.querySelectorAll('button')]"
            f".find(b => b.textContent.trim() === {json.dumps(label)});"
            " if (b) b.click(); return !!b; })()"
        )
        assert found, f"no button {label!r}: {self.text()}"

    def picture(self) -> np.ndarray:
        """What it shows, RGB."""
        data = self._ask("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def cpu_seconds(self) -> float:
        """CPU time that all of its processes have spent so far."""
        processes = self._ask("SystemInfo.getProcessInfo", whole=True)["processInfo"]
        return sum(process["cpuTime"] for process in processes)

    def emulate(self, *, scheme: str, size: tuple[int, int], motion: str = "") -> None:
        """A device's size, and whether its owner likes it dark and calm (motion: "reduce")."""
        preferences = {"prefers-color-scheme": scheme, "prefers-reduced-motion": motion}
        features = [{"name": name, "value": value} for name, value in preferences.items()]
        self._ask("Emulation.setEmulatedMedia", features=features)
        width, height = size
        self._ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )

    def save_to(self, folder: Path) -> None:
        """Downloads are allowed, into a folder."""
        how = {"behavior": "allow", "downloadPath": str(folder)}
        self._ask("Browser.setDownloadBehavior", whole=True, **how)

    def claim_cores(self, count: int) -> None:
        """What the machine says of its cores."""
        self._ask("Emulation.setHardwareConcurrencyOverride", hardwareConcurrency=count)

    def worker_threads(self) -> int:
        """Threads that run workers, in all of its processes; Linux names them."""
        family = psutil.Process(self._process.pid).children(recursive=True)
        names = []
        for process in family:
            for path in Path("/proc", str(process.pid), "task").glob("*/comm"):
                with contextlib.suppress(OSError):  # a thread that has ended meanwhile
                    names.append(path.read_text())
        return sum(name.startswith("DedicatedWorker") for name in names)

    def press(self, key: str) -> None:
        """A key goes down and up; characters are typed."""
        text = {"text": key} if len(key) == 1 else {}
        self._ask("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self._ask("Input.dispatchKeyEvent", type="keyUp", key=key)

    def drag(self, start: tuple[int, int], end: tuple[int, int]) -> None:
        """The mouse is pressed at one place and let go at another."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            held = {"button": "left", "buttons": 1, "clickCount": 1}
            self._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held)

    def _ask(
        self, method: str, *, seconds: float = 60.0, whole: bool = False, **parameters: Any
    ) -> dict[str, Any]:
        """Asks the page, or the whole browser."""
        number = next(self._numbers)
        question = {"id": number, "method": method, "params": parameters}
        if self._session and not whole:
            question["sessionId"] = self._session
        os.write(self._says, json.dumps(question).encode() + b"\0")
        end = time.perf_counter() + seconds
        while True:
            answer = self._answer(end, method)
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def _answer(self, end: float, method: str) -> dict[str, Any]:
        """The next message, answer or not."""
        while b"\0" not in self._held:
            left = end - time.perf_counter()
            ready = select.select([self._hears], [], [], max(left, 0.0))[0]
            assert ready, f"the browser does not answer {method}"
            part = os.read(self._hears, 1 << 20)
            assert part, "the browser has ended"
            self._held += part
        message, self._held = self._held.split(b"\0", 1)
        answer = json.loads(message)
        if answer.get("method") in COMPLAINTS:
            self.complaints.append(answer["params"])
        return answer


def until(condition: Any, seconds: float) -> None:
    """Waits for something to become true."""
    end = time.perf_counter() + seconds
    while not condition():
        assert time.perf_counter() < end, "it never happened"
        time.sleep(0.05)
