"""Small matrix products run slower on several threads than on one."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

# below this many operations a training step is faster on one thread (waiting costs more)
_WORTH_THREADS = 1e9


@contextmanager
def threads_for(flops: float) -> Iterator[None]:
    """Limit torch to one thread while steps are small; restore the setting afterwards."""
    before = torch.get_num_threads()
    # also when torch reports 1: inside an outer limit its MKL may still have more
    limited = flops < _WORTH_THREADS
    if limited:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if limited:
            torch.set_num_threads(before)
