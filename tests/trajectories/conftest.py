"""Random datasets with any mixture of fields, for properties that must hold for all of them."""

from collections.abc import Callable

import numpy as np
import pytest

from trajlearn.trajectories import TrajectoryDataset

NAMES = ["x", "y pos", "v,z", "Größe", "a.b", "角度", "", "7", "é'\"", "S"]
TEXT = ["a", "flight 12", "ß", "0", "b:3", "", "x,y", "猫"]


def _numbers(rng, *shape):
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-8, 8)
    if rng.random() < 0.3:
        values[rng.random(shape) < 0.2] = rng.choice([0.0, -0.0, 1e300, -5e-324, 0.1])
    return values


def _labels(rng, n):
    kind = rng.integers(3)
    if kind == 0:
        return rng.choice(TEXT, n).tolist()
    return rng.integers(-3, 4, n).tolist() if kind == 1 else (rng.random(n) < 0.5).tolist()


def random_dataset(seed: int, *, n: int | None = None, regular: bool = False) -> TrajectoryDataset:
    """Dataset in which each optional field is there or not, by the seed."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7)) if n is None else n
    lengths = rng.integers(1, 9, n)
    names = rng.permutation(NAMES).tolist()
    fields: dict = {}

    def present():
        return rng.random() < 0.5

    d_s = int(rng.integers(1, 4))
    fields["state_names"] = [names.pop() for _ in range(d_s)]
    if present():
        d_a = int(rng.integers(1, 3))
        fields["actions"] = [_numbers(rng, steps, d_a) for steps in lengths]
        fields["action_names"] = [names.pop() for _ in range(d_a)]
    if present():
        fields["rewards"] = [_numbers(rng, steps) for steps in lengths]
    if present():
        fields["references"] = [_numbers(rng, steps + 1, 2) for steps in lengths]
        fields["reference_names"] = [names.pop(), names.pop()]
    kind = rng.integers(3)
    if kind == 1:
        fields["params"] = [rng.normal(size=1) for _ in lengths]
    elif kind == 2:
        # Few values: theta often stays the same for a while.
        fields["params"] = [
            rng.choice([0.5, 1.5], (steps, 1))[np.sort(rng.integers(0, steps, steps))]
            for steps in lengths
        ]
    if present() and not regular:
        fields["times"] = [
            rng.normal() + np.cumsum(rng.uniform(0.01, 2.0, steps + 1)) for steps in lengths
        ]
    else:
        fields["dt"] = float(rng.choice([1.0, 0.02, 1 / 3]))
    if present():
        fields["time_origin"] = np.where(rng.random(n) < 0.3, np.nan, rng.normal(size=n))
    if present():
        fields["group"] = _labels(rng, n)
    if present():
        fields["context"] = {key: _labels(rng, n) for key in ["task", "Motor №"]}
    if present():
        fields["ids"] = (
            rng.permutation(50)[:n] if present() else rng.permutation(TEXT)[:n]
        ).tolist()
    fields["terminated"] = rng.random(n) < 0.3
    return TrajectoryDataset.from_arrays([_numbers(rng, t + 1, d_s) for t in lengths], **fields)


@pytest.fixture(scope="session")
def make_dataset() -> Callable[..., TrajectoryDataset]:
    """The function `random_dataset`."""
    return random_dataset
