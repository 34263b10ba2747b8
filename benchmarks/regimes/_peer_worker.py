"""One-step models of other libraries, answering through a pipe; runs in their environments.

``python -m benchmarks.regimes._peer_worker PEER``. Messages: ``fit {settings}`` with ``states``
(rows), ``inputs``, ``after`` and ``offsets`` (first row of each episode, and the end), ``step``
with ``states`` and ``inputs``, answered by ``after``.
"""

import json
import os
import sys
import warnings
from typing import Any

import numpy as np

from benchmarks.regimes._peer_messages import Arrays, receive, send


class PySINDy:
    """Sparse regression of the next state on polynomials of state and input."""

    def __init__(self, degree: int, threshold: float) -> None:
        import pysindy

        self.model = pysindy.DiscreteSINDy(
            optimizer=pysindy.STLSQ(threshold=threshold),
            feature_library=pysindy.PolynomialLibrary(degree=degree),
        )

    def fit(self, arrays: Arrays) -> None:
        cut = [slice(a, b) for a, b in zip(arrays["offsets"][:-1], arrays["offsets"][1:])]
        x, u, after = ([arrays[name][part] for part in cut] for name in _ROWS)
        self.model.fit(x, t=1.0, x_next=after, u=u)

    def step(self, states: Any, inputs: Any) -> Any:
        return self.model.predict(states, u=inputs)


class Pykoop:
    """Extended dynamic mode decomposition: linear in lifted, standardised states and inputs."""

    def __init__(self, degree: int, alpha: float) -> None:
        import pykoop
        from sklearn.preprocessing import StandardScaler

        self.model = pykoop.KoopmanPipeline(
            lifting_functions=[
                ("scale", pykoop.SkLearnLiftingFn(StandardScaler())),
                ("lift", pykoop.PolynomialLiftingFn(order=degree)),
            ],
            regressor=pykoop.Edmd(alpha=alpha),
        )

    def fit(self, arrays: Arrays) -> None:
        # episode, state, input; the last state of an episode has an input that nothing follows
        rows = []
        for number, (a, b) in enumerate(zip(arrays["offsets"][:-1], arrays["offsets"][1:])):
            x, u, after = (arrays[name][a:b] for name in _ROWS)
            states, inputs = np.vstack([x, after[-1:]]), np.vstack([u, u[-1:]])
            rows.append(np.hstack([np.full((len(states), 1), number), states, inputs]))
        n_inputs = arrays["inputs"].shape[1]
        self.model.fit(np.vstack(rows), n_inputs=n_inputs, episode_feature=True)

    def step(self, states: Any, inputs: Any) -> Any:
        # rows of one episode: each is lifted, advanced and retracted by itself
        rows = np.hstack([np.zeros((len(states), 1)), states, inputs])
        return self.model.predict(rows)[:, 1 : 1 + states.shape[1]]


class Mbrl:
    """An ensemble of networks, trained as the library's own examples do."""

    def __init__(self, hidden: int, epochs: int, deterministic: bool, seed: int) -> None:
        self.hidden, self.epochs, self.deterministic, self.seed = (
            hidden,
            epochs,
            deterministic,
            seed,
        )

    def fit(self, arrays: Arrays) -> None:
        import mbrl.models
        import torch
        from mbrl.types import TransitionBatch
        from mbrl.util.common import get_basic_buffer_iterators
        from mbrl.util.replay_buffer import ReplayBuffer

        torch.set_num_threads(1)
        torch.manual_seed(self.seed)
        rng = np.random.default_rng(self.seed)
        x, u, after = (np.asarray(arrays[name], dtype=np.float32) for name in _ROWS)
        network = mbrl.models.GaussianMLP(
            x.shape[1] + u.shape[1],
            x.shape[1],
            "cpu",
            num_layers=3,
            ensemble_size=5,
            hid_size=self.hidden,
            deterministic=self.deterministic,
        )
        self.model = mbrl.models.OneDTransitionRewardModel(
            network, target_is_delta=True, normalize=True, learned_rewards=False
        )
        buffer = ReplayBuffer(len(x), x.shape[1:], u.shape[1:], rng=rng)
        no = np.zeros(len(x), dtype=bool)
        buffer.add_batch(x, u, after, np.zeros(len(x), dtype=np.float32), no, no)
        batch: TransitionBatch = buffer.get_all()
        self.model.update_normalizer(batch)
        train, held_out = get_basic_buffer_iterators(
            buffer, 256, 0.1, ensemble_size=5, shuffle_each_epoch=True
        )
        trainer = mbrl.models.ModelTrainer(self.model, optim_lr=1e-3, weight_decay=5e-5)
        trainer.train(train, held_out, num_epochs=self.epochs, patience=5, silent=True)

    def step(self, states: Any, inputs: Any) -> Any:
        import torch

        with torch.no_grad():
            x = torch.as_tensor(states, dtype=torch.float32)
            u = torch.as_tensor(inputs, dtype=torch.float32)
            # the library rolls deterministic ensembles out one member at a time only
            rows = self.model._get_model_input(x, u)
            change, _ = self.model.model.forward(rows, use_propagation=False)
        return states + change.mean(dim=0).double().numpy()


PEERS = {"pysindy": PySINDy, "pykoop": Pykoop, "mbrl": Mbrl}
_ROWS = ("states", "inputs", "after")


def main() -> None:
    """Answer until the pipe ends."""
    # what a library prints must not get between the messages
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    warnings.simplefilter("ignore")
    model: Any = None
    while (message := receive(sys.stdin.buffer)) is not None:
        command, arrays = message
        try:
            if command.startswith("fit "):
                model = PEERS[sys.argv[1]](**json.loads(command.removeprefix("fit ")))
                model.fit(arrays)
                send(answers, "fitted", {})
            else:
                found = model.step(arrays["states"], arrays["inputs"])
                send(answers, "after", {"after": np.asarray(found, dtype=np.float64)})
        except Exception as error:
            send(answers, f"failed {type(error).__name__}: {error}", {})


if __name__ == "__main__":
    main()
