"""A fast backend that strays is found out, and not used."""

import pytest
import torch

from avatar import backends
from avatar.backends import TorchBackend, backend_for, failing_operation
from avatar.kernels.backend_protocol import RaySamples, SolvedCorrespondences
from avatar.kernels.numba_backend import NumbaBackend


class Spoiled:
    """The compiled backend with one operation slightly wrong."""

    name = "numba"

    def __init__(self, operation: str, factor: float) -> None:
        self._sound, self._operation, self._factor = NumbaBackend(), operation, factor

    def __getattr__(self, name):
        method = getattr(self._sound, name)
        if name != self._operation:
            return method

        def wrong(*arguments):
            result = method(*arguments)
            if result is None:  # works in place, on its last argument
                arguments[-1].mul_(self._factor)
                return None
            if isinstance(result, SolvedCorrespondences):
                return result._replace(roots=result.roots * self._factor)
            if isinstance(result, RaySamples):
                return result._replace(points=result.points * self._factor)
            if isinstance(result, tuple):
                return tuple(part * self._factor for part in result)
            return result * self._factor

        return wrong


def test_the_compiled_backend_is_sound():
    assert failing_operation(NumbaBackend()) is None


@pytest.mark.parametrize(
    "operation",
    [
        "encode", "encode_backward", "encode_points_backward", "solve_correspondences", "march",
        "composite", "composite_loss", "adam_step",
    ],
)  # fmt: skip
@pytest.mark.parametrize("factor", [1.01, float("nan")])
def test_an_operation_that_is_off_is_named(operation, factor):
    assert failing_operation(Spoiled(operation, factor)) == operation


def test_a_straying_backend_is_replaced_with_one_warning(monkeypatch):
    monkeypatch.delenv("IA_BACKEND", raising=False)
    monkeypatch.setattr(backends, "_numba_backend", lambda: Spoiled("encode", 1.01))
    backends._numba_passes_self_test.cache_clear()
    cpu = torch.device("cpu")
    try:
        with pytest.warns(UserWarning, match="'encode' differs from its meaning") as said:
            chosen = [backend_for(cpu), backend_for(cpu)]
        assert all(isinstance(one, TorchBackend) for one in chosen)
        assert len(said) == 1
    finally:
        backends._numba_passes_self_test.cache_clear()
