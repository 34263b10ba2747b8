"""Prediction in fixed blocks: the same bits for a row whatever else is predicted with it."""

import warnings
from collections.abc import Iterator
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from trajlearn import MLPEnsembleRegressor
from trajlearn.regressors._prediction import BLOCK, Predictor, mixture

Floats = NDArray[np.float64]
N_FEATURES = 4


def make_predictor(
    widths: tuple[int, ...] = (N_FEATURES, 12, 10, 3), n_members: int = 2, activation: str = "silu"
) -> Predictor:
    rng = np.random.default_rng(0)
    shapes = list(pairwise(widths))
    return Predictor(
        [rng.normal(size=(n_members, a, b)).astype(np.float32) / a**0.5 for a, b in shapes],
        [rng.normal(size=(n_members, 1, b)).astype(np.float32) for _, b in shapes],
        activation,
        device=torch.device("cpu"),
        output_scale=np.arange(1.0, widths[-1] + 1),
        output_shift=-np.arange(widths[-1]),
    )


def make_rows(n: int, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(size=(n, N_FEATURES))


def by_hand(predictor: Predictor, x: Floats, activation: str) -> Floats:
    """Outputs (E, n, out), in float64."""
    act = {
        "relu": lambda z: np.maximum(z, 0),
        "silu": lambda z: z / (1 + np.exp(-z)),
        "tanh": np.tanh,
    }[activation]
    a = np.broadcast_to(x, (predictor.n_members, *x.shape))
    layers = list(zip(predictor._weights, predictor._biases))
    for i, (weight, bias) in enumerate(layers):
        a = a @ weight.numpy().astype(float) + bias.numpy()
        a = a if i == len(layers) - 1 else act(a)
    scale, shift = predictor._output
    return a[..., : len(scale)] * scale + shift


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(1)


@pytest.mark.parametrize("activation", ["relu", "silu", "tanh"])
@pytest.mark.parametrize("widths", [(4, 12, 10, 3), (4, 16, 5), (4, 2)])
@pytest.mark.parametrize("n", [1, BLOCK, BLOCK + 1])
def test_outputs_are_those_of_the_network(activation: str, widths: tuple[int, ...], n: int) -> None:
    predictor, x = make_predictor(widths, activation=activation), make_rows(n)
    out = predictor(x)
    assert out.shape == (2, n, widths[-1])
    assert out.dtype == np.float64
    np.testing.assert_allclose(out, by_hand(predictor, x, activation), rtol=1e-4, atol=1e-5)


# 5 to 7 and 9 to 11 columns are where some products depend on a row's place in the block
@pytest.mark.parametrize("widths", [(4, 250, 250, 4), (4, 17, 9, 1), (4, 11, 5), (4, 40, 6)])
@pytest.mark.parametrize("n_members", [1, 5])
def test_a_row_gets_the_same_bits_alone_in_a_batch_in_any_order(
    widths: tuple[int, ...], n_members: int, threads: int
) -> None:
    predictor, x = make_predictor(widths, n_members), make_rows(300)
    together = predictor(x)
    order = np.random.default_rng(2).permutation(300)
    np.testing.assert_array_equal(predictor(x[order]), together[:, order])
    np.testing.assert_array_equal(predictor(x[37:190]), together[:, 37:190])
    for i in range(0, 300, 29):
        np.testing.assert_array_equal(predictor(x[i : i + 1]), together[:, i : i + 1])


@pytest.mark.parametrize("widths", [(4, 250, 250, 4), (4, 17, 9, 1), (4, 11, 5), (4, 40, 6)])
@pytest.mark.parametrize("n", [1, BLOCK, 300])
def test_own_rows_of_each_member_get_the_bits_that_they_get_from_all_members(
    widths: tuple[int, ...], n: int, threads: int
) -> None:
    predictor = make_predictor(widths, n_members=3)
    x = np.stack([make_rows(n, seed) for seed in range(3)])
    own = predictor.own(x)
    assert own.shape == (3, n, widths[-1])
    for e in range(3):
        np.testing.assert_array_equal(own[e], predictor(x[e])[e])
    order = np.random.default_rng(2).permutation(n)
    np.testing.assert_array_equal(predictor.own(x[:, order]), own[:, order])


def test_several_threads_give_the_same_bits_as_one() -> None:
    predictor, x = make_predictor((4, 600, 600, 3), n_members=3), make_rows(200)
    activation, seen = predictor._act, set()

    def spy(z: torch.Tensor, out: torch.Tensor) -> None:
        seen.add(torch.get_num_threads())
        activation(z, out)

    predictor._act = spy
    one = predictor(x)
    torch.set_num_threads(2)
    try:
        np.testing.assert_array_equal(predictor(x), one)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert seen == {1}


# nine members of one target: where numpy would add the members of a single row in another order
@cache
def fitted(probabilistic: bool) -> MLPEnsembleRegressor:
    model = MLPEnsembleRegressor(
        n_members=9,
        hidden_layer_sizes=(7,),
        max_steps=3,
        probabilistic=probabilistic,
        random_state=0,
    )
    return model.fit(make_rows(50, seed=3), make_rows(50, seed=4)[:, 0])


@given(
    picks=st.lists(st.integers(0, 149), min_size=1, max_size=200),
    probabilistic=st.booleans(),
)
def test_mean_and_std_of_an_ensemble_have_the_same_bits_in_any_selection(
    picks: list[int], probabilistic: bool
) -> None:
    model, x = fitted(probabilistic), make_rows(150)
    together, selected = model.predict(x, return_std=True), model.predict(x[picks], return_std=True)
    for part, chosen in zip(together, selected):
        np.testing.assert_array_equal(chosen, part[picks])


@pytest.mark.parametrize("widths", [(4, 12, 10, 3), (4, 40, 5), (4, 2)])
def test_product_equals_the_joined_rows(widths: tuple[int, ...], threads: int) -> None:
    predictor = make_predictor(widths)
    left, right = make_rows(150)[:, [0, 2, 3]], make_rows(20, seed=5)[:, [1]]
    rng = np.random.default_rng(6)
    index = rng.integers(150, size=400), rng.integers(20, size=400)
    joined = np.empty((400, 4))
    joined[:, [0, 2, 3]], joined[:, [1]] = left[index[0]], right[index[1]]
    out = predictor.product(left, right, ([0, 2, 3], [1]), index)
    expected = predictor(joined)
    np.testing.assert_allclose(out, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_product_gives_a_pair_the_same_bits_alone() -> None:
    predictor = make_predictor((4, 33, 9, 5))
    left, right = make_rows(150)[:, :3], make_rows(20, seed=5)[:, 3:]
    pairs = np.repeat(np.arange(150), 20), np.tile(np.arange(20), 150)
    columns = (range(3), [3])
    together = predictor.product(left, right, columns, pairs)
    for i in (0, 1, 131, 1777, 2999):
        a, b = pairs[0][i : i + 1], pairs[1][i : i + 1]
        first = np.zeros(1, dtype=np.intp)
        alone = predictor.product(left[a], right[b], columns, (first, first))
        np.testing.assert_array_equal(alone, together[:, i : i + 1])


def test_no_rows_give_no_outputs() -> None:
    predictor = make_predictor()
    assert predictor(np.empty((0, 4))).shape == (2, 0, 3)
    assert predictor.own(np.empty((2, 0, 4))).shape == (2, 0, 3)
    none = np.empty(0, dtype=np.intp)
    for n_left in (0, 5):
        left, right = np.ones((n_left, 3)), np.ones((n_left, 1))
        out = predictor.product(left, right, (range(3), [3]), (none, none))
        assert out.shape == (2, 0, 3)


def test_a_call_leaves_earlier_results_alone() -> None:
    predictor, x = make_predictor(), make_rows(10)
    first = predictor(x)
    copy = first.copy()
    predictor(-x)
    np.testing.assert_array_equal(first, copy)


def test_read_only_and_far_inputs_pass_without_a_warning() -> None:
    predictor, x = make_predictor(), make_rows(BLOCK).astype(np.float32)
    which = np.arange(BLOCK)
    for array in (x, which):
        array.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = predictor(x)
        predictor.product(x[:, :2], x[:, 2:], ([0, 1], [2, 3]), (which, which))
        far = predictor(np.array([[1e300, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(out, predictor(x.astype(np.float64)))
    # beyond single precision: not finite rather than wrong, and the other row is untouched
    assert not np.isfinite(far[:, 0]).any()
    np.testing.assert_array_equal(far[:, 1:], predictor(np.zeros((1, 4))))


@pytest.mark.parametrize("n_members", [1, 3, 8])
def test_mixture_is_the_mean_of_variances_plus_the_variance_of_means(n_members: int) -> None:
    rng = np.random.default_rng(0)
    means, variances = rng.normal(size=(2, n_members, 6, 2))
    variances = variances**2
    mean, variance = mixture(means, variances)
    np.testing.assert_allclose(mean, means.mean(axis=0))
    np.testing.assert_allclose(variance, variances.mean(axis=0) + means.var(axis=0))
