"""Several ensembles trained as one: the models of all folds and of all rows in one network.

Their members are stacked, and each sees batches, targets and first weights of its own, as if it
were trained alone. Where the steps of one network are too small for a GPU, or for all cores, those
of several take little longer than one's.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain, groupby
from typing import Any

import numpy as np
import torch
from torch import Tensor

from trajlearn.regressors._batches import Batch
from trajlearn.regressors._ensemble import Ensemble
from trajlearn.regressors._losses import GaussianNLL, Loss, ResidualNLL
from trajlearn.regressors._network import BatchedMLP
from trajlearn.regressors._trained import Curves, Training
from trajlearn.regressors._training import Adam, Settings, train
from trajlearn.regressors.mlp import MLPEnsembleRegressor

__all__ = ["Job", "can_join", "fit_jointly"]

# what a learner is to be trained on, once it is known which learner
Job = Callable[[MLPEnsembleRegressor], Training]
# learners that differ in another parameter are not trained by the same steps
_MAY_DIFFER = {"n_members", "random_state", "verbose", "probabilistic", "max_steps", "max_epochs"}
# they stop, draw or begin in ways of their own
_ALONE = ("early_stopping", "bootstrap", "warm_start")


def can_join(learners: Sequence[Any]) -> bool:
    """Whether learners can be trained jointly, as far as their parameters tell."""
    if not all(type(learner) is MLPEnsembleRegressor for learner in learners):
        return False
    if any(getattr(learner, name) for learner in learners for name in _ALONE):
        return False
    kinds = [learner.get_params() for learner in learners]
    fixed = [{name: repr(kind[name]) for name in kind.keys() - _MAY_DIFFER} for kind in kinds]
    # the mean of a separate variance is that of none
    losses = {learner.probabilistic is True for learner in learners}
    return len(losses) == 1 and all(kind == fixed[0] for kind in fixed)


def fit_jointly(
    learners: Sequence[MLPEnsembleRegressor],
    jobs: Sequence[Job],
    *,
    least_steps: int = 0,
    verbose: int = 0,
) -> None:
    """Fit learners together.

    All take as many steps as the one that would take the most alone, and no fewer than
    `least_steps`; otherwise each gets what it would alone, up to rounding (one learner by itself:
    the same bits). Jobs whose batches have different sizes (fewer rows than `batch_size`) are
    trained apart.

    Parameters
    ----------
    learners : sequence of MLPEnsembleRegressor
        `can_join` must hold.
    jobs : sequence of callable
        One a learner, such as ``lambda learner: learner._on_rows(X, y, None, None)``.
    least_steps : int, default=0
    verbose : int, default=0
    """
    trainings = [job(learner) for learner, job in zip(learners, jobs)]
    ensembles = [learner._begun(training) for learner, training in zip(learners, trainings)]
    parts = [
        _Part(learner, training, ensemble)
        for learner, training, ensemble in zip(learners, trainings, ensembles)
    ]
    parts.sort(key=lambda part: part.shape)  # stable
    for _, group in groupby(parts, key=lambda part: part.shape):
        _fit_group(list(group), least_steps, verbose)


class _Part:
    """One learner in training: its batches have been looked at."""

    def __init__(
        self, learner: MLPEnsembleRegressor, training: Training, ensemble: Ensemble
    ) -> None:
        self.learner, self.training, self.ensemble = learner, training, ensemble
        first = next(training.batches)
        # some batches are one piece of memory that is filled anew
        first = first[0].clone(), first[1].clone(), first[2]
        self.batches = chain([first], training.batches)
        self.shape = (*first[0].shape[1:], first[1].shape[2])


def _fit_group(parts: list[_Part], least_steps: int, verbose: int) -> None:
    learner = parts[0].learner
    settings = Settings(
        max(least_steps, *(part.training.n_steps for part in parts)),
        learner.learning_rate,
        learner.schedule,
        verbose=bool(verbose),
    )
    curves = _train_together(
        [part.ensemble for part in parts], [part.batches for part in parts], settings
    )
    peaks = [
        part.learner._take(part.ensemble, own, part.training) for part, own in zip(parts, curves)
    ]
    apart = [(part, peak) for part, peak in zip(parts, peaks) if part.learner._separate()]
    if not apart:
        return
    variances = [
        part.learner._begun_variance(part.training, part.ensemble, peak) for part, peak in apart
    ]
    curves = _train_together(variances, [part.batches for part, _ in apart], settings)
    for (part, _), variance, own in zip(apart, variances, curves):
        part.learner._take_variance(variance, own)


def _train_together(
    ensembles: Sequence[Ensemble], batches: Sequence[Iterator[Batch]], settings: Settings
) -> list[Curves]:
    """Train ensembles in place; what each would have returned."""
    prepared = [
        ensemble.prepared(own, settings, None)[0] for ensemble, own in zip(ensembles, batches)
    ]
    stack = _Stack(ensembles)
    n_steps, losses, _ = train(
        stack.network, stack.loss, stack.optimizer, _side_by_side(prepared, stack.counts), settings
    )
    stack.share_out()
    at = np.cumsum(stack.counts)[:-1]
    own_losses = np.split(losses, at, axis=1)
    return [(n_steps, own, np.empty((0, own.shape[1]))) for own in own_losses]


def _side_by_side(batches: Sequence[Iterator[Batch]], counts: Sequence[int]) -> Iterator[Batch]:
    """Batches of all members (J * E, B, ...)."""
    if len(batches) == 1:
        yield from batches[0]
        return
    for parts in zip(*batches):
        x, y = (torch.cat([part[i] for part in parts]) for i in (0, 1))
        weight = None
        if any(part[2] is not None for part in parts):
            weight = torch.cat([_weight(own, n, x) for (_, _, own), n in zip(parts, counts)])
        yield x, y, weight


def _weight(weight: Tensor | None, n_members: int, x: Tensor) -> Tensor:
    """Weights (E, B, 1), which may have been left out or be the same for all members."""
    if weight is None:
        return x.new_ones((n_members, x.shape[1], 1))
    return weight.expand(n_members, -1, -1)


class _Stack:
    """Network, loss and optimiser of several ensembles as one.

    Parameters
    ----------
    ensembles : sequence of Ensemble
        At their first step.
    """

    def __init__(self, ensembles: Sequence[Ensemble]) -> None:
        self._ensembles = ensembles
        self.counts = [ensemble.network.n_members for ensemble in ensembles]
        first = ensembles[0]
        like = first.network.flat_weights
        self.network = BatchedMLP(
            first.network.sizes,
            sum(self.counts),
            first.network.activation,
            dtype=like.dtype,
            device=like.device,
        )
        self.loss = _stacked_loss([ensemble.loss for ensemble in ensembles], self.network)
        self.optimizer = Adam(self.network, self.loss, first.optimizer.weight_decay)
        self._exchange(into_stack=True)

    def share_out(self) -> None:
        """Give each ensemble its trained tensors, and the moments of its optimiser."""
        self._exchange(into_stack=False)
        for ensemble in self._ensembles:
            ensemble.optimizer.set_steps(self.optimizer)

    def _exchange(self, *, into_stack: bool) -> None:
        whole = _by_member(self.network, self.loss, self.optimizer)
        at = 0
        for ensemble, count in zip(self._ensembles, self.counts):
            own = _by_member(ensemble.network, ensemble.loss, ensemble.optimizer)
            for stacked, tensor in zip(whole, own):
                part = stacked[at : at + count]
                part.copy_(tensor) if into_stack else tensor.copy_(part)
            at += count


def _by_member(network: BatchedMLP, loss: Loss, optimizer: Adam) -> list[Tensor]:
    """All trained tensors, and the moments of each, members first."""
    tensors = [*network.weights, *network.biases, *loss.parameters()]
    for weights, biases, *own in optimizer.both_moments():
        tensors += network.layers_of(weights, network.weights)
        tensors += [*network.layers_of(biases, network.biases), *own]
    return tensors


def _stacked_loss(losses: Sequence[Loss], network: BatchedMLP) -> Loss:
    first = losses[0]
    if isinstance(first, GaussianNLL):
        n_targets = first.min_logvar.shape[2]
        return GaussianNLL(network.n_members, n_targets, first.beta, network.flat_weights)
    if isinstance(first, ResidualNLL):
        bounds = [(loss.low, loss.high) for loss in losses if isinstance(loss, ResidualNLL)]
        low, high = (torch.cat(bound) for bound in zip(*bounds))
        return ResidualNLL(low, high)
    return first
