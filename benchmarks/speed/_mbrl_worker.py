"""mbrl-lib's trainer beside the bare products; runs inside mbrl-lib's own environment."""

import json
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

import mbrl.models
import numpy as np
import torch
from mbrl.types import TransitionBatch
from mbrl.util.replay_buffer import BootstrapIterator

from benchmarks.speed._gemm import training_products
from benchmarks.speed._timing import Case, measure


def timings(
    sizes: Sequence[int],
    rows: int,
    rounds: int,
    batch_sizes: Sequence[int],
    members: Sequence[int],
) -> list[dict[str, Any]]:
    """Times of a step of `ModelTrainer`, as `measure` gives them."""
    found = []
    for batch_size in batch_sizes:
        for n_members in members:
            steps = rows // batch_size
            base = training_products(sizes, n_members, batch_size, steps)
            trainings = {
                f"mbrl-lib, {kind}": _trainer(
                    sizes, n_members, batch_size, rows, deterministic=kind == "deterministic"
                )
                for kind in ("deterministic", "probabilistic")
            }
            cases = [Case("bare GEMM, mbrl-lib's environment", base, steps)]
            cases += [Case(name, call, steps) for name, call in trainings.items()]
            labels = {"batch_size": batch_size, "n_members": n_members}
            found += measure(cases, rounds=rounds, **labels)
    return found


def _trainer(
    sizes: Sequence[int], n_members: int, batch_size: int, n_rows: int, *, deterministic: bool
) -> Callable[[], object]:
    """One pass over the rows, inputs normalised as in mbrl-lib's own examples, no evaluation."""
    n_inputs, hidden, *more, n_targets = sizes
    rng = np.random.default_rng(0)
    states = rng.normal(size=(n_rows, n_targets)).astype(np.float32)
    rest = rng.normal(size=(n_rows, n_inputs - n_targets)).astype(np.float32)
    after = rng.normal(size=(n_rows, n_targets)).astype(np.float32)
    no = np.zeros(n_rows, dtype=bool)
    batch = TransitionBatch(states, rest, after, np.zeros(n_rows, dtype=np.float32), no, no)
    network = mbrl.models.GaussianMLP(
        n_inputs,
        n_targets,
        "cpu",
        num_layers=1 + len(more),
        ensemble_size=n_members,
        hid_size=hidden,
        deterministic=deterministic,
    )
    model = mbrl.models.OneDTransitionRewardModel(network, normalize=True, learned_rewards=False)
    model.update_normalizer(batch)
    trainer = mbrl.models.ModelTrainer(model)
    batches = BootstrapIterator(batch, batch_size, n_members, shuffle_each_epoch=True, rng=rng)
    return lambda: trainer.train(batches, num_epochs=1, evaluate=False, silent=True)


def main() -> None:
    """Read the settings from the command line, write one line of JSON."""
    torch.set_num_threads(1)
    settings = json.loads(sys.argv[1])
    packages = {name: version(name) for name in ("mbrl", "torch", "numpy", "hydra-core")}
    print(json.dumps({"packages": packages, "rows": timings(**settings)}))


if __name__ == "__main__":
    main()
