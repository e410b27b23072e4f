"""Tensors on disk, whole or not at all."""

from pathlib import Path
from typing import Any

import torch

from capture.atomic_files import atomic_file


def save_atomically(state: dict[str, Any], path: Path) -> None:
    """Writes plain data and tensors as a file that appears whole or not at all.

    Raises:
        InputError: If the folder's list says that the file there is not ours.
        OSError: If the disk is full, or the folder cannot be written; what was there before stays.
    """
    try:
        with atomic_file(path) as part, part.open("wb") as file:
            torch.save(state, file)
    except RuntimeError as error:  # torch stumbles once more after the disk has failed
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise
