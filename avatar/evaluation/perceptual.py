"""LPIPS (Zhang et al. 2018) by torchmetrics, as published tables compute it.

torchmetrics ships the linear heads (13 kB). The networks below them, AlexNet and VGG-16 trained on
ImageNet, are files of torchvision that the user fetches; nothing is downloaded here. Their layers
are listed below because torchvision itself cannot be imported next to the CPU build of torch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import torch
from jaxtyping import Float32

from capture.input_error import InputError, install_command

LpipsNetwork = Literal["alex", "vgg"]


@dataclass(frozen=True, kw_only=True)
class LpipsConvention:
    """One way in which published tables call LPIPS.

    `label` heads a table: the network, and the range of the images that it is fed. `rescaled`
    brings images to [-1, 1], for which the network was trained.
    """

    network: LpipsNetwork
    label: str
    rescaled: bool


LPIPS_CONVENTIONS = {
    "alex01": LpipsConvention(network="alex", label="LPIPS Alex [0,1]", rescaled=False),
    "alex": LpipsConvention(network="alex", label="LPIPS Alex [-1,1]", rescaled=True),
    "vgg": LpipsConvention(network="vgg", label="LPIPS VGG [-1,1]", rescaled=True),
}
"""Conventions by name: of PeopleSnapshot's tables, of NeuMan's, and of ZJU-MoCap's."""
WEIGHT_URLS: dict[LpipsNetwork, str] = {
    "alex": "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    "vgg": "https://download.pytorch.org/models/vgg16-397923af.pth",
}
"""torchvision's files of the networks (IMAGENET1K_V1); their names end with their checksums."""
MIN_SIDE_PX = 32
"""Smaller images leave nothing after the networks' poolings."""
LAYERS: dict[LpipsNetwork, tuple[tuple[int, int, int, int] | int, ...]] = {
    "alex": (
        (64, 11, 4, 2), 3, (192, 5, 1, 2), 3,
        (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1), 3,
    ),
    "vgg": tuple(
        layer
        for channels, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
        for layer in (*((channels, 3, 1, 1),) * count, 2)
    ),
}  # fmt: skip
"""Convolutions (output channels, kernel size, stride, padding), and kernel sizes of poolings."""


def network_layers(network: LpipsNetwork) -> torch.nn.Sequential:
    """Return torchvision's `features` of AlexNet or VGG-16, untrained."""
    layers, channels = list[torch.nn.Module](), 3
    for layer in LAYERS[network]:
        if isinstance(layer, int):
            layers.append(torch.nn.MaxPool2d(layer, 2))
        else:
            layers += [torch.nn.Conv2d(channels, *layer), torch.nn.ReLU(inplace=False)]
            channels = layer[0]
    return torch.nn.Sequential(*layers)


@final
class Lpips:
    """LPIPS in the `conventions` whose weights were found.

    `unavailable` says in a sentence why others are not measured; None if all are.
    """

    def __init__(self, wanted: Sequence[str], folder: Path | None = None) -> None:
        """Load the networks of `wanted` conventions from `folder`; None is torch's cache."""
        folder = Path(torch.hub.get_dir()) / "checkpoints" if folder is None else folder
        networks: list[LpipsNetwork] = [LPIPS_CONVENTIONS[name].network for name in wanted]
        files: dict[LpipsNetwork, Path] = {
            network: folder / Path(WEIGHT_URLS[network]).name for network in networks
        }
        missing: list[LpipsNetwork] = [
            network for network, file in files.items() if not file.is_file()
        ]
        self._networks: dict[LpipsNetwork, Any] = {}
        self.unavailable = None
        if missing:
            self.unavailable = (
                f"LPIPS ({', '.join(missing)}) was not measured: {folder} lacks the files of "
                f"{' and '.join(WEIGHT_URLS[each] for each in missing)}. Fetch them into that "
                "folder, or name another with --lpips-weights; this program downloads nothing."
            )
        try:
            self._networks = {
                network: _load_network(network, file)
                for network, file in files.items()
                if network not in missing
            }
        except ImportError:
            self.unavailable = f"LPIPS needs torchmetrics: {install_command('lpips')}"
        self.conventions = tuple(
            name for name in wanted if LPIPS_CONVENTIONS[name].network in self._networks
        )

    def describe(self) -> str:
        """Name the package and the files of weights that values depend on, or what is missing."""
        if not self._networks:
            return self.unavailable or "not requested"
        files = ", ".join(Path(WEIGHT_URLS[network]).name for network in self._networks)
        return f"torchmetrics {version('torchmetrics')}, {files}"

    @torch.no_grad()
    def compare(
        self,
        image: Float32[np.ndarray, "height width 3"],
        truth: Float32[np.ndarray, "height width 3"],
        convention: str,
    ) -> float:
        """LPIPS of two images in [0, 1]; NaN of images below `MIN_SIDE_PX`."""
        if min(image.shape[:2]) < MIN_SIDE_PX:
            return float("nan")
        way = LPIPS_CONVENTIONS[convention]
        pair = (torch.from_numpy(each).permute(2, 0, 1)[None].float() for each in (image, truth))
        return float(self._networks[way.network](*pair, normalize=way.rescaled))


def _load_network(network: LpipsNetwork, weights: Path) -> Any:
    """Return torchmetrics' LPIPS over a network's weights; ImportError without torchmetrics."""
    from torchmetrics.functional.image import lpips as package

    features = network_layers(network)
    try:
        stored = torch.load(weights, map_location="cpu", weights_only=True)
        prefix = "features."
        features.load_state_dict(
            {key.removeprefix(prefix): value for key, value in stored.items() if prefix in key}
        )
    except Exception as cause:  # torch raises anything for damaged files
        raise InputError(
            f"{weights} holds no weights of {network} as torchvision writes them "
            f"({type(cause).__name__}). Fetch it again: {WEIGHT_URLS[network]}"
        ) from cause
    original = package._get_tv_model_features
    package._get_tv_model_features = lambda *_: features  # else torchvision would be imported
    try:
        return package._LPIPS(net=network, pnet_rand=True)
    finally:
        package._get_tv_model_features = original
