"""A film of the phone page's own camera: from Stop to a picture of its avatar in the page.

    python -m benchmarks.phone_page [--seconds 20] [--films 3] [--keep DIR]

Chromium's fake camera plays the sample at 720p, in a fresh browser for each film; browser and
ia-capture share the cores of this machine.
"""

import itertools
import json
import signal
import subprocess
import sys
import tempfile
import time
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import psutil
import tyro
from jaxtyping import Float

from baselines.hardware import ROOT, Hardware
from benchmarks.measurements import Measurement, markdown_rows
from benchmarks.phone import FILMED_PX, FPS, SIZE_PX, command
from tests.instant_avatar.browser import Browser, until

CAMERA_FLAGS = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream"]
WINDOW_PX = (360, 740)
LISTEN = """
addEventListener("message", ({ source, data }) => {
  if (data !== "drawn" || source === document.getElementById("warm-up")?.contentWindow) return;
  window.drawnAt ??= performance.timeOrigin + performance.now();
});
window.stoppedAt = performance.timeOrigin + performance.now();
document.getElementById("stop").click();
"""
"""Stops the film and notes when the player has drawn."""
PACKAGE_AT = """
(() => {
  const { performance } = document.getElementById("player").contentWindow;
  const files = performance.getEntriesByType("resource").filter((e) => e.name.endsWith(".iavatar"));
  return performance.timeOrigin + Math.min(...files.map(({ responseStart }) => responseStart));
})()
"""
"""When the package's first byte came."""


def main(seconds: float = 20.0, films: int = 3, keep: Path | None = None) -> None:
    """Measure some films of some seconds; a sample in `keep` is used again."""
    hardware = Hardware.here()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        sample = (keep or folder) / f"sample{FILMED_PX}"
        if not sample.exists():
            size = ["--size", str(FILMED_PX), "--frames", str(round(seconds * FPS))]
            subprocess.run([*command("sample"), str(sample), "--like-a-phone", *size], check=True)
        camera = folder / "camera.mjpeg"
        encode_camera(sample / "video.mp4", camera, round(seconds * FPS))
        found = []
        for number in range(films):
            found.append(film(folder / str(number), camera, seconds))
            print(found[-1], file=sys.stderr, flush=True)
    print("\n".join([*hardware.lines(), "", *markdown_rows(marks(np.array(found), seconds))]))


def encode_camera(source: Path, out: Path, count: int) -> None:
    """Encode the first frames at 720p as a film for Chromium's fake camera, which repeats it."""
    with av.open(str(source)) as video, av.open(str(out), "w", format="mjpeg") as camera:
        stream = camera.add_stream("mjpeg", rate=FPS, options={"qmin": "3", "qmax": "5"})
        (stream.width, stream.height), stream.pix_fmt = SIZE_PX, "yuvj420p"
        for index, frame in enumerate(itertools.islice(video.decode(video=0), count)):
            image = frame.reformat(*SIZE_PX, format="yuvj420p")
            image.pts, image.time_base = index, Fraction(1, FPS)
            camera.mux(stream.encode(image))
        camera.mux(stream.encode())


def film(place: Path, camera: Path, seconds: float) -> tuple[float, float, float, float]:
    """Film once.

    Returns:
        Wall seconds from Stop to the package's first byte and to a picture of it; CPU seconds of
        ia-capture meanwhile; dB held out.
    """
    options = ["--no-tls", "--host", "127.0.0.1", "--port", "8420", "--out", str(place / "avatars")]
    program = [*command("phone.phone_command"), *options]
    flags = [*CAMERA_FLAGS, f"--use-file-for-fake-video-capture={camera}"]
    with subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            address, process = server.stdout.readline().strip(), psutil.Process(server.pid)
            with Browser(place / "browser", size=WINDOW_PX, flags=flags) as browser:
                browser.emulate(scheme="light", size=WINDOW_PX)
                browser.go(address)
                until(lambda: browser.run("!!document.getElementById('live')?.onclick"), 60.0)
                browser.run("document.getElementById('name').value = 'film'")
                browser.run("document.getElementById('live').click()")
                until(lambda: browser.run("!document.getElementById('stop').hidden"), 60.0)
                time.sleep(seconds)
                before = sum(process.cpu_times()[:2])
                browser.run(LISTEN)
                until(lambda: browser.run("!!window.drawnAt"), 300.0)
                spent = sum(process.cpu_times()[:2]) - before
                stopped, drawn = browser.run("[window.stoppedAt, window.drawnAt]")
                package = browser.run(PACKAGE_AT)
        finally:
            server.send_signal(signal.SIGINT)
    report = json.loads((place / "avatars" / "film" / "run" / "report.json").read_text())
    waits = (package - stopped) / 1000.0, (drawn - stopped) / 1000.0
    return *waits, spent, report["held_out"]["psnr"]


def marks(found: Float[np.ndarray, "films 4"], seconds: float) -> list[Measurement]:
    """The rows: medians, and all films beside them."""
    rows = [
        ("Stop to the first byte of the package, s", "", ""),
        ("Stop to a picture in the page, s", "≤ 6", "≤ 3"),
        ("CPU time of ia-capture meanwhile, s", "", ""),
        ("held-out PSNR, dB", "", ""),
    ]
    return [
        Measurement(
            name=name, value=float(np.median(values)), required=least, stretch_goal=more,
            context=f"{len(found)} films of {seconds:g} s: {', '.join(f'{v:.2f}' for v in values)}",
        )
        for (name, least, more), values in zip(rows, found.T, strict=True)
    ]  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.phone_page", description=__doc__)
