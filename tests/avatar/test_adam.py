"""Our Adam takes torch's own steps, and loads no compiler for them."""

import subprocess
import sys
from pathlib import Path

import torch

from avatar.adam import UncompiledAdam

WITHOUT_COMPILER = """
import sys, torch
from avatar.adam import Adam
numbers = torch.nn.Parameter(torch.zeros(3))
numbers.grad = torch.ones(3)
Adam([numbers], fused=True).step()
assert numbers.max() < 0
print("torch._dynamo" in sys.modules)
"""


def test_its_steps_are_those_of_torch():
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(50, 4, generator=generator)
    ours, theirs = (torch.nn.Parameter(start.clone()) for _ in range(2))
    pair = [
        (numbers, kind([{"params": [numbers], "lr": 0.01}], betas=(0.9, 0.99), fused=True))
        for numbers, kind in ((ours, UncompiledAdam), (theirs, torch.optim.UncompiledAdam))
    ]
    for _ in range(5):
        grad = torch.randn(50, 4, generator=generator)
        for numbers, optimizer in pair:
            numbers.grad = grad.clone()
            optimizer.step()
    assert torch.equal(ours, theirs)
    assert not torch.equal(ours, start)


def test_a_first_step_loads_no_compiler():
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_COMPILER],
        cwd=root, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == "False"
