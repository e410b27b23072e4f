"""A video sent as a phone's page films it: what is lost, how late advice is, when it can be played.

    python -m benchmarks.phone [--seconds 20] [--sample-seconds 20] [--capture-only] [--keep DIR]

Films the sample, enlarges it to 720p, and sends it to ia-capture in pieces at its own speed; the
connection breaks twice. Then ia-ingest --realtime learns from the same file. No browser is used
(`benchmarks.phone_page` uses one). Ten minutes: --seconds 600 --capture-only.
"""

import asyncio
import itertools
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import aiohttp
import av
import numpy as np
import psutil
import tyro

from baselines.hardware import ROOT, Hardware
from benchmarks.measurements import Measurement, markdown_rows

FPS, SIZE_PX, FILMED_PX = 30, (720, 1280), 240
"""Frames are filmed 240 px wide, as ia-capture trains on 225; at 720 each would take a second."""
FRAMES_PER_PIECE = 3
"""As many as the page's MediaRecorder hands over at once (0.1 s)."""
BREAKS = (1 / 3, 2 / 3)
"""When the connection breaks, as shares of the video."""


def main(
    seconds: float = 20.0,
    sample_seconds: float = 20.0,
    capture_only: bool = False,
    keep: Path | None = None,
) -> None:
    """Measure ia-capture on a video of some seconds; a sample in `keep` is used again.

    A longer video plays the sample forwards and backwards.
    """
    hardware, count = Hardware.here(), round(seconds * FPS / FRAMES_PER_PIECE) * FRAMES_PER_PIECE
    sampled = min(count, round(sample_seconds * FPS))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        sample, video = (keep or folder) / f"sample{FILMED_PX}", folder / "film.mp4"
        if not sample.exists():
            size = ["--size", str(FILMED_PX), "--frames", str(sampled)]
            subprocess.run([*command("sample"), str(sample), "--like-a-phone", *size], check=True)
        phone = PhoneClient(encode_pieces(sample / "video.mp4", video, count))
        capture = phone.run_capture(folder / "avatars")
        played = None
        if not capture_only:
            out = ["--realtime", "--size", "400", "--out", str(folder / "run")]
            subprocess.run([*command("ingest"), str(video), *out], check=True, stdout=sys.stderr)
            played = json.loads((folder / "run" / "report.json").read_text())
        marks = measurements(phone, capture, played)
    print("\n".join([*hardware.lines(), "", *markdown_rows(marks)]))


def command(module: str) -> list[str]:
    return [sys.executable, "-m", f"instant_avatar.{module}"]


def encode_pieces(source: Path, out: Path, count: int) -> list[bytes]:
    """Encode the first frames at 720p as fragmented MP4; the bytes that each piece adds."""
    flags = {"movflags": "empty_moov+default_base_moof+frag_every_frame", "flush_packets": "1"}
    sizes = [0]
    with av.open(str(source)) as film, av.open(str(out), "w", options=flags) as video:
        fast = {"preset": "veryfast", "tune": "zerolatency"}
        stream = video.add_stream("libx264", rate=FPS, options=fast)
        (stream.width, stream.height), stream.pix_fmt = SIZE_PX, "yuv420p"
        frames = list(itertools.islice(film.decode(video=0), count))
        to_and_fro = itertools.cycle([*frames, *frames[-2:0:-1]])
        for index, frame in zip(range(count), to_and_fro, strict=False):
            image = frame.reformat(*SIZE_PX, format="yuv420p")
            image.pts, image.time_base = index, Fraction(1, FPS)
            video.mux(stream.encode(image))
            if (index + 1) % FRAMES_PER_PIECE == 0 and index + 1 < count:
                sizes.append(out.stat().st_size)
        video.mux(stream.encode())
    content = out.read_bytes()
    return [content[start:end] for start, end in pairwise([*sizes, len(content)])]


class PhoneClient:
    """Sends a video's pieces to ia-capture, and times the messages for its page."""

    def __init__(self, pieces: list[bytes]) -> None:
        self.pieces, self.arrived_at, self.breaks = pieces, list[float](), 0
        self.tracked = 0
        self.delays_s: dict[str, list[float]] = {"seconds": [], "advice": []}
        self.last_core_s = self.played_after_s = self.played_core_s = float("nan")

    def run_capture(self, out: Path, port: int = 8410) -> dict[str, Any]:
        """Send the video to an ia-capture of its own; the report of its run."""
        place = ["--no-tls", "--host", "127.0.0.1", "--port", str(port), "--out", str(out)]
        program = [*command("phone.phone_command"), *place]
        with subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            self._process = psutil.Process(server.pid)
            try:
                asyncio.run(self._film(re.sub(r"\s", "", server.stdout.readline())))
            finally:
                server.send_signal(signal.SIGINT)
        with av.open(str(out / "film" / "film.mp4")) as film:
            self.received = sum(1 for _ in film.decode(video=0))
        return json.loads((out / "film" / "run" / "report.json").read_text())

    async def _film(self, address: str) -> None:
        """Enter with the token, send the video, and wait for the end of its run."""
        base = address.split("/?")[0]
        async with aiohttp.ClientSession(
            base, cookie_jar=aiohttp.CookieJar(unsafe=True), headers={"Origin": base},
            timeout=aiohttp.ClientTimeout(), read_bufsize=1 << 22, raise_for_status=True,
        ) as client:  # fmt: skip
            await client.get(address)
            note = {"name": "film", "type": "video/mp4", "size": None}
            path = f"/films/{(await (await client.post('/films', json=note)).json())['film']}"
            await asyncio.gather(self._send(client, path), self._listen(client, path))

    async def _send(self, client: aiohttp.ClientSession, path: str) -> None:
        """Send each piece once it is filmed; where the connection breaks, go on from there."""
        content, began, offset, end = b"".join(self.pieces), time.perf_counter(), 0, 0
        broken = [round(share * len(self.pieces)) for share in BREAKS]
        for number, piece in enumerate(self.pieces):
            end += len(piece)
            filmed_at = began + (number + 1) * FRAMES_PER_PIECE / FPS
            await asyncio.sleep(max(0.0, filmed_at - time.perf_counter()))
            if number in broken:
                half, length = (
                    break_halfway(content[offset:end]),
                    {"Content-Length": str(end - offset)},
                )
                with suppress(aiohttp.ClientError, OSError):
                    await client.put(f"{path}?offset={offset}", data=half, headers=length)
                    raise AssertionError("the connection did not break")
                self.breaks += 1
                offset = (await (await client.get(path)).json())["next"]
            answer = await client.put(f"{path}?offset={offset}", data=content[offset:end])
            offset = (await answer.json())["next"]
            self.arrived_at += [time.perf_counter()] * FRAMES_PER_PIECE
        self.last_core_s, self.tracked = self._core_s(), len(self.delays_s["seconds"])
        await client.post(f"{path}/end?size={len(content)}")

    async def _listen(self, client: aiohttp.ClientSession, path: str) -> None:
        """Time the messages until the run is over."""
        kind = ""
        async for line in (await client.get(f"{path}/messages")).content:
            name, _, text = line.decode().strip().partition(": ")
            kind = text if name == "event" else kind
            if name != "data":
                continue
            now, message = time.perf_counter(), json.loads(text)
            assert kind != "failed", message["text"]
            if kind == "avatar" and np.isnan(self.played_after_s):
                self.played_after_s = now - self.arrived_at[-1]
                self.played_core_s = self._core_s() - self.last_core_s
            elif kind in self.delays_s:
                frame = round(message["time" if kind == "advice" else "seconds"] * FPS)
                arrived = self.arrived_at[frame] if frame < len(self.arrived_at) else now
                self.delays_s[kind].append(now - arrived)
            elif kind == "over":
                return

    def _core_s(self) -> float:
        return sum(self._process.cpu_times()[:2])


async def break_halfway(content: bytes) -> AsyncIterator[bytes]:
    yield content[: len(content) // 2]
    raise ConnectionResetError


def measurements(
    phone: PhoneClient, capture: dict[str, Any], played: dict[str, Any] | None
) -> list[Measurement]:
    """The rows of issue 36 that need no browser."""
    sent, tracked = len(phone.arrived_at), phone.delays_s["seconds"]
    advice = ", ".join(f"{delay:.2f}" for delay in phone.delays_s["advice"])
    psnr, steps = capture["held_out"]["psnr"], capture["training"]["steps"]
    scored, least, more = "held-out PSNR, dB", "", ""
    quality = f"{psnr:.2f} of {capture['frames']['read']} frames, {steps} steps"
    if played is not None:
        file = played["held_out"]["psnr"], played["frames"]["read"], played["training"]["steps"]
        quality += "; file: {:.2f}, {}, {}".format(*file)
        scored, least, more = "held-out PSNR, above that of the file, dB", "≥ -0.5", "≥ 0"
        psnr -= file[0]
    memory = capture["training"]["peak_memory_mb"] / 1024.0
    rows = [
        ("from the last frame to a package, s", phone.played_after_s, "≤ 6", "≤ 3",
         f"{phone.played_core_s:.1f} core-s of ia-capture; until its page hears of it"),
        ("frames missing in the file received", sent - phone.received, "0", "",
         f"of {sent}; {phone.breaks} broken connections"),
        ("frames tracked, some of them after the last one", capture["frames"]["read"], "", "",
         f"of {sent}; {phone.tracked} before the last one came"),
        ("feedback after the frame came, median, s", np.median(tracked), "≤ 1", "≤ 0.3",
         f"of {len(tracked)} tracked; p95 {np.percentile(tracked, 95):.2f}; advice: {advice}"),
        (scored, psnr, least, more, quality),
        ("peak memory, GiB", memory, "≤ 2", "≤ 1.5", f"a video of {sent / FPS:g} s"),
    ]  # fmt: skip
    return [
        Measurement(
            name=name, value=float(value), required=least, stretch_goal=more, context=beside
        )
        for name, value, least, more, beside in rows
    ]


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.phone", description=__doc__)
