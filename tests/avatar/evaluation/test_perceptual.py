"""LPIPS against torchmetrics' own forward, over stand-ins of the networks with random weights."""

import sys
import types

import numpy as np
import pytest
import torch
from torch import nn

from avatar.evaluation.perceptual import LPIPS_CONVENTIONS, Lpips, network_layers
from capture.input_error import InputError

package = pytest.importorskip("torchmetrics.functional.image.lpips")

FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder as torch's cache is: the features, and a classifier that is not needed."""
    folder = tmp_path_factory.mktemp("checkpoints")
    torch.manual_seed(0)
    for network, name in FILES.items():
        stored = network_layers(network).state_dict()
        content = {f"features.{key}": value for key, value in stored.items()}
        torch.save({**content, "classifier.6.bias": torch.zeros(1000)}, folder / name)
    return folder


@pytest.fixture(scope="module")
def lpips(weights):
    found = Lpips(tuple(LPIPS_CONVENTIONS), weights)
    assert found.unavailable is None
    assert FILES["alex"] in found.describe()
    return found


@pytest.fixture
def pair(rng):
    truth = rng.random((48, 40, 3)).astype(np.float32)
    return np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0.0, 1.0).astype(np.float32), truth


def torchvision_alexnet():
    """The listing in torchvision's alexnet.py."""
    return nn.Sequential(
        nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2), nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2), nn.Conv2d(64, 192, kernel_size=5, padding=2),
        nn.ReLU(), nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(192, 384, kernel_size=3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, kernel_size=3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, kernel_size=3, padding=1), nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
    )  # fmt: skip


def torchvision_vgg16():
    """The listing in torchvision's vgg.py, configuration D."""
    layers, channels = [], 3
    for wide in [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512,
                 "M"]:  # fmt: skip
        if wide == "M":
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(channels, wide, 3, padding=1), nn.ReLU()]
            channels = wide
    return nn.Sequential(*layers)


@pytest.mark.parametrize("convention", LPIPS_CONVENTIONS)
def test_values_are_those_of_the_packages_own_forward(
    lpips, weights, pair, convention, monkeypatch
):
    way = LPIPS_CONVENTIONS[convention]
    listings = {"alexnet": torchvision_alexnet, "vgg16": torchvision_vgg16}

    def trained(listing, file):
        model = types.SimpleNamespace(features=listing())
        stored = torch.load(weights / file, weights_only=True)
        model.features.load_state_dict(
            {key[9:]: value for key, value in stored.items() if key.startswith("features.")}
        )
        return model

    models = types.SimpleNamespace(
        alexnet=lambda weights: trained(listings["alexnet"], FILES["alex"]),
        vgg16=lambda weights: trained(listings["vgg16"], FILES["vgg"]),
    )
    vision = types.ModuleType("torchvision")
    vision.models = models
    monkeypatch.setitem(sys.modules, "torchvision", vision)
    monkeypatch.setattr(package, "_TORCHVISION_AVAILABLE", True)
    network = package._LPIPS(net=way.network, pnet_rand=True)
    image, truth = (torch.from_numpy(each).permute(2, 0, 1)[None] for each in pair)
    expected = float(network(image, truth, normalize=way.rescaled))
    assert expected > 0.0
    assert lpips.compare(*pair, convention) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("convention", LPIPS_CONVENTIONS)
def test_equal_images_have_no_distance_and_small_ones_none_at_all(lpips, pair, convention):
    image, truth = pair
    assert lpips.compare(truth, truth, convention) == 0.0
    assert np.isnan(lpips.compare(image[:16], truth[:16], convention))


def test_nothing_is_downloaded_and_what_lacks_is_named(weights, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", None)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    found = Lpips(tuple(LPIPS_CONVENTIONS))
    assert found.conventions == ()
    assert FILES["vgg"] in found.unavailable
    assert str(tmp_path / "checkpoints") in found.unavailable
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / FILES["alex"]).write_bytes((weights / FILES["alex"]).read_bytes())
    found = Lpips(tuple(LPIPS_CONVENTIONS))
    assert found.conventions == ("alex01", "alex")
    assert FILES["alex"] not in found.unavailable


def test_a_damaged_file_of_weights_is_refused(weights, tmp_path):
    (tmp_path / FILES["alex"]).write_bytes((weights / FILES["alex"]).read_bytes()[:1000])
    with pytest.raises(InputError, match="Fetch it again"):
        Lpips(("alex",), tmp_path)


def test_without_torchmetrics_the_extra_is_named(weights, monkeypatch):
    monkeypatch.setitem(sys.modules, "torchmetrics.functional.image", None)
    found = Lpips(("alex",), weights)
    assert found.conventions == ()
    assert "[lpips]" in found.unavailable
