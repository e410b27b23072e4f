"""Arrays out of .npz archives, with a message for everything that can be wrong with the file."""

import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from capture.errors import InputError

MAX_UNPACKED_BYTES = 4 << 30
"""Archives that would unpack to more are refused."""


def read_npz(
    path: Path, keys: tuple[str, ...] | None = None
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """The arrays of an archive (only those of `keys` that it has, if given); never executes any.

    Raises:
        InputError: If the file is missing, damaged, too large, or holds pickled objects under a key
            that is asked for.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist (or is no file); an .npz archive was expected.")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_UNPACKED_BYTES:
            raise InputError(
                f"{path} unpacks to {size >> 20} MiB; more than {MAX_UNPACKED_BYTES >> 20} MiB are not read."
            )
        with np.load(path, allow_pickle=False) as archive:
            wanted = [key for key in (keys or archive.files) if key in archive.files]
            found = {key: archive[key] for key in wanted}
    except InputError:
        raise
    except Exception as cause:  # numpy reads headers as Python: damaged ones fail in any way
        raise InputError(
            f"{path} is no readable .npz of plain arrays ({cause}). "
            "Is the file complete, and written without pickled objects?"
        ) from cause
    return {key: array for key, array in found.items() if isinstance(array, np.ndarray)}
