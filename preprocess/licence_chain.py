"""What an avatar is made with, and whether that allows commercial use.

Each of a capture's parts (poses, body, masks) was made by a program or a model; the table says what
its licence allows. The strictest part decides, and what is not known is not guessed. The rights of
the person and of the recording come on top; this is no legal advice.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from preprocess.body.body_pose import Motion
from preprocess.capture_session import Capture
from preprocess.plugins import DEFAULT_TRACKER

CommercialUse = Literal["yes", "no", "unknown"]


class Licence(NamedTuple):
    """A program or model as people name it, its licence, and whether that allows commercial use."""

    name: str
    licence: str
    commercial_use: CommercialUse


SMPL_LICENCE = "SMPL's licence, for non-commercial research"
LICENCES = {
    DEFAULT_TRACKER: Licence("BlazePose, the built-in tracker", "Apache-2.0", "yes"),
    "body24": Licence("the embedded body, of MakeHuman's data", "CC0", "yes"),
    "smpl": Licence("an SMPL model file", SMPL_LICENCE, "no"),
    "SAM 3D Body": Licence("SAM 3D Body", "SAM License", "yes"),
    "GEM-X": Licence("GEM-X", "NVIDIA Open Model License", "yes"),
    **{
        program: Licence(f"{program}, poses of SMPL", SMPL_LICENCE, "no")
        for program in ("PHALP (4D-Humans)", "WHAM", "VIBE", "GVHMR", "PromptHMR", "TRAM",
                        "ROMP or BEV", "SLAHMR or 3DPW", "AMASS or AIST++")
    },
}  # fmt: skip
"""Programs as `Motion.program` names them, and families of bodies."""


def made_with(capture: Capture) -> list[dict[str, str]]:
    """The parts of a capture: {part, name, licence, commercial_use} each."""
    motion, body = capture.motion, capture.shaped.body.family
    parts = {
        "poses": _known(motion.program, f"{capture.paths.poses.name} of unknown origin"),
        "body": _known(body, f"a body file of the family {body}"),
        "masks": _mask_licence(capture, motion),
    }
    return [{"part": part, **made._asdict()} for part, made in parts.items()]


def _known(program: str | None, otherwise: str) -> Licence:
    return LICENCES.get(program or "", Licence(program or otherwise, "unknown", "unknown"))


def _mask_licence(capture: Capture, motion: Motion) -> Licence:
    masks, files = capture.masks.origin, capture.paths
    beside = files.masks is not None and files.masks.parent == files.poses.parent
    if masks == "tracked" or (beside and motion.is_fitted):  # by the tracker of the poses
        return _known(motion.program, f"{masks} of unknown origin")
    if masks == "estimated by BlazePose":
        return LICENCES[DEFAULT_TRACKER]
    return Licence(f"masks of unknown origin ({masks})", "unknown", "unknown")


def licence_chain(parts: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    """What all parts of an avatar allow: {commercial_use, because, parts, summary for people}."""
    worst = next((use for use in ("no", "unknown") if _with(parts, use)), "yes")
    worst = worst if parts else "unknown"
    if worst == "yes":
        because = "all that it was made with allows it"
    elif not parts:
        because = "it was made before this was recorded"
    else:
        because = "; ".join(
            f"{part['part']}: {part['name']}"
            + ("" if worst == "unknown" else f" ({part['licence']})")
            for part in _with(parts, worst)
        )
    made = "; ".join(f"{part['part']}: {part['name']} ({part['licence']})" for part in parts)
    allowed = f"Commercial use: {worst}, because {because}."
    return {
        "commercial_use": worst,
        "because": because,
        "parts": [dict(part) for part in parts],
        "summary": f"Made with {made}. {allowed}" if made else allowed,
    }


def _with(parts: Sequence[Mapping[str, str]], use: str) -> list[Mapping[str, str]]:
    return [part for part in parts if part["commercial_use"] == use]
