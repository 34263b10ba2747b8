"""Training a one-step network on its own roll-outs, after it has learned single steps.

Errors of a step that its targets hardly show, or that noise in its inputs hides, add up in a
roll-out. Here the network is rolled out from logged states and the distance to the logged states
that follow is what is learned from, first over two steps, then four, eight, and so on: the paths
of a network that is not good yet tell nothing far ahead.

References
----------
A. Venkatraman, M. Hebert and J. A. Bagnell, "Improving multi-step prediction of learned time
series models", AAAI 2015.
M. Janner et al., "When to trust your model: model-based policy optimization", NeurIPS 2019 (why
few steps).
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from trajlearn.dynamics._relative import curve, relative_to
from trajlearn.dynamics._rollouts.cloned_policy import ClonedPolicy
from trajlearn.dynamics._rollouts.unrolled_steps import Stretches, Unrolled
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors._batches import row_batches
from trajlearn.regressors._device import find_device
from trajlearn.regressors._ensemble import Ensemble
from trajlearn.regressors._losses import GaussianNLL
from trajlearn.regressors._samples import Rows
from trajlearn.regressors._threads import threads_for
from trajlearn.regressors._trained import Training
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler

__all__ = ["check_unrollable", "train_on_rollouts"]

Floats = NDArray[np.float64]

# Gradient steps for each number of steps of a roll-out, and their rate, in that of the learner.
_STEPS_A_STAGE = 150
_RATE = 0.3
# Roll-outs of each member behind a gradient.
_ROLLOUTS = 256
# The gradient of a member is cut off at this length.
_LONGEST_GRADIENT = 1.0
# Roll-outs by which the weights to keep are chosen.
_JUDGED = 512

_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": torch.nn.functional.relu,
    "silu": torch.nn.functional.silu,
    "tanh": torch.tanh,
}


def check_unrollable(model: Any) -> None:
    """Raise an error for models that cannot be trained on roll-outs.

    Parameters
    ----------
    model : RollingEstimator
        Whose learner, relabeler and scaler are chosen, not fitted.
    """
    learner, why = model.estimator_, None
    if not isinstance(learner, MLPEnsembleRegressor):
        why = f"trains a network further: give an MLPEnsembleRegressor, not {_name(learner)}"
    elif learner.bootstrap or learner.early_stopping:
        why = "learns from all episodes: leave bootstrap= and early_stopping= of the learner out"
    elif not isinstance(model.relabeler_, TransitionRelabeler):
        why = f"needs a TransitionRelabeler, not {_name(model.relabeler_)}"
    elif not isinstance(model.scaler_, BlockScaler) or model.scaler_.features is not None:
        why = "takes slopes through the scaler: give a BlockScaler without features="
    elif _clones(model) and model._history() > 1:
        why = (
            "with policy='clone' knows slopes of actions in the state alone: leave history="
            f"{model._history()} out, or give a policy, or rollout_actions='logged'"
        )
        why = None if model.rollout_actions == "logged" else why
    if why is not None:
        raise ValueError(f"loss_horizon={model.loss_horizon} {why}.")


def _clones(model: Any) -> bool:
    """Whether its policy is cloned now, or was before."""
    return bool(model._clones()) or isinstance(model.policy, ClonedPolicy)


def train_on_rollouts(
    model: Any, logged: TrajectoryDataset, weight: Floats | None, rng: np.random.Generator
) -> None:
    """Train the network of a fitted one-step model further, on roll-outs of `loss_horizon` steps.

    Parameters
    ----------
    model : RollingEstimator
    logged : TrajectoryDataset
    weight : ndarray of shape (n,) or None
        By episode: roll-outs begin in it in proportion.
    rng : Generator
    """
    learner, scaler = model.estimator_, model.scaler_
    if scaler.affine_ is None:
        raise ValueError(
            f"loss_horizon={model.loss_horizon} takes slopes through the scaler, and one of its "
            "parts is not linear: take scikit-learn's StandardScaler or MinMaxScaler."
        )
    ds = logged
    if model.baseline_ is not None:
        ds = relative_to(logged, curve(model.baseline_, logged), told=model._told())
    source, policy = model._source(logged, "auto", None)
    device = find_device(learner.device)
    unrolled = Unrolled(model, logged, ds, source, policy, device)
    starts = _Starts(model, ds, weight, rng)
    training = _training(model, ds, weight, rng)
    ensemble = learner._begun(training)
    with threads_for(6.0 * ensemble.network.flat_weights.numel() * _ROLLOUTS):
        _Trainer(model, unrolled, ensemble, ds).train(starts, verbose=learner.verbose)
    curves = learner.n_steps_, learner.loss_curve_, learner.validation_loss_curve_
    learner._finish(ensemble, curves, training)


def _training(
    model: Any, ds: TrajectoryDataset, weight: Floats | None, rng: np.random.Generator
) -> Training:
    """Training on single steps from the weights of now: for residuals, and their variance."""
    learner = model.estimator_
    begin = model.relabeler_.begins(ds)
    episode = np.searchsorted(ds.offsets, begin, side="right") - 1
    rows = model.relabeler_.rows(ds, episode, begin, begin + 1)
    z, _ = model._learning_targets(rows, ds.states[begin + 1])
    by_row = None if weight is None else weight[episode]
    single = Rows(model._scaled(rows), z, by_row)
    batches = row_batches(
        single, None, learner._to_tensors(), learner.n_members, learner.batch_size, rng
    )
    return Training(batches, single, learner.n_steps_, rng, goes_on=True)


class _Starts:
    """Where roll-outs begin: drawn from all states that a step is learned from."""

    def __init__(
        self, model: Any, ds: TrajectoryDataset, weight: Floats | None, rng: np.random.Generator
    ) -> None:
        self.ds, self._rng = ds, rng
        self._begin = model.relabeler_.begins(ds)
        share = np.ones(len(self._begin))
        if weight is not None:
            share = weight[np.searchsorted(ds.offsets, self._begin, side="right") - 1]
        self._cumulative = np.cumsum(share)

    def draw(self, n_members: int, n: int, n_steps: int) -> Stretches:
        """Roll-outs of `n_steps` from `n` starts for each member."""
        u = self._rng.random((n_members, n)) * self._cumulative[-1]
        chosen = np.searchsorted(self._cumulative, u, side="right")
        return Stretches.of(self.ds, self._begin[chosen], n_steps)


class _Trainer:
    """Gradient steps on roll-outs."""

    def __init__(
        self, model: Any, unrolled: Unrolled, ensemble: Ensemble, ds: TrajectoryDataset
    ) -> None:
        self._model, self._unrolled, self._ensemble = model, unrolled, ensemble
        self._learner = learner = model.estimator_
        network = ensemble.network
        device = network.flat_weights.device

        def tensor(values: Any) -> Tensor:
            return torch.as_tensor(np.asarray(values, dtype=np.float64), device=device)

        columns, scale, shift = model.scaler_.affine_
        self._columns = torch.as_tensor(columns, device=device)
        self._scale, self._shift = tensor(scale), tensor(shift)
        self._own = model.layout_["state"]
        self._d = len(model.target_scale_)
        self._unit = tensor(learner.target_scale_ * model.target_scale_)
        self._offset = tensor(learner.target_mean_ * model.target_scale_)
        spread = ds.states.std(axis=0)
        # round-off alone is no spread
        least = 1e-12 * unrolled.magnitude
        self._weight = tensor(1 / np.where(spread > least, spread, np.inf) ** 2)
        self._activation = _ACTIVATIONS[learner.activation]

    def train(self, starts: _Starts, *, verbose: int) -> None:
        """Train by the curriculum; each member keeps its best weights of all stages."""
        horizon = self._model.loss_horizon
        stages = [2**k for k in range(1, math.ceil(math.log2(horizon)))] + [horizon]
        n_members = self._ensemble.network.n_members
        judged = starts.draw(1, _JUDGED, horizon)
        judged = Stretches(
            np.tile(judged.state, n_members),
            np.tile(judged.episode, n_members),
            np.tile(judged.known, n_members),
            n_members,
        )
        best, least = self._snapshot(), self._judge(judged)
        with tqdm(total=sum(stages), desc="roll-outs", disable=not verbose) as bar:
            for n_steps in stages:
                self._train_stage(starts, n_steps)
                now = self._judge(judged)
                better = now < least
                least = torch.where(better, now, least)
                for kept, tensor in zip(best, self._tensors()):
                    kept[better] = tensor[better]
                bar.update(n_steps)
        for kept, tensor in zip(best, self._tensors()):
            tensor.copy_(kept)

    def _train_stage(self, starts: _Starts, n_steps: int) -> None:
        network, peak = self._ensemble.network, _RATE * self._learner.learning_rate
        flat = [network.flat_weights, network.flat_biases]
        for step in range(_STEPS_A_STAGE):
            stretches = starts.draw(network.n_members, _ROLLOUTS, n_steps)
            for tensor in flat:
                tensor.requires_grad_(True)
                assert tensor.grad is not None  # made with the network
                tensor.grad.zero_()
            self._loss(stretches).sum().backward()
            for tensor in flat:
                tensor.requires_grad_(False)
            self._cut_gradients()
            with torch.no_grad():
                progress = step / _STEPS_A_STAGE
                self._ensemble.optimizer.step(peak * 0.5 * (1 + math.cos(math.pi * progress)))

    def _cut_gradients(self) -> None:
        """Shorten the gradient of each member, and leave out one that is not finite."""
        network = self._ensemble.network
        grads = []
        for flat, layers in (
            (network.flat_weights, network.weights),
            (network.flat_biases, network.biases),
        ):
            assert flat.grad is not None  # made with the network
            grads += network.layers_of(flat.grad, layers)
        length = torch.stack([grad.flatten(1).norm(dim=1) for grad in grads]).norm(dim=0)
        factor = (_LONGEST_GRADIENT / length).clamp(max=1.0)
        for grad in grads:
            grad.mul_(factor[:, None, None]).nan_to_num_(0.0, 0.0, 0.0)

    def _loss(self, stretches: Stretches) -> Tensor:
        """What each member (E,) is trained on."""
        missed, rows = self._missed(stretches)
        nll = self._ensemble.loss
        if not isinstance(nll, GaussianNLL):
            return missed
        # variances share a network with the means, and are to stay those of single steps
        mean, logvar = nll.split(self._outputs(rows))
        target = self._unrolled.targets(stretches)[0]
        own = rows[..., self._own] if self._model.target == "change" else 0.0
        error = mean.detach() - (target - own - self._offset) / self._unit
        likelihood = (0.5 * (logvar + error**2 * torch.exp(-logvar))).mean(dim=(1, 2))
        return missed + missed.detach() * likelihood

    def _missed(self, stretches: Stretches) -> tuple[Tensor, Tensor]:
        """Discounted squared distance to the log (E,), in spreads of the states; first rows."""
        targets = self._unrolled.targets(stretches)
        known = torch.as_tensor(stretches.known, device=targets.device)
        share = known.unflatten(1, (stretches.n_members, -1)) * self._model.loss_discount ** (
            torch.arange(len(known), dtype=torch.float64, device=targets.device).view(-1, 1, 1)
        )
        share = share / share.sum(dim=(0, 2), keepdim=True)
        rows, paths = zip(*self._unrolled.paths(stretches, self._step))
        missed = ((torch.stack(paths) - targets) ** 2 * self._weight).mean(dim=3)
        return (share * missed).sum(dim=(0, 2)), rows[0]

    def _judge(self, stretches: Stretches) -> Tensor:
        with torch.no_grad():
            return self._missed(stretches)[0].nan_to_num(torch.inf)

    def _step(self, rows: Tensor) -> Tensor:
        """States (E, m, d_s) after rows of inputs, with the weights of now."""
        after = self._outputs(rows)[..., : self._d].to(torch.float64) * self._unit + self._offset
        return after + rows[..., self._own] if self._model.target == "change" else after

    def _outputs(self, rows: Tensor) -> Tensor:
        """Outputs of the networks (E, m, width)."""
        network = self._ensemble.network
        weights = network.layers_of(network.flat_weights, network.weights)
        biases = network.layers_of(network.flat_biases, network.biases)
        z = (rows[..., self._columns] * self._scale + self._shift).to(torch.float32)
        for i, (weight, bias) in enumerate(zip(weights, biases)):
            z = torch.baddbmm(bias, self._activation(z) if i else z, weight)
        return z

    def _tensors(self) -> list[Tensor]:
        """Weights and biases, members first."""
        return [*self._ensemble.network.weights, *self._ensemble.network.biases]

    def _snapshot(self) -> list[Tensor]:
        return [tensor.clone() for tensor in self._tensors()]


def _name(value: Any) -> str:
    return type(value).__name__
