"""The network, its losses, its optimiser and its batches, against torch's own."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import relu, silu, softplus

from trajlearn.regressors import _losses, _prediction
from trajlearn.regressors._batches import ToTensors, drawn_batches, row_batches, stream_batches
from trajlearn.regressors._losses import GaussianNLL, Loss, SquaredError
from trajlearn.regressors._network import ACTIVATIONS, BatchedMLP
from trajlearn.regressors._samples import Rows
from trajlearn.regressors._training import (
    Adam,
    Settings,
    Validation,
    default_steps,
    learning_rate,
    train,
)

CPU = torch.device("cpu")
TORCH_ACTIVATIONS = {"relu": relu, "silu": silu, "tanh": torch.tanh}
BETAS = {"squared": None, "likelihood": 0.0, "beta-nll": 0.5, "mean-first": 1.0}


def make(
    n_members: int, beta: float | None, activation: str = "silu", dtype: torch.dtype = torch.float64
) -> tuple[BatchedMLP, Loss]:
    """A network of 3 inputs and 2 targets, with bounds that clamp differently by member."""
    network = BatchedMLP(
        [3, 6, 5, 2 if beta is None else 4], n_members, activation, dtype=dtype, device=CPU
    )
    network.initialise(torch.Generator().manual_seed(1))
    if beta is None:
        return network, SquaredError()
    loss = GaussianNLL(n_members, 2, beta, network.flat_weights)
    loss.min_logvar += torch.linspace(8.0, 9.5, n_members * 2, dtype=dtype).view_as(loss.min_logvar)
    loss.max_logvar -= torch.linspace(0.0, 0.3, n_members * 2, dtype=dtype).view_as(loss.max_logvar)
    return network, loss


def batch(n_members: int, n: int = 7, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    x = torch.randn((n_members, n, 3), generator=generator, dtype=dtype)
    return x, torch.randn((n_members, n, 2), generator=generator, dtype=dtype)


class Reference:
    """The same network and loss in plain torch, differentiated by autograd."""

    def __init__(self, network: BatchedMLP, loss: Loss, activation: str, beta: float | None):
        self.weights = [w.clone().requires_grad_() for w in network.weights]
        self.biases = [b.clone().requires_grad_() for b in network.biases]
        self.bounds = [b.clone().requires_grad_() for b in loss.parameters()]
        self._activation, self._beta = TORCH_ACTIVATIONS[activation], beta

    def outputs(self, x: Tensor) -> Tensor:
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases)):
            x = x @ weight + bias
            x = x if i == last else self._activation(x)
        return x

    def loss(self, x: Tensor, y: Tensor, weight: Tensor | None) -> Tensor:
        out = self.outputs(x)
        if self._beta is None:
            terms = (out - y) ** 2
            penalty: Tensor | float = 0.0
        else:
            mean, raw = out.chunk(2, dim=-1)
            low, high = self.bounds
            logvar = high - softplus(high - raw)
            logvar = low + softplus(logvar - low)
            terms = 0.5 * (logvar + (mean - y) ** 2 / logvar.exp())
            terms = terms * logvar.exp().detach() ** self._beta
            penalty = 0.01 * (high - low).mean(dim=(1, 2)).sum()
        if weight is not None:
            terms = terms * weight
        return terms.mean(dim=(1, 2)).sum() + penalty


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("n_members", [1, 3])
@pytest.mark.parametrize("kind", sorted(BETAS))
@pytest.mark.parametrize("weighted", [False, True])
def test_gradients_are_those_of_autograd(
    activation: str, n_members: int, kind: str, weighted: bool
) -> None:
    beta = BETAS[kind]
    network, loss = make(n_members, beta, activation)
    x, y = batch(n_members)
    weight = torch.linspace(0.1, 2.0, n_members * 7).double().view(n_members, 7, 1)
    given_weight = weight if weighted else None
    reference = Reference(network, loss, activation, beta)
    reference.loss(x, y, given_weight).backward()

    out = network.forward(x)
    torch.testing.assert_close(out, reference.outputs(x), rtol=1e-12, atol=1e-12)
    network.backward(x, loss.gradient(out, y, given_weight))

    for flat, parts in (
        (network.flat_weights, reference.weights),
        (network.flat_biases, reference.biases),
    ):
        assert flat.grad is not None
        expected = torch.cat([part.grad.ravel() for part in parts])
        torch.testing.assert_close(flat.grad, expected, rtol=1e-9, atol=1e-12)
        assert expected.abs().max() > 1e-3
    for bound, other in zip(loss.parameters(), reference.bounds):
        torch.testing.assert_close(bound.grad, other.grad, rtol=1e-9, atol=1e-12)
        assert bound.grad.abs().max() > 1e-3


@pytest.mark.parametrize("kind", sorted(BETAS))
def test_value_is_the_weighted_mean_of_the_loss_of_each_member(kind: str) -> None:
    network, loss = make(3, BETAS[kind])
    x, y = batch(3)
    weight = torch.tensor([0, 0, 7, 0, 0, 0, 0.0]).double().view(1, 7, 1)
    value = loss.value(network.forward(x), y, weight)
    # all weight on the third row: its loss is the mean
    alone = loss.value(network.forward(x[:, 2:3]), y[:, 2:3], None)
    torch.testing.assert_close(value, alone)
    assert value.shape == (3,)


def test_a_member_learns_as_it_would_alone() -> None:
    network, loss = make(3, 0.5)
    x, y = batch(3)
    out = network.forward(x)
    network.backward(x, loss.gradient(out, y, None))
    single = BatchedMLP([3, 6, 5, 4], 1, "silu", dtype=torch.float64, device=CPU)
    own = GaussianNLL(1, 2, 0.5, single.flat_weights)
    for tensor, other in zip(
        [*single.weights, *single.biases, *own.parameters()],
        [*network.weights, *network.biases, *loss.parameters()],
    ):
        tensor.copy_(other[1:2])
    single.backward(x[1:2], own.gradient(single.forward(x[1:2]), y[1:2], None))
    expected = torch.cat([grad[1].ravel() for grad in network._grad_w])
    torch.testing.assert_close(single.flat_weights.grad, expected)


def test_batches_of_different_sizes_take_turns() -> None:
    network, _ = make(2, None)
    x, _ = batch(2)
    first = network.forward(x).clone()
    network.forward(x[:, :3])
    torch.testing.assert_close(network.forward(x), first, rtol=0, atol=0)


def test_initial_weights_fill_the_range_of_torch_linear() -> None:
    network = BatchedMLP([16, 400, 1], 2, "relu", dtype=torch.float32, device=CPU)
    network.initialise(torch.Generator().manual_seed(0))
    for tensor in (network.weights[0], network.biases[0]):
        assert 0.24 < tensor.abs().max() <= 0.25
        assert abs(tensor.mean()) < 0.02
    assert not torch.equal(network.weights[0][0], network.weights[0][1])


@given(
    raw=st.floats(-50, 50),
    low=st.floats(-10, -1),
    gap=st.floats(0.5, 10),
)
def test_bounds_hold_and_prediction_clamps_as_training_does(
    raw: float, low: float, gap: float
) -> None:
    # low + softplus(high - low) can pass `high` by log(1 + exp(low - high)); torch's softplus
    # is exact to 2e-9
    high = low + gap
    slack = np.log1p(np.exp(-gap)) + 1e-8
    values = [np.array([value]) for value in (raw, low, high)]
    in_training = _losses.bounded(*map(torch.from_numpy, values)).item()
    in_prediction = _prediction.bounded(*values).item()
    assert low - 1e-8 <= in_training <= high + slack
    assert in_prediction == pytest.approx(in_training, rel=1e-8, abs=1e-8)


# -- optimiser and schedule ---------------------------------------------------------------


def test_adam_is_torch_adamw_with_decay_on_weights_alone() -> None:
    network, loss = make(2, 0.5)
    x, y = batch(2)
    reference = Reference(network, loss, "silu", 0.5)
    torchs = torch.optim.AdamW(
        [
            {"params": reference.weights, "weight_decay": 0.1},
            {"params": [*reference.biases, *reference.bounds], "weight_decay": 0.0},
        ]
    )
    ours = Adam(network, loss, weight_decay=0.1)
    for step in range(5):
        rate = 0.01 * (step + 1)
        torchs.zero_grad()
        reference.loss(x, y, None).backward()
        for group in torchs.param_groups:
            group["lr"] = rate
        torchs.step()
        network.backward(x, loss.gradient(network.forward(x), y, None))
        ours.step(rate)
    tensors = [*network.weights, *network.biases, *loss.parameters()]
    expected = [*reference.weights, *reference.biases, *reference.bounds]
    for tensor, other in zip(tensors, expected):
        torch.testing.assert_close(tensor, other.detach(), rtol=1e-9, atol=1e-12)


def test_restored_moments_go_on_as_if_never_interrupted() -> None:
    x, y = batch(2, dtype=torch.float32)

    def run(interrupted: bool) -> Tensor:
        network, loss = make(2, None, dtype=torch.float32)
        optimizer = Adam(network, loss, weight_decay=0.0)
        for step in range(6):
            if interrupted and step == 3:
                moments = optimizer.moments()
                optimizer = Adam(network, loss, weight_decay=0.0)
                optimizer.restore(moments)
            network.backward(x, loss.gradient(network.forward(x), y, None))
            optimizer.step(0.01)
        return network.flat_weights

    assert torch.equal(run(interrupted=True), run(interrupted=False))


@given(n_steps=st.integers(1, 500))
def test_one_cycle_warms_up_for_a_tenth_then_falls_towards_zero(n_steps: int) -> None:
    settings = Settings(n_steps, 0.01, "one-cycle", verbose=False)
    rates = [learning_rate(step, settings) for step in range(n_steps)]
    peak = int(np.argmax(rates))
    assert max(rates) == pytest.approx(0.01)
    assert peak <= max(n_steps // 10, 1)
    assert all(a < b for a, b in pairwise(rates[: max(n_steps // 10, 1)]))
    assert all(a > b for a, b in pairwise(rates[peak + 1 :]))
    if n_steps >= 50:
        assert rates[0] < 0.5 * 0.01
        assert rates[-1] < 0.01 * 0.01


def test_constant_schedule_is_constant() -> None:
    settings = Settings(9, 0.02, "constant", verbose=False)
    assert {learning_rate(step, settings) for step in range(9)} == {0.02}


def test_budget_grows_with_the_rows_within_its_limits() -> None:
    assert [default_steps(n) for n in (1, 10, 200, 2_000, 10**9)] == [100, 100, 276, 980, 4000]


# -- the loop -----------------------------------------------------------------------------


def endless(x: Tensor, y: Tensor):
    while True:
        yield x, y, None


@pytest.mark.parametrize("kind", ["squared", "beta-nll"])
def test_a_training_run_is_that_of_autograd_and_torchs_optimiser(kind: str) -> None:
    beta = BETAS[kind]
    network, loss = make(2, beta)
    x, y = batch(2, n=30)
    settings = Settings(40, 0.01, "one-cycle", verbose=False)
    reference = Reference(network, loss, "silu", beta)
    parameters = [*reference.weights, *reference.biases, *reference.bounds]
    optimizer = torch.optim.Adam(parameters)
    for step in range(40):
        optimizer.zero_grad()
        reference.loss(x, y, None).backward()
        optimizer.param_groups[0]["lr"] = learning_rate(step, settings)
        optimizer.step()
    n_steps, losses, held_out = train(
        network, loss, Adam(network, loss, 0), endless(x, y), settings
    )
    torch.testing.assert_close(network.forward(x), reference.outputs(x).detach())
    assert n_steps == 40
    assert losses.shape == (40, 2)
    assert (losses[-1] < losses[0]).all()
    assert held_out.shape == (0, 2)


@pytest.mark.parametrize("n_held_out", [5, 2500])  # within one block, and over several
def test_early_stopping_stops_and_keeps_the_best_weights_of_each_member(n_held_out: int) -> None:
    network, loss = make(2, None)
    x, y = batch(2, n=8)
    generator = torch.Generator().manual_seed(5)
    held_x = torch.randn((n_held_out, 3), generator=generator, dtype=torch.float64)
    held_y = torch.randn((n_held_out, 2), generator=generator, dtype=torch.float64)
    weight = torch.rand((n_held_out, 1), generator=generator, dtype=torch.float64)
    settings = Settings(400, 0.02, "constant", verbose=False)
    n_steps, _, curve = train(
        network,
        loss,
        Adam(network, loss, 0.0),
        endless(x, y),
        settings,
        Validation(held_x, held_y, weight / weight.mean(), patience=5),
    )
    # noise cannot be predicted: training on other noise makes it worse sooner or later
    assert n_steps < 400
    assert n_steps == 4 * len(curve)
    out = network.forward(held_x.expand(2, -1, -1).contiguous())
    final = loss.value(out, held_y, weight / weight.mean()).numpy()
    np.testing.assert_allclose(final, curve.min(axis=0), rtol=1e-9)
    assert (curve[-1] > curve.min(axis=0)).all()
    assert len(curve) - 1 - curve.argmin(axis=0).max() == 5


# -- batches ------------------------------------------------------------------------------


def numbers(n: int, n_members: int, batch_size: int, multiplicity=None):
    """Row numbers (E, B) of successive batches."""
    x = torch.arange(n, dtype=torch.float64)[:, None]
    rng = np.random.default_rng(0)
    for got, y, weight in drawn_batches(x, -x, multiplicity, n_members, batch_size, rng):
        assert weight is None
        assert torch.equal(y, -got)
        yield got[..., 0].numpy().astype(int)


@pytest.mark.parametrize(("n", "batch_size"), [(12, 4), (13, 5), (300, 7)])
def test_each_member_sees_every_row_once_an_epoch_in_its_own_order(n: int, batch_size: int) -> None:
    drawn = numbers(n, 3, batch_size)
    seen = np.concatenate([next(drawn).copy() for _ in range(4 * n // batch_size)], axis=1)
    for epoch in range(3):
        part = seen[:, epoch * n : (epoch + 1) * n]
        np.testing.assert_array_equal(np.sort(part, axis=1), np.tile(np.arange(n), (3, 1)))
        assert (part[0] != part[1]).any()
        assert (part[1] != part[2]).any()
    assert (seen[:, :n] != seen[:, n : 2 * n]).any()


def test_rows_are_drawn_in_proportion_to_their_multiplicity() -> None:
    multiplicity = np.array([[0.0, 1.0, 3.0, 0.0, 0.5], [2.0, 0.0, 0.0, 0.0, 2.0]])
    drawn = numbers(5, 2, 100, multiplicity)
    seen = np.concatenate([next(drawn).copy() for _ in range(200)], axis=1)
    for member in range(2):
        share = np.bincount(seen[member], minlength=5) / seen.shape[1]
        expected = multiplicity[member] / multiplicity[member].sum()
        np.testing.assert_allclose(share, expected, atol=0.015)
        assert not share[expected == 0].any()


def test_all_rows_come_as_one_batch_if_they_fit() -> None:
    rows = Rows(
        np.arange(6.0).reshape(3, 2), np.array([[1.0], [3.0], [5.0]]), np.array([1, 1, 4.0])
    )
    convert = ToTensors(np.array([3.0]), np.array([2.0]), CPU)
    rng = np.random.default_rng(0)
    counts = np.array([[1.0, 2.0, 0.0], [1.0, 1.0, 1.0]])
    x, y, weight = next(row_batches(rows, counts, convert, 2, 3, rng))
    assert weight is not None
    np.testing.assert_array_equal(x.numpy(), np.tile(rows.X, (2, 1, 1)))
    np.testing.assert_array_equal(y[0, :, 0].numpy(), [-1.0, 0.0, 1.0])
    np.testing.assert_allclose(weight[..., 0].numpy(), [[1, 2, 0], [0.5, 0.5, 2]])
    x, _, weight = next(row_batches(rows, None, convert, 2, 2, rng))
    assert x.shape == (2, 2, 2)
    assert weight is None


def test_stream_gives_every_member_rows_of_its_own() -> None:
    asked = []

    def pool(n: int) -> tuple[Tensor, Tensor, Tensor]:
        asked.append(n)
        x = torch.arange(n, dtype=torch.float32)[:, None] + n * (len(asked) - 1)
        return x, -x, 2 * x

    batches = stream_batches(pool, 2, 3)
    seen = []
    for _ in range(100):
        x, y, weight = next(batches)
        assert weight is not None
        assert x.shape == (2, 3, 1)
        assert torch.equal(y, -x)
        assert torch.equal(weight, 2 * x)
        seen.append(x.ravel())
    assert len(asked) == 2
    assert torch.equal(torch.cat(seen), torch.arange(600, dtype=torch.float32))
