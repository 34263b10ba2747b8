"""The matrix products of a network and nothing else: what no implementation can be rid of."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch

Products = Callable[[], None]


def training_products(
    sizes: Sequence[int], n_members: int, batch_size: int, steps: int = 1
) -> Products:
    """All products of training steps of every member, each member with operands of its own.

    Forward, weight gradients, and input gradients of all layers but the first.
    """
    jobs = []
    for _ in range(n_members):
        for layer, (a, b) in enumerate(pairwise(sizes)):
            x, w, grad = torch.randn(batch_size, a), torch.randn(a, b), torch.randn(batch_size, b)
            jobs.append((x, w, torch.empty(batch_size, b)))
            jobs.append((x.T, grad, torch.empty(a, b)))
            if layer:
                jobs.append((grad, w.T, torch.empty(batch_size, a)))

    def run() -> None:
        for _ in range(steps):
            for left, right, out in jobs:
                torch.mm(left, right, out=out)

    return run


def forward_products(sizes: Sequence[int], n_rows: int, block: int) -> Products:
    """The products of evaluating `n_rows`, in blocks that stay in cache."""
    n_blocks, rest = divmod(n_rows, block)
    blocks = [block] * n_blocks + [rest] * (rest > 0)
    jobs = {
        size: [
            (torch.randn(size, a), torch.randn(a, b), torch.empty(size, b))
            for a, b in pairwise(sizes)
        ]
        for size in set(blocks)
    }

    def run() -> None:
        for size in blocks:
            for left, right, out in jobs[size]:
                torch.mm(left, right, out=out)

    return run
