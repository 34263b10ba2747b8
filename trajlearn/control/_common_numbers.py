"""The same random numbers for every candidate, so that their values differ by the candidates."""

from typing import Any

import numpy as np

__all__ = ["CommonNumbers"]


class CommonNumbers(np.random.Generator):
    """Generator whose draws for all rows of a forecast repeat those of one candidate.

    A dynamics estimator draws noise of shape (copies, rows, ...) or (copies * rows, ...), where
    row ``i * n_starts + j`` is candidate i from initial state j. Here the draws of all
    candidates are the same ones, whatever their number: a comparison between two of them has no
    noise of its own, and a search evaluates one fixed function. Draws of any other shape are as
    ever.

    Parameters
    ----------
    seed : int or SeedSequence
    n_copies : int
        Trajectories sampled of each row.
    n_rows : int
        Candidates times initial states.
    n_starts : int
        Initial states.
    """

    def __init__(self, seed: Any, n_copies: int, n_rows: int, n_starts: int) -> None:
        super().__init__(np.random.PCG64(seed))
        self._sizes = n_copies, n_rows, n_starts

    def standard_normal(self, size: Any = None, *args: Any, **kwargs: Any) -> Any:
        """As of any generator."""
        draw = super().standard_normal
        return self._shared(size, lambda shape: draw(shape, *args, **kwargs))

    def integers(  # type: ignore[override]
        self, low: Any, high: Any = None, size: Any = None, **kwargs: Any
    ) -> Any:
        """As of any generator, but the same at all initial states.

        An integer is the ensemble member that a trajectory follows: what the plant might be does
        not depend on where a trial starts, so that its doubt does not average out over starts.
        """
        draw = super().integers
        return self._shared(size, lambda shape: draw(low, high, shape, **kwargs), by_start=False)

    def spawn(self, n_children: int) -> "list[Any]":
        """As of any generator; children repeat their draws, too."""
        seeds: Any = self.bit_generator.seed_seq
        return [CommonNumbers(seed, *self._sizes) for seed in seeds.spawn(n_children)]

    def _shared(self, size: Any, draw: Any, *, by_start: bool = True) -> Any:
        copies, rows, starts = self._sizes
        shape = tuple(np.atleast_1d(size)) if size is not None else ()
        if shape[:1] == (copies * rows,):
            rest, flat = shape[1:], True
        elif shape[:2] == (copies, rows):
            rest, flat = shape[2:], False
        else:
            return draw(size)
        one = draw((copies, 1, starts if by_start else 1, *rest))
        # a copy: models write into their noise
        every = np.array(np.broadcast_to(one, (copies, rows // starts, starts, *rest)))
        return every.reshape(copies * rows, *rest) if flat else every.reshape(copies, rows, *rest)
