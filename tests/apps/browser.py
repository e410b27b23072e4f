"""A headless Chromium for tests, driven by the DevTools protocol."""

import base64
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--mute-audio", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--enable-unsafe-swiftshader", "--hide-scrollbars",
    "--force-color-profile=srgb", "--remote-debugging-port=0",
]  # fmt: skip


def chromium() -> str | None:
    """Where it is, if it is here."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


class Browser:
    """One page of a fresh browser; use it in a `with` block."""

    def __init__(self, folder: Path, *, size: tuple[int, int] = (1200, 800)) -> None:
        program = chromium()
        assert program is not None
        window = f"--window-size={size[0]},{size[1]}"
        self._process = subprocess.Popen(
            [program, *FLAGS, window, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._folder, self._numbers = folder, itertools.count(1)

    def __enter__(self) -> "Browser":
        from websockets.sync.client import connect

        port_file = self._folder / "DevToolsActivePort"
        until(lambda: port_file.exists() and port_file.read_text().count("\n") >= 1, 60.0)
        port = int(port_file.read_text().split()[0])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            pages = json.load(answer)
        address = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
        self._socket = connect(address, max_size=None)
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(timeout=20.0)

    def go(self, address: str) -> None:
        self._ask("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        answer = self._ask("Runtime.evaluate", expression=script, returnByValue=True)
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

    def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60.0))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]


def until(condition: Any, seconds: float) -> None:
    """Waits for something to become true."""
    end = time.perf_counter() + seconds
    while not condition():
        assert time.perf_counter() < end, "it never happened"
        time.sleep(0.05)
