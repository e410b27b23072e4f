"""LPIPS (Zhang et al. 2018) by torchmetrics, as published tables compute it.

torchmetrics ships the linear heads (13 kB). The networks below them, AlexNet and VGG-16 trained on
ImageNet, are files of torchvision that the user fetches; nothing is downloaded here. Their layers
are listed below because torchvision itself cannot be imported next to the CPU build of torch.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from capture.input_error import InputError

LpipsNetwork = Literal["alex", "vgg"]


@dataclass(frozen=True, kw_only=True)
class LpipsConvention:
    """One way in which published tables call LPIPS.

    Attributes:
        network: Network whose features are compared.
        label: Heading in tables: network, and range of the images that it is fed.
        rescaled: Whether images are rescaled to [-1, 1], for which the network was trained.
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
POOL_SIZE: dict[LpipsNetwork, int] = {"alex": 3, "vgg": 2}
ALEXNET_CONVOLUTIONS = (
    (64, 11, 4, 2),
    (192, 5, 1, 2),
    (384, 3, 1, 1),
    (256, 3, 1, 1),
    (256, 3, 1, 1),
)
"""Output channels, kernel size, stride and padding."""
VGG16_BLOCKS = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Output channels and number of 3 x 3 convolutions."""


def network_layers(network: LpipsNetwork) -> torch.nn.Sequential:
    """Return torchvision's `features` of AlexNet or VGG-16, untrained."""
    layers, channels = list[torch.nn.Module](), 3
    if network == "alex":
        blocks = [(wide,) for wide in ALEXNET_CONVOLUTIONS]
        pooled = (True, True, False, False, True)
    else:
        blocks = [((wide, 3, 1, 1),) * count for wide, count in VGG16_BLOCKS]
        pooled = (True,) * len(blocks)
    for block, pools in zip(blocks, pooled, strict=True):
        for wide, kernel, stride, padding in block:
            layers += [
                torch.nn.Conv2d(channels, wide, kernel, stride, padding),
                torch.nn.ReLU(inplace=False),
            ]
            channels = wide
        if pools:
            layers.append(torch.nn.MaxPool2d(POOL_SIZE[network], 2))
    return torch.nn.Sequential(*layers)


@final
class Lpips:
    """LPIPS in the conventions whose weights were found.

    Attributes:
        conventions: Names of the conventions that are measured.
        unavailable: Why others are not, in a sentence; None if all are.
        versions: What the values depend on: package, files of weights, and their checksums.
    """

    def __init__(self, wanted: Sequence[str], folder: Path | None = None) -> None:
        """Load the networks.

        Args:
            wanted: Names of `LPIPS_CONVENTIONS`.
            folder: Folder of torchvision's weights; None for torch's cache.

        Raises:
            InputError: If a file holds no such weights.
        """
        folder = Path(torch.hub.get_dir()) / "checkpoints" if folder is None else folder
        self.versions: dict[str, str] = {}
        self._networks: dict[str, Any] = {}
        self.unavailable = None
        lacking = list[LpipsNetwork]()
        networks: list[LpipsNetwork] = [LPIPS_CONVENTIONS[name].network for name in wanted]
        for network in dict.fromkeys(networks):
            file = folder / Path(WEIGHT_URLS[network]).name
            if not file.is_file():
                lacking.append(network)
                continue
            try:
                self._networks[network] = _load_network(network, file)
            except ImportError:
                self.unavailable = (
                    "LPIPS needs torchmetrics: pip install 'instant-avatar-stream[lpips]'."
                )
                break
            checksum = hashlib.sha256(file.read_bytes()).hexdigest()[:8]
            known = "" if checksum in file.name else ", which is not torchvision's file"
            self.versions[f"LPIPS {network}"] = f"{file.name}, SHA-256 {checksum}…{known}"
        if self._networks:
            self.versions = {"LPIPS": f"torchmetrics {version('torchmetrics')}"} | self.versions
        if lacking and self.unavailable is None:
            urls = " and ".join(WEIGHT_URLS[each] for each in lacking)
            self.unavailable = (
                f"LPIPS ({', '.join(lacking)}) was not measured: {folder} lacks the files of {urls}"
                ". Fetch them into that folder, or name another with --lpips-weights; this program "
                "downloads nothing."
            )
        self.conventions = tuple(
            name for name in wanted if LPIPS_CONVENTIONS[name].network in self._networks
        )

    def compare(
        self,
        image: Float32[np.ndarray, "height width 3"],
        truth: Float32[np.ndarray, "height width 3"],
        convention: str,
    ) -> float:
        """LPIPS of two whole images in [0, 1]; NaN of images below `MIN_SIDE_PX`."""
        compared = self._forward(image, truth, convention, by_pixel=False)
        return float("nan") if compared is None else float(compared.mean())

    def compare_within(
        self,
        image: Float32[np.ndarray, "height width 3"],
        truth: Float32[np.ndarray, "height width 3"],
        silhouette: Bool[np.ndarray, "height width"],
        convention: str,
    ) -> float:
        """Mean of LPIPS's map over a silhouette; NaN of none."""
        compared = self._forward(image, truth, convention, by_pixel=True)
        if compared is None or not silhouette.any():
            return float("nan")
        return float(compared[silhouette].mean())

    @torch.no_grad()
    def _forward(
        self,
        image: Float32[np.ndarray, "height width 3"],
        truth: Float32[np.ndarray, "height width 3"],
        convention: str,
        *,
        by_pixel: bool,
    ) -> Float[np.ndarray, "rows columns"] | None:
        if min(image.shape[:2]) < MIN_SIDE_PX:
            return None
        way = LPIPS_CONVENTIONS[convention]
        network = self._networks[way.network]
        network.spatial = by_pixel
        pair = (torch.from_numpy(each).permute(2, 0, 1)[None].float() for each in (image, truth))
        return network(*pair, normalize=way.rescaled)[0, 0].numpy()


def _load_network(network: LpipsNetwork, weights: Path) -> Any:
    """Return torchmetrics' LPIPS over a network's weights.

    Raises:
        ImportError: Without torchmetrics.
        InputError: If the file holds no such weights.
    """
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
