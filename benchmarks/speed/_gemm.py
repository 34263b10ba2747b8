"""The matrix products of a network and nothing else: what no implementation can be rid of."""

from collections.abc import Callable, Sequence

import torch

Products = Callable[[], None]


def training_products(sizes: Sequence[int], n_members: int, batch_size: int) -> Products:
    """All products of one training step of every member, each with operands of its own.

    Forward, weight gradients, and input gradients of all layers but the first.
    """
    jobs = []
    for _ in range(n_members):
        for layer, (a, b) in enumerate(zip(sizes, sizes[1:])):
            x, w, grad = torch.randn(batch_size, a), torch.randn(a, b), torch.randn(batch_size, b)
            jobs.append((x, w, torch.empty(batch_size, b)))
            jobs.append((x.T, grad, torch.empty(a, b)))
            if layer:
                jobs.append((grad, w.T, torch.empty(batch_size, a)))

    def run() -> None:
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
            for a, b in zip(sizes, sizes[1:])
        ]
        for size in set(blocks)
    }

    def run() -> None:
        for size in blocks:
            for left, right, out in jobs[size]:
                torch.mm(left, right, out=out)

    return run
