"""Where a run lies on disk, and whether there is one already."""

import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from apps.terminal.whole import check_place
from capture.errors import BadInput


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """A folder that holds one run of ia-ingest.

    Attributes:
        path: The folder.
    """

    path: Path

    @property
    def package(self) -> Path:
        """The avatar."""
        return self.path / "avatar.iavatar"

    @property
    def report(self) -> Path:
        """What was done and how well, as JSON."""
        return self.path / "report.json"

    @property
    def page(self) -> Path:
        """The same to look at."""
        return self.path / "report.html"

    @property
    def checkpoint(self) -> Path:
        """The folder from which training can go on."""
        return self.path / "checkpoint"

    @property
    def person(self) -> Path:
        """The body that the avatar has, for videos that are added later."""
        return self.checkpoint / "person.npz"

    @property
    def cameras(self) -> Path:
        """Cameras that were solved here; the folder of the same name without ending made them."""
        return self.path / "cameras.npz"

    @property
    def poses(self) -> Path:
        """The poses in the world of the solved cameras."""
        return self.path / "poses.npz"

    def holds_a_run(self) -> bool:
        """Whether any part of a run is there."""
        return any(p.exists() for p in (self.package, self.report, self.page, self.checkpoint))

    def has_checkpoint(self) -> bool:
        """Whether training can go on from here."""
        return self.checkpoint.is_dir() and any(self.checkpoint.glob("*.pt"))

    def check(self, *, resume: bool, overwrite: bool) -> None:
        """Whether a run may be written here.

        Raises:
            BadInput: If the path is no folder, or another run would be lost.
        """
        if resume and overwrite:
            raise BadInput("--resume goes on with a run, --overwrite removes it: give one of them.")
        if self.path.exists() and not self.path.is_dir():
            raise BadInput(f"{self.path} is a file; --out names the folder that holds the run.")
        check_place(self.path, "--out")
        if self.holds_a_run() and not (resume or overwrite):
            raise BadInput(
                f"{self.path} already holds a run. Go on with it (--resume), replace it "
                "(--overwrite), or name another folder (--out)."
            )

    def begin(self, *, resume: bool) -> None:
        """Makes the folder; unless the run is resumed, an older run in it is removed.

        Call it when nothing can be wrong with the input any more.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        for half in self.path.glob(f".{self.package.name}.*"):  # of a run that was killed
            half.unlink(missing_ok=True)
        if resume:
            return
        for file in (self.package, self.report, self.page, self.cameras, self.poses):
            file.unlink(missing_ok=True)
        if self.checkpoint.is_dir():
            shutil.rmtree(self.checkpoint)

    def what_is_kept(self) -> str:
        """What is there after a run has failed half-way, and what a user can do."""
        files = (self.package, self.report, self.page, self.cameras, self.poses)
        names = [path.name for path in files if path.exists()]
        there = f"{self.path} holds {', '.join(names)}." if names else ""
        if not self.has_checkpoint() and self.package.exists():
            return f"{there} Without a checkpoint the avatar can be played, but not learnt on."
        if not self.has_checkpoint():
            return there or f"Nothing was written to {self.path}."
        return (
            f"{there} The newest checkpoint is kept in {self.checkpoint}: run the same command "
            "with --resume, in place of any --overwrite, to go on from it."
        ).lstrip()

    def tidy(self) -> None:
        """Removes folders that nothing was written to."""
        for folder in (self.checkpoint, self.path):
            with suppress(OSError):  # it is not empty, or not there
                folder.rmdir()
