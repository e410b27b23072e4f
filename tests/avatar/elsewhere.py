"""A device that no machine lacks: the CPU under another name, on which a mix-up shows.

A tensor "elsewhere" computes what a CPU tensor computes, but says it lies on another device; as on
a GPU an operation on tensors of two devices raises, and so does a generator of the wrong device,
and numpy cannot look inside. So a test without a GPU shows that a program asks nothing of its
device but what torch offers on any.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch
from torch.overrides import TorchFunctionMode
from torch.utils import _foreach_utils
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

ELSEWHERE = torch.device("meta")
"""The name that is borrowed: every torch knows it, and nothing here computes there in earnest."""
COPIES = (torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default)
LOOKUPS = ("aten::index", "aten::index_put_", "aten::_index_put_impl_", "aten::index_put")


class DeviceMixUpError(RuntimeError):
    """What would have raised on a GPU."""


class Elsewhere(torch.Tensor):
    """A CPU tensor that says it is elsewhere."""

    @staticmethod
    def __new__(cls, here: torch.Tensor):
        return torch.Tensor._make_wrapper_subclass(
            cls, here.shape, strides=here.stride(), storage_offset=here.storage_offset(),
            dtype=here.dtype, device=ELSEWHERE, requires_grad=here.requires_grad,
        )  # fmt: skip

    def __init__(self, here: torch.Tensor) -> None:
        self.here = here

    def __repr__(self, **_) -> str:
        return f"Elsewhere({self.here!r})"

    def __reduce_ex__(self, protocol):  # as a GPU's tensor does with map_location="cpu"
        return self.here.detach().__reduce_ex__(protocol)

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})


def computed(func, args, kwargs):
    """Does an operation on the CPU, and lets its result lie where it would."""
    _refuse_mixtures(func, args, kwargs)
    leaves = tree_leaves((args, kwargs))
    device = kwargs.get("device")
    named = torch.device(device) if device is not None else None
    elsewhere = any(isinstance(leaf, Elsewhere) for leaf in leaves)
    if named is not None:
        elsewhere = named == ELSEWHERE
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if func is torch.ops.aten.copy_.default:
        elsewhere = isinstance(args[0], Elsewhere)

    def here(leaf):
        return leaf.here if isinstance(leaf, Elsewhere) else leaf

    result = func(*tree_map(here, args), **tree_map(here, kwargs))
    if not elsewhere:
        return result
    moved = tree_map(lambda leaf: Elsewhere(leaf) if type(leaf) is torch.Tensor else leaf, result)
    if func in COPIES or named is not None:
        return args[0] if func is torch.ops.aten.copy_.default else moved
    return return_and_correct_aliasing(func, args, kwargs, moved)


def _refuse_mixtures(func, args, kwargs) -> None:
    """As torch does: numbers may come from the CPU, and so may indices; all else must not meet."""
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
        shapes = [tuple(tensor.shape) for tensor in tensors if tensor.device != ELSEWHERE]
        raise DeviceMixUpError(f"{func} meets CPU tensors of shapes {shapes} elsewhere")


class Generator(torch.Generator):
    """A generator that says where it was made."""

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
    """What never reaches an operation: literals, generators' places, and numpy's door."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.tensor and torch.device(kwargs.get("device") or "cpu") == ELSEWHERE:
            return func(*args, **{**kwargs, "device": "cpu"}).to(ELSEWHERE)
        if func is torch.Tensor.new_tensor and isinstance(args[0], Elsewhere):
            return torch.tensor(args[1], dtype=args[0].dtype).to(ELSEWHERE)
        generator = kwargs.get("generator")
        if generator is not None:
            tensors = [leaf for leaf in tree_leaves(args) if isinstance(leaf, torch.Tensor)]
            place = tensors[0].device if tensors else torch.device(kwargs.get("device") or "cpu")
            if place != generator.device:
                raise DeviceMixUpError(
                    f"{func} draws on {place} from a generator of {generator.device}"
                )
        if func is torch.Tensor.numpy and isinstance(args[0], Elsewhere):
            raise DeviceMixUpError("numpy looks into a tensor that lies elsewhere")
        if func is torch.Tensor.__getitem__ and isinstance(args[1], list):
            return func(args[0], torch.tensor(args[1]))
        if func is torch.Tensor.tolist and isinstance(args[0], Elsewhere):
            return args[0].here.tolist()
        return func(*args, **kwargs)


@contextmanager
def elsewhere() -> Iterator[torch.device]:
    """Within it, a device of that name can be used."""
    fused = _foreach_utils._get_fused_kernels_supported_devices

    def supported() -> list[str]:
        return [*fused(), ELSEWHERE.type]

    with (
        mock.patch.object(torch, "Generator", Generator),
        mock.patch("torch.optim.optimizer._get_fused_kernels_supported_devices", supported),
        _Functions(),
        _Operations(),
    ):
        yield ELSEWHERE
