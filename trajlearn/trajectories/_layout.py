"""Which columns of a row hold which block."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Layout(Mapping[str, slice]):
    """Blocks of a row in order: name to slice, and the names of the columns in each."""

    columns: dict[str, tuple[str, ...]]

    @classmethod
    def of_rows(cls, n_features: int, d_s: int, rest: tuple[str, ...]) -> "Layout":
        """Layout of plain rows: `d_s` states, then the blocks `rest`; the last is the widest."""
        names = tuple(f"x{i}" for i in range(n_features))
        columns, at = {"state": names[:d_s]}, d_s
        for block in rest[:-1]:
            columns[block] = names[at : at + 1]
            at += 1
        if at < n_features:
            columns[rest[-1]] = names[at:]
        return cls(columns)

    @property
    def width(self) -> int:
        """Number of columns."""
        return sum(map(len, self.columns.values()))

    @property
    def feature_names(self) -> NDArray[np.object_]:
        """Names of all columns in order."""
        return np.array([name for names in self.columns.values() for name in names], dtype=object)

    def __getitem__(self, block: str) -> slice:
        at = 0
        for name, columns in self.columns.items():
            if name == block:
                return slice(at, at + len(columns))
            at += len(columns)
        raise KeyError(block)

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def assemble(self, blocks: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Concatenate the blocks in order; each is (n, width of the block)."""
        return np.concatenate([blocks[name] for name in self.columns], axis=1)
