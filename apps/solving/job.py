"""What the solving process is to do, and the folder that belongs to exactly that."""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from apps.recording.wanted import CaptureInputs

METHOD_VERSION = 3
"""Of the method: other numbers would come out of the same pictures."""


@dataclass(frozen=True, kw_only=True)
class SolveJob:
    """A capture and what its solution depends on.

    Attributes:
        paths: What the user named.
        seed: Of everything random.
        threads: Of features and matches; the result does not depend on it.
    """

    paths: CaptureInputs
    seed: int
    threads: int

    def folder(self, run: Path) -> Path:
        """Where this very job's stages lie; other files or options have another place."""
        return run / "cameras" / self.key()

    def key(self) -> str:
        """A hash of the options, and of the files' names, sizes and times."""
        content = self.as_json()
        content.pop("threads")
        files = [self.paths.video, self.paths.poses, self.paths.masks, self.paths.body]
        state = [_file_state(path) for path in files if path is not None]
        text = json.dumps([METHOD_VERSION, content, state], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def as_json(self) -> dict[str, Any]:
        """As JSON."""
        paths = asdict(self.paths)
        frames = self.paths.frames
        paths["frames"] = None if frames is None else [frames.start, frames.stop, frames.step]
        for name in ("video", "poses", "masks", "body"):
            if paths[name] is not None:
                paths[name] = str(paths[name])
        return {"paths": paths, "seed": self.seed, "threads": self.threads}

    @classmethod
    def of(cls, content: dict[str, Any]) -> "SolveJob":
        """From what `content` gave."""
        paths = dict(content["paths"])
        frames = paths["frames"]
        paths["frames"] = None if frames is None else slice(*frames)
        for name in ("video", "poses", "masks", "body"):
            if paths[name] is not None:
                paths[name] = Path(paths[name])
        return cls(paths=CaptureInputs(**paths), seed=content["seed"], threads=content["threads"])

    def absolute(self) -> "SolveJob":
        """The same for a process that runs in another folder."""
        named = self.paths
        masks = named.masks
        if masks is not None and masks.exists():  # else the name of a segmenter
            masks = masks.resolve()
        return replace(
            self,
            paths=replace(
                named,
                video=named.video.resolve(),
                poses=None if named.poses is None else named.poses.resolve(),
                masks=masks,
                body=None if named.body is None else named.body.resolve(),
            ),
        )


def _file_state(path: Path) -> list[Any]:
    """By which a changed file or folder is known."""
    if not path.exists():
        return [str(path)]
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    listed = [(str(file), (stat := file.stat()).st_size, stat.st_mtime_ns) for file in files]
    return [hashlib.sha256(repr(listed).encode()).hexdigest()]
