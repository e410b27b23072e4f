"""Packages that an installation may lack, and the command that brings each."""

from apps.terminal.command_line import DISTRIBUTION

LEARN_PACKAGES = frozenset({"torch", "numba", "onnx"})
"""What the extra [learn] brings besides `SMALL`: hundreds of megabytes that a player is spared."""
SMALL_PACKAGES = frozenset({"trimesh", "pycolmap"})
"""What it brings, too, but is soon installed alone."""


def install_advice(error: ModuleNotFoundError) -> str | None:
    """Say what to install for a package that is missing; None if the module is our own mistake.

    Args:
        error: What an import raised.
    """
    package = (error.name or "").split(".")[0]
    if package in LEARN_PACKAGES:
        return (
            f"{package} is not installed here: this is an installation that plays avatars, checks "
            "captures and exports meshes, but does not learn. For the rest: "
            f"pip install '{DISTRIBUTION}[learn]'"
        )
    if package in SMALL_PACKAGES:
        return f"{package} is not installed here. Install it: pip install {package}"
    return None
