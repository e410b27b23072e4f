"""No command removes or changes a file that it did not write: not one byte, also when killed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from instant_avatar import batch, check, evaluate, export, ingest, play, sample, track

COMMANDS = {
    "ia-batch": batch, "ia-check": check, "ia-evaluate": evaluate, "ia-export": export,
    "ia-ingest": ingest, "ia-play": play, "ia-sample": sample, "ia-track": track,
}  # fmt: skip

OTHERS = (
    "poses.npz", "cameras.npz", "report.json", "report.html", "avatar.iavatar", "avatar.mp4",
    "checkpoint/state.pt", "checkpoint/step_100.ckpt", "video.mp4", "masks/0000.png",
    "images/0000.png", "cameras/01/intri.yml", "0000.png", "dance.npz", "truth/poses.npz",
    "mesh.glb", "clip.webm", "letter.txt", "runs/a.png", ".avatar.iavatar.swp", "grade.json",
    "skeleton.mp4", "sub/grade.json", "batch0/results.jsonl", "batch1/summary.html",
    "batch2/_failed/bad/a.txt", "batch3/_failed", "batch4/bad/b.txt", "_failed/capture/ingest.log",
)  # fmt: skip
"""Names of our own, and of others, that other people's files have."""


def contents(folder):
    """Every file below a folder, link or not, with what it holds; and every folder."""
    found = {path: None if path.is_dir() else path.read_bytes() for path in folder.rglob("*")}
    return {str(path.relative_to(folder)): content for path, content in found.items()}


def unchanged(before, folder):
    """Whether all that was there still is, byte for byte."""
    now = contents(folder)
    return {name: now.get(name, "gone") for name in before} == before


@pytest.fixture
def hoard(tmp_path) -> Path:
    """A folder full of other people's files."""
    folder = tmp_path / "hoard"
    for number, name in enumerate(OTHERS):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"mine %d" % number)
    return folder


@pytest.fixture
def package(run, tmp_path) -> Path:
    """A package away from its run."""
    shutil.copyfile(run / "avatar.iavatar", tmp_path / "mine.iavatar")
    return tmp_path / "mine.iavatar"


@pytest.fixture
def call_line(call):
    """Runs a command line in which places are written {so}."""

    def call_line(line, **places):
        program, *words = [word.format(**places) for word in line.split()]
        return call(COMMANDS[program], *words)

    return call_line


@pytest.mark.parametrize(
    "line",
    [
        "ia-ingest {film} --out {hoard}",
        "ia-ingest {film} --out {hoard} --overwrite",
        "ia-ingest {film} --out {hoard}/truth --resume",
        "ia-ingest {film} --out new --json {hoard}/report.json",
        "ia-sample {hoard} --overwrite",
        "ia-check {film} --fix {hoard}/masks",
        "ia-check {film} --sheet {hoard}/0000.png",
        "ia-check {film} --json {hoard}/report.json",
        "ia-play {package} --out {hoard}/images",
        "ia-play {package} --out {hoard}/clip.webm",
        "ia-play {hoard}/avatar.iavatar",
        "ia-play {package} --bench --json {hoard}/poses.npz",
        "ia-play {package} --web --out {hoard}/truth",
        "ia-export {run} --out {hoard}/avatar.iavatar",
        "ia-export {package} --to glb --out {hoard}/mesh.glb",
        "ia-evaluate {run} --json {hoard}/report.json",
        "ia-track {film} --out {hoard}/poses.npz --overwrite",
        "ia-track {film} --out {hoard}",
        "ia-batch {film} --out {hoard}",
        "ia-batch bad.mp4 --out {hoard}/batch0",
        "ia-batch bad.mp4 --out {hoard}/batch1",
        "ia-batch bad.mp4 --out {hoard}/batch2",
        "ia-batch bad.mp4 --out {hoard}/batch4",
    ],
)
def test_a_place_with_other_peoples_files_is_refused(
    line, hoard, film, run, package, call_line, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("export.player_page.runtime_files", dict)
    (tmp_path / "bad.mp4").write_text("no video")
    before = contents(tmp_path)
    call_line(line, film=film, hoard=hoard, run=run, package=package).refusal()
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "line",
    [
        "ia-ingest {capture} --out {capture} --overwrite",
        "ia-ingest .",
        "ia-track .",
        "ia-ingest {capture} --out {capture}/run",
        "ia-ingest {capture} --out {above} --overwrite",
        "ia-ingest {above}/film.mp4 --poses {capture}/poses.npz --out {capture} --overwrite",
        "ia-ingest {capture} --out new --json {capture}/poses.npz --overwrite",
        "ia-check {capture} --json {capture}/cameras.npz --overwrite",
        "ia-check {capture} --fix {capture}/mended",
        "ia-play {package} --background {capture}/masks/0001.png --out {capture}/masks/0001.png"
        " --overwrite",
        "ia-play {package} --bench --json {package} --overwrite",
        "ia-export {package} --to ply --out {package} --overwrite",
        "ia-evaluate {run} --on {capture} --json {capture}/poses.npz --overwrite",
        "ia-track {capture} --out {capture}/sub/new.npz",
        "ia-track {above}/film.mp4 --body {above}/body.npz --out {above}/body.npz --overwrite",
        "ia-track {above}/film.mp4 --out {run}/poses.npz",
        "ia-batch {capture} --out {capture}/runs",
        "ia-batch {capture} --out {above}",
        "ia-batch {above}/film.mp4 --out {capture}/masks -- --masks {capture}/masks",
    ],
)
def test_no_command_writes_over_what_it_reads(
    line, capture, run, package, call_line, tmp_path, monkeypatch
):
    monkeypatch.chdir(capture)
    os.link(capture / "video.mp4", tmp_path / "film.mp4")
    (tmp_path / "body.npz").write_text("mine")
    before = contents(tmp_path)
    call_line(line, capture=capture, above=tmp_path, run=run, package=package).refusal()
    assert contents(tmp_path) == before


@pytest.mark.slow
def test_what_is_written_beside_other_peoples_files_leaves_them(
    hoard, film, package, call_line, monkeypatch
):
    before = contents(hoard)
    monkeypatch.chdir(hoard)
    for line, made in (
        ("ia-play {package} --out new.png --size 32", "new.png"),
        ("ia-play {package} --verify --json verdict.json", "verdict.json"),
        ("ia-export {package} --to ply --out new.ply", "new.ply"),
        ("ia-check {film} --json found.json", "runs/capture-check.png"),
        ("ia-check {film} --json found.json --overwrite", "found.json"),
        ("ia-sample new --frames 1 --size 16", "new/video.mp4"),
        ("ia-sample new --frames 1 --size 16 --overwrite", "new/poses.npz"),
    ):
        ended = call_line(line, film=film, package=package)
        assert ended.code == 0, ended.err
        assert (hoard / made).is_file()
        assert unchanged(before, hoard), line
    (hoard / "new" / "letter.txt").write_text("mine")
    before = contents(hoard)
    call_line("ia-sample new --frames 1 --size 16 --overwrite").refusal()
    assert contents(hoard) == before


KILLED = """
import os, shutil, signal, sys
from pathlib import Path

from instant_avatar.cli.console import Console
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.track import claim_outputs
from capture.atomic_files import atomic_file, atomic_folder, write_text_atomically

EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link"}
folder, left = Path(sys.argv[1]), -1
run = RunFolder(path=folder / "run")

def count(event, arguments):
    global left
    if left >= 0 and event in EVENTS and str(folder) in str(arguments):
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

def start():
    run.check_usable([], resume=False, overwrite=True)
    run.start_run(resume=False)

def work():
    with run.claim(Console(), resume=False, overwrite=True):
        start()
        for _ in range(2):
            write_text_atomically(run.checkpoint / "state.pt", "learnt")
        write_text_atomically(run.report_json, "{}")
    with claim_outputs(folder, Console()):
        for _ in range(2):
            with atomic_folder(folder / "masks") as part:
                (part / "000000.png").write_bytes(b"new")
        write_text_atomically(folder / "grade.json", "{}")

def check(events):
    for file in mine:
        assert file.read_bytes() == b"mine", (events, file)
    for path, whole in (
        (run.checkpoint / "state.pt", b"learnt"), (run.report_json, b"{}"),
        (folder / "masks" / "000000.png", b"new"), (folder / "grade.json", b"{}"),
    ):
        assert not path.exists() or path.read_bytes() == whole, (events, path)

sys.addaudithook(count)
mine = [folder / name for name in ("letter.txt", ".a.1234.part/letter.txt", "0000.png")]
mine += [run.path / "notes.txt", run.checkpoint / "step_100.ckpt"]
start()
for file in mine:
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(b"mine")
before = shutil.copytree(folder, folder.with_name("before"))
events = 0
while True:
    child = os.fork()
    if child == 0:
        left = events
        work()
        os._exit(0)
    killed = os.waitpid(child, 0)[1] != 0
    check(events)
    work()
    check(events)
    rest = {p for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".instant")}
    assert len(rest) == len(mine) + 4, (events, rest)
    if not killed:
        break
    shutil.rmtree(folder)
    shutil.copytree(before, folder)
    events += 1
print(events)
"""
"""What commands write, by a process that is killed at each of its operations on files in turn."""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_wherever_a_command_is_killed_other_peoples_files_stay_and_ours_are_whole(tmp_path):
    command = [sys.executable, "-c", KILLED, str(tmp_path / "work")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 60
