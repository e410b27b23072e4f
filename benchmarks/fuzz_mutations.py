"""Whole files made into damaged, hostile and random ones."""

import hashlib
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

ZIPS = (".npz", ".pt", ".r3d", ".iavatar")
"""Endings of files that are zip archives."""

PICKLE_CALLS = (
    b"cos\nsystem\n(S'true'\ntR", b"cbuiltins\neval\n(S'1'\ntR", b"(S'true'\nios\nsystem\n",
    b"\x8c\x02os\x8c\x06system\x93", b"cnumpy\nload\n", b"cbuiltins\nset\n", b"c__main__\nx\n",
)  # fmt: skip
"""Pieces of pickles that call something."""

MUTATION_WEIGHTS = (0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4, 4, 5, 6, 6, 7)
"""How often each thing is done to a file: mostly a byte is changed, so that most of it is read."""

STRANGE_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1 << 62, 1e308, float("nan"), float("inf"), "", "../../etc/passwd", [], {},
    [[]], [0.0] * 9, "x" * 3000,
)  # fmt: skip
"""What stands in place of a value of JSON."""


def mutate_file(whole: bytes, name: str, others: list[bytes], rng: np.random.Generator) -> bytes:
    """One file made hostile, as its kind allows."""
    ending = Path(name).suffix
    if ending == ".iavatar":
        return mutate_package(whole, rng)
    if ending in ZIPS and whole.startswith(b"PK") and rng.random() < 0.7:
        return mutate_zip(whole, rng)
    if ending == ".json" and rng.random() < 0.7:
        return mutate_json(whole, rng)
    if ending == ".pkl" and rng.random() < 0.15:
        return random_opcodes(rng)
    return mutate_bytes(whole, others, rng)


def mutate_package(whole: bytes, rng: np.random.Generator) -> bytes:
    """A package changed inside, or outside; mostly with sums that say it is right."""
    if rng.random() < 0.2:
        return mutate_bytes(whole, [whole], rng)
    data = mutate_zip(whole, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    try:
        manifest = json.loads(entries["manifest.json"])
        for name in manifest["sha256"]:
            manifest["sha256"][name] = hashlib.sha256(entries[name]).hexdigest()
    except (KeyError, TypeError, ValueError):
        return data
    entries["manifest.json"] = json.dumps(manifest).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return stream.getvalue()


def mutate_bytes(whole: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """A file with one to three things done to it, most of them small."""
    data = bytearray(whole)
    for _ in range(int(rng.integers(1, 3))):
        at, to = sorted(int(n) for n in rng.integers(0, max(len(data), 1), 2))
        to = to if rng.random() < 0.2 else min(to, at + 4)
        way = MUTATION_WEIGHTS[int(rng.integers(0, len(MUTATION_WEIGHTS)))]
        if way == 0:
            data[at : at + 1] = rng.bytes(1)
        elif way == 1:
            del data[at:to]
        elif way == 2:
            data[at:at] = data[at:to]
        elif way == 3:
            data[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif way == 4:
            data[at:at] = PICKLE_CALLS[int(rng.integers(0, len(PICKLE_CALLS)))]
        elif way == 5:
            other = others[int(rng.integers(0, len(others)))]
            data[at:to] = other[len(other) // 3 : len(other) // 2]
        elif way == 6:
            data[at : at + 8] = int(rng.integers(0, 1 << 62)).to_bytes(8, "little")
        else:
            data = data[: max(to, len(data) - 9, 1)]
    return bytes(data)


def mutate_zip(whole: bytes, rng: np.random.Generator) -> bytes:
    """An archive with one entry mutated inside, left out, or there twice; its sums are right."""
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        entries = [(info.filename, archive.read(info)) for info in archive.infolist()]
    chosen, way = int(rng.integers(0, len(entries))), rng.random()
    name, content = entries[chosen]
    if way < 0.1 and len(entries) > 1:
        del entries[chosen]
    elif way < 0.15:
        entries.append((f"../{name}", content))
    elif name.endswith(".json"):
        entries[chosen] = (name, mutate_json(content, rng))
    else:
        entries[chosen] = (name, mutate_bytes(content, [c for _, c in entries], rng))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return stream.getvalue()


def mutate_json(whole: bytes, rng: np.random.Generator) -> bytes:
    """JSON with one or two values exchanged for something strange, or left out."""
    content = json.loads(whole)
    for _ in range(int(rng.integers(1, 3))):
        places = list(_places(content))
        if not places:
            break
        parent, key = places[int(rng.integers(0, len(places)))]
        if rng.random() < 0.2:
            del parent[key]
        else:
            parent[key] = STRANGE_VALUES[int(rng.integers(0, len(STRANGE_VALUES)))]
    return json.dumps(content).encode()


def _places(content: Any) -> Any:
    """Every container of a JSON, with each of its keys."""
    keys = range(len(content)) if isinstance(content, list) else content
    for key in list(keys) if isinstance(content, list | dict) else ():
        yield content, key
        yield from _places(content[key])


def random_opcodes(rng: np.random.Generator) -> bytes:
    """A pickle of opcodes that come as they like."""
    opcodes = [bytes([code]) for code in pickle._Unpickler.dispatch]  # type: ignore[attr-defined]
    parts = [rng.bytes(int(rng.integers(0, 4))) for _ in range(40)]
    chosen = rng.integers(0, len(opcodes), 40)
    calls = [
        PICKLE_CALLS[int(n)] if n < len(PICKLE_CALLS) else b"" for n in rng.integers(0, 60, 40)
    ]
    mixed = (opcodes[c] + part + call for c, part, call in zip(chosen, parts, calls, strict=True))
    return b"\x80\x04" + b"".join(mixed) + b"."
