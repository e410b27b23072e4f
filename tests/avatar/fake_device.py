"""A fake torch device: the CPU under another name, on which mixing devices raises.

A tensor on it computes what a CPU tensor computes but reports another device. As on a GPU, an
operation on tensors of two devices raises, as do a generator of the wrong device and a conversion
to numpy. A machine without a GPU can so test that the code runs on any torch device.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch
from torch.overrides import TorchFunctionMode
from torch.utils import _foreach_utils
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

FAKE_DEVICE = torch.device("meta")
"""The borrowed device name: every torch knows it, and no code under test uses it."""
COPIES = (torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default)
LOOKUPS = ("aten::index", "aten::index_put_", "aten::_index_put_impl_", "aten::index_put")


class DeviceMixUpError(RuntimeError):
    """Raised where a GPU would raise."""


class FakeDeviceTensor(torch.Tensor):
    """A CPU tensor that reports the fake device."""

    @staticmethod
    def __new__(cls, here: torch.Tensor):
        return torch.Tensor._make_wrapper_subclass(
            cls, here.shape, strides=here.stride(), storage_offset=here.storage_offset(),
            dtype=here.dtype, device=FAKE_DEVICE, requires_grad=here.requires_grad,
        )  # fmt: skip

    def __init__(self, here: torch.Tensor) -> None:
        self.here = here

    def __repr__(self, **_) -> str:
        return f"FakeDeviceTensor({self.here!r})"

    def __reduce_ex__(self, protocol):  # as a GPU's tensor does with map_location="cpu"
        return self.here.detach().__reduce_ex__(protocol)

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})


def computed(func, args, kwargs):
    """Runs an operation on the CPU and puts its result on the device a GPU would put it on."""
    _refuse_mixtures(func, args, kwargs)
    leaves = tree_leaves((args, kwargs))
    device = kwargs.get("device")
    named = torch.device(device) if device is not None else None
    is_there = any(isinstance(leaf, FakeDeviceTensor) for leaf in leaves)
    if named is not None:
        is_there = named == FAKE_DEVICE
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if func is torch.ops.aten.copy_.default:
        is_there = isinstance(args[0], FakeDeviceTensor)

    def here(leaf):
        return leaf.here if isinstance(leaf, FakeDeviceTensor) else leaf

    result = func(*tree_map(here, args), **tree_map(here, kwargs))
    if not is_there:
        return result
    moved = tree_map(
        lambda leaf: FakeDeviceTensor(leaf) if type(leaf) is torch.Tensor else leaf, result
    )
    if func in COPIES or named is not None:
        return args[0] if func is torch.ops.aten.copy_.default else moved
    return return_and_correct_aliasing(func, args, kwargs, moved)


def _refuse_mixtures(func, args, kwargs) -> None:
    """Raises as torch does: only scalars and indices may come from the CPU."""
    if func in COPIES:
        return
    tensors = [
        leaf
        for leaf in tree_leaves((args[:1] if func._schema.name in LOOKUPS else args, kwargs))
        if isinstance(leaf, torch.Tensor)
    ]
    places = {tensor.device for tensor in tensors if tensor.dim()}
    if kwargs.get("device") is not None:
        places.add(torch.device(kwargs["device"]))
    if len(places) > 1:
        shapes = [tuple(tensor.shape) for tensor in tensors if tensor.device != FAKE_DEVICE]
        raise DeviceMixUpError(f"{func} mixes CPU tensors of shapes {shapes} with the fake device")


class Generator(torch.Generator):
    """A generator that reports the device it was made for."""

    def __new__(cls, device="cpu"):
        made = super().__new__(cls, device="cpu")
        made.place = torch.device(device)
        return made

    @property
    def device(self) -> torch.device:
        return self.place


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Handles what never reaches an operation: literals, generators and numpy conversions."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.tensor and torch.device(kwargs.get("device") or "cpu") == FAKE_DEVICE:
            return func(*args, **{**kwargs, "device": "cpu"}).to(FAKE_DEVICE)
        if func is torch.Tensor.new_tensor and isinstance(args[0], FakeDeviceTensor):
            return torch.tensor(args[1], dtype=args[0].dtype).to(FAKE_DEVICE)
        generator = kwargs.get("generator")
        if generator is not None:
            tensors = [leaf for leaf in tree_leaves(args) if isinstance(leaf, torch.Tensor)]
            place = tensors[0].device if tensors else torch.device(kwargs.get("device") or "cpu")
            if place != generator.device:
                raise DeviceMixUpError(
                    f"{func} draws on {place} from a generator of {generator.device}"
                )
        if func is torch.Tensor.numpy and isinstance(args[0], FakeDeviceTensor):
            raise DeviceMixUpError("numpy cannot read a tensor on the fake device")
        if func is torch.Tensor.__getitem__ and isinstance(args[1], list):
            return func(args[0], torch.tensor(args[1]))
        if func is torch.Tensor.tolist and isinstance(args[0], FakeDeviceTensor):
            return args[0].here.tolist()
        return func(*args, **kwargs)


@contextmanager
def fake_device() -> Iterator[torch.device]:
    """Makes the fake device usable inside the block."""
    fused = _foreach_utils._get_fused_kernels_supported_devices

    def supported() -> list[str]:
        return [*fused(), FAKE_DEVICE.type]

    with (
        mock.patch.object(torch, "Generator", Generator),
        mock.patch("torch.optim.optimizer._get_fused_kernels_supported_devices", supported),
        _Functions(),
        _Operations(),
    ):
        yield FAKE_DEVICE
