"""Ten thousand damaged, hostile and random files through every reader.

    python -m benchmarks.fuzz_readers [--files 10000] [--seed 0] [--package FILE | --no-packages]

Small whole files of each kind are made, and of these files with bytes changed, left out, exchanged,
calls of something put in; archives and packages changed inside, with sums that are right; JSON with
strange values; opcodes at random. Each is given to its reader in a process that notes whatever is
run, written or connected to. Asked: read or refused with a message that names the file, nothing
run, nothing that hangs or dies.
"""

import argparse
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from baselines.hardware import Hardware
from benchmarks.fuzz_mutations import mutate_file
from benchmarks.fuzz_seeds import make_seeds

FILES_PER_HUNDRED = {
    "pickles": 30, "poses": 25, "masks": 12, "cameras": 12, "bodies": 7, "captures": 6,
    "pictures": 5, "packages": 3,
}  # fmt: skip
"""Files of each reader, of a hundred."""
TIMEOUT_S = 60
"""Longest time that one file may take, seconds."""
RUNS = (
    "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.", "socket.",
    "webbrowser.",
)  # fmt: skip
CHANGES = ("os.remove", "os.rename", "os.rmdir", "shutil.")
WATCHED = RUNS + CHANGES

_seen: list[str] = []
_watched: tuple[str, ...] = ()


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watched:
        return
    writes = event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+")
    if event.startswith(_watched) or (writes and CHANGES[0] in _watched):
        _seen.append(f"{event} {arguments!r:.200}")


# --- files ---------------------------------------------------------------------------------------


def write_mutated_file(kind: str, seeds: Path, folder: Path, rng: np.random.Generator) -> Path:
    """Writes one; returns what its reader is given."""
    shutil.rmtree(folder, ignore_errors=True)
    places = sorted((seeds / kind).iterdir())
    chosen = places[int(rng.integers(0, len(places)))]
    target = folder / chosen.name
    if chosen.is_dir():
        shutil.copytree(chosen, target)
        files = sorted(file for file in target.rglob("*") if file.is_file())
        file = files[int(rng.integers(0, len(files)))]
    else:
        folder.mkdir()
        shutil.copy(chosen, target)
        file = target
    others = [other.read_bytes() for other in places if other.is_file()] or [b"PK"]
    file.write_bytes(mutate_file(file.read_bytes(), file.name, others, rng))
    return target


# --- readers -------------------------------------------------------------------------------------


def readers(seeds: Path) -> dict[str, Callable[[Path], object]]:
    """What each kind of file is read by, as the commands do."""
    from capture.source_opening import open_source
    from export.player import Player
    from instant_avatar.capture_validation import check_capture
    from preprocess.body.parametric_body import load_body_model, read_shaped_body
    from preprocess.cameras.camera_file import read_cameras
    from preprocess.capture_inputs import CaptureInputs
    from preprocess.file_content import read_untrusted_file
    from preprocess.masks.mask_files import open_masks, read_mask
    from preprocess.open_capture import open_capture, read_capture
    from preprocess.poses.pose_format_registry import read_poses

    embedded, film = load_body_model(), open_source(seeds / "captures" / "film")

    def bodies(path: Path) -> object:
        return read_shaped_body(path, embedded) if path.stem == "person" else load_body_model(path)

    def masks(path: Path) -> object:
        if path.suffix == ".png":
            return read_mask(path)
        found = open_masks(path)
        return [found.alpha(row, found.size_px) for row in range(found.count)]

    def captures(path: Path) -> object:
        if len(path.read_bytes() if path.is_file() else path.name) % 7 == 0:
            check_capture(read_capture(CaptureInputs(video=path)))
        recording = open_capture(CaptureInputs(video=path))
        return list(recording.observations())

    def pictures(path: Path) -> object:
        return list(open_source(path if path.suffix == ".mp4" else path.parent).frames())

    def packages(path: Path) -> object:
        player = Player.load(path)
        golden = player.manifest.golden[0]
        return player.render(golden.pose, golden.camera, size=32)

    def cameras(path: Path) -> object:
        return read_cameras(path, film.size_px, film)

    return {
        "pickles": read_untrusted_file, "poses": read_poses, "masks": masks, "cameras": cameras,
        "bodies": bodies, "captures": captures, "pictures": pictures, "packages": packages,
    }  # fmt: skip


def outcome(path: Path, read: Callable[[Path], object]) -> str:
    """How reading one file ended."""
    from capture.input_error import InputError

    global _watched
    _seen.clear()
    _watched = WATCHED
    try:
        read(path)
    except InputError as refusal:
        words, joined = str(refusal), path.is_dir()  # of what does not fit together, the parts
        named = joined or str(path.parent) in words or path.name in words
        ended = "refused" if named else f"nameless: {words}"
    except OSError as error:  # the commands say these, too
        ended = f"OSError {error}" if error.filename is None else "refused"
    except Exception as error:  # what this is about
        ended = f"{type(error).__name__} {error}"[:200]
    else:
        ended = "read"
    finally:
        _watched = ()
    return f"RAN {_seen[0]}" if _seen else ended


# --- the process that reads ----------------------------------------------------------------------


def batch(seeds: Path, start: int, stop: int, seed: int) -> None:
    """Reads some of the files, and says of each what came of it, a line of JSON."""
    reads = readers(seeds)
    kinds = [kind for kind, share in FILES_PER_HUNDRED.items() for _ in range(share)]
    kinds = [kind for kind in kinds if (seeds / kind).is_dir()]
    for kind, read in reads.items():  # whole files first: what is loaded late is loaded now
        for path in sorted((seeds / kind).iterdir()) if (seeds / kind).is_dir() else ():
            ended = outcome(path, read)
            assert ended == "read" or ended.startswith("RAN"), (path, ended)
    sys.addaudithook(_audit)
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(start, stop):
            rng = np.random.default_rng([seed, number])
            kind = kinds[int(rng.integers(0, len(kinds)))]
            path = write_mutated_file(kind, seeds, Path(scratch) / "file", rng)
            print(json.dumps({"number": number, "kind": kind}), flush=True)
            began = time.process_time()
            signal.alarm(TIMEOUT_S)
            ended = outcome(path, reads[kind])
            signal.alarm(0)
            told = {"ended": ended, "name": path.name, "seconds": time.process_time() - began}
            print(json.dumps(told), flush=True)


def batches(seeds: Path, files: int, seed: int) -> list[dict[str, Any]]:
    """All of them, in processes that may die."""
    found: list[dict[str, Any]] = []
    while len(found) < files:
        start, stop = len(found), min(files, len(found) + 1000)
        command = [sys.executable, "-m", "benchmarks.fuzz_readers", "--batch", str(seeds)]
        command += [str(start), str(stop), str(seed)]
        done = subprocess.run(command, capture_output=True, text=True)
        ours = (line for line in done.stdout.splitlines() if line.startswith(('{"num', '{"end')))
        lines = [json.loads(line) for line in ours]  # libraries print, too
        heads, ends = lines[::2], lines[1::2]
        found += [{**a, **b} for a, b in zip(heads, ends, strict=False)]
        if len(ends) < len(heads):  # it died of the last one
            last = done.stderr.strip().splitlines()[-1:] or [""]
            died = f"DIED {done.returncode} {last[0]}"
            found.append({**heads[-1], "ended": died, "seconds": 0.0, "name": ""})
        elif not heads or done.returncode:
            raise RuntimeError(done.stderr[-3000:])
    return found


def package_of(film: Path, scratch: Path) -> Path:
    """An avatar of the film, as small as one gets."""
    from instant_avatar import ingest

    run = scratch / "run"
    code = ingest.main([str(film), "--out", str(run), "--seconds", "6", "--threads", "1"])
    assert code == 0, "no avatar to begin with"
    return run / "avatar.iavatar"


def main() -> None:
    """The benchmark; exits with 1 if anything went wrong."""
    if sys.argv[1:2] == ["--batch"]:
        seeds, start, stop, seed = sys.argv[2:]
        batch(Path(seeds), int(start), int(stop), int(seed))
        return
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--files", type=int, default=10_000)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--package", type=Path, help="an avatar; without it one is learnt")
    arguments.add_argument("--no-packages", action="store_true")
    given = arguments.parse_args()
    print("\n".join(Hardware.here().lines()))
    with tempfile.TemporaryDirectory() as scratch:
        seeds = Path(scratch) / "seeds"
        make_seeds(seeds)
        if not given.no_packages:
            package = given.package or package_of(seeds / "captures" / "film", Path(scratch))
            (seeds / "packages").mkdir()
            shutil.copy(package, seeds / "packages" / "avatar.iavatar")
        found = batches(seeds, given.files, given.seed)
    sys.exit(0 if print_summary(found) else 1)


def print_summary(found: list[dict[str, Any]]) -> bool:
    """Prints a row for each reader and whatever went wrong; whether nothing did."""
    by_kind: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for each in found:
        by_kind[each["kind"]].append(each)
    for kind, files in [*by_kind.items(), ("all", found)]:
        ended = Counter(each["ended"] for each in files)
        slowest = max(files, key=lambda each: each["seconds"])
        print(
            f"{kind}: {len(files)} files, {ended['read']} read, {ended['refused']} refused; "
            f"{slowest['name']} took {slowest['seconds']:.1f} core-s"
        )
    wrong = [each for each in found if each["ended"] not in ("read", "refused")]
    for each in wrong[:60]:
        print(f"✗ {each['number']} {each['kind']}/{each['name']}: {each['ended']}")
    return not wrong


if __name__ == "__main__":
    main()
