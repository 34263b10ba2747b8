"""probabilistic="separate": the mean of the squared error, and a network for its residuals."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.exceptions import NotFittedError

from tests.regressors.small_mlp import Floats, clean, data, small
from tests.sklearn_checks import run_checks
from trajlearn import MLPEnsembleRegressor
from trajlearn.regressors import _variance
from trajlearn.regressors._losses import ResidualNLL, bounded
from trajlearn.regressors._network import BatchedMLP
from trajlearn.regressors._variance import VarianceEnsemble, out_of_bag

SKIPPED = {"check_array_api_input": "runs only with SCIPY_ARRAY_API=1 set before scipy is imported"}
GRID = np.linspace(-0.95, 0.95, 39)[:, None]


def separate(**params: Any) -> MLPEnsembleRegressor:
    return small(probabilistic="separate", **params)


def sigma(x: Floats) -> Floats:
    return 0.1 + 0.4 * np.abs(x[:, 0])


def uneven_noise(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, None]:
    X = rng.uniform(-1, 1, (n, 1))
    return X, np.sin(2 * X[:, 0]) + sigma(X) * rng.normal(size=n), None


def std_of(model: MLPEnsembleRegressor, X: Floats) -> Floats:
    return np.asarray(model.predict(X, return_std=True)[1])


def test_scikit_learns_own_checks_pass() -> None:
    model = MLPEnsembleRegressor(probabilistic="separate", hidden_layer_sizes=(32,))
    run_checks(model, allowed_skips=SKIPPED)


# -- the variance -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["rows", "stream", "passes", "early stopping", "bootstrap"])
def test_std_recovers_noise_that_depends_on_the_input(kind: str) -> None:
    X, y, _ = uneven_noise(3000, np.random.default_rng(0))
    model = separate(hidden_layer_sizes=(32, 32), max_steps=600, n_members=2)
    if kind == "stream":
        model.fit_stream(uneven_noise)
    elif kind == "passes":
        for _ in range(30):
            model.partial_fit(X, y)
    elif kind == "early stopping":
        model.set_params(early_stopping=True).fit(X, y)
    else:
        model.set_params(bootstrap="row" if kind == "bootstrap" else False).fit(X, y)
    truth = sigma(GRID)
    assert np.abs(std_of(model, GRID) / truth - 1).mean() < 0.2
    assert np.abs(model.predict(GRID) - np.sin(2 * GRID[:, 0])).mean() < 0.1


def test_each_member_learns_from_the_group_it_never_saw() -> None:
    # pure noise, loud in one group and soft in the other; who drew both sees everything again
    rng = np.random.default_rng(0)
    X, groups = rng.uniform(-1, 1, (400, 1)), np.repeat([0, 1], 200)
    y = np.where(groups, 1.0, 0.1) * rng.normal(size=400)
    model = separate(n_members=8, bootstrap="group", max_steps=200).fit(X, y, groups=groups)
    means, variances = model.moments(model.predictor()(GRID))
    assert means.shape == variances.shape == (8, 39, 1)
    found = np.sqrt(variances.mean(axis=(1, 2)))
    # those of the loud group are off by some of its noise, too
    soft, both, loud = found < 0.35, (found > 0.5) & (found < 0.8), found > 0.9
    assert soft.any()
    assert both.any()
    assert loud.any()
    assert (soft | both | loud).all()


def test_rows_that_a_member_never_saw_tell_its_variance() -> None:
    # noise by group, which a network can learn by heart
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(40), 5)
    X = rng.normal(size=(40, 3))[groups] + 0.01 * rng.normal(size=(200, 3))
    y = rng.normal(size=40)[groups]
    settings = {"hidden_layer_sizes": (64, 64), "max_steps": 300, "n_members": 3}
    fresh = rng.normal(size=(300, 3))
    of_seen = std_of(separate(**settings).fit(X, y), fresh)
    unseen = separate(bootstrap="group", **settings).fit(X, y, groups=groups)
    low = [np.sqrt(variance).mean() for variance in unseen.moments(unseen.predictor()(X))[1]]
    assert min(low) > 0.7
    assert std_of(unseen, fresh).mean() > 1.3 * of_seen.mean()


def test_out_of_bag_rows() -> None:
    counts = np.array([[0.0, 2.0, 1.0, 0.0], [1.0, 1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(out_of_bag(counts), [[1, 0, 0, 1], [1, 1, 1, 1]])


def test_variance_stays_within_the_range_of_the_residuals() -> None:
    X, y, _ = uneven_noise(300, np.random.default_rng(0))
    model = separate(hidden_layer_sizes=(32,), max_steps=300).fit(X, y)
    greatest = np.abs(model.predict(X) - y).max()
    for far in ([[1e3]], [[-1e3]], [[1e6]]):
        std = model.moments(model.predictor()(np.array(far)))[1] ** 0.5
        assert 0.99 * np.exp(-5) * model.residual_std_ <= std
        assert std <= 1.01 * np.exp(0.5) * greatest


@pytest.mark.parametrize("y", [np.full(5, 3.0), np.full(5, -1e9), np.arange(5.0)], ids=str)
def test_residuals_that_are_nearly_nothing_give_a_std_that_is_finite(y: Floats) -> None:
    X = np.arange(5.0)[:, None]
    model = separate(max_steps=400, learning_rate=0.02).fit(X, y)
    std = std_of(model, X)
    assert np.isfinite(std).all()
    assert (std > 0).all()
    assert separate().fit(X[:1], y[:1]).predict(X[:1]) == pytest.approx(y[:1], abs=0.3)


def test_residuals_of_zero_have_bounds() -> None:
    means = BatchedMLP([2, 8, 3], 2, "silu", dtype=torch.float32, device=torch.device("cpu"))
    nothing = {"residual_std": np.zeros((2, 3)), "residual_peak": np.zeros((2, 3))}
    bounds = VarianceEnsemble(means, "silu", weight_decay=0.0, seed=0, **nothing).bounds()
    assert bounds.shape == (2, 2, 1, 3)
    assert np.isfinite(bounds).all()


def test_the_variance_starts_at_that_of_the_residuals() -> None:
    X, _ = data()
    y = X @ [1.0, -2.0, 0.5]
    model = small(hidden_layer_sizes=(), max_steps=1500, learning_rate=0.02, warm_start=True)
    model.fit(X, y)
    model.set_params(probabilistic="separate", max_steps=1, learning_rate=1e-6).fit(X, y)
    assert model.residual_std_ < 0.01 * y.std()
    ratio = np.log(std_of(model, X) / model.residual_std_[0])
    assert np.abs(ratio).max() < 1.0


def test_held_out_rows_end_the_training_of_the_variance() -> None:
    # pure noise: there is nothing to learn
    rng = np.random.default_rng(0)
    X, y = rng.normal(size=(80, 3)), rng.normal(size=(80, 2))
    settings = {"hidden_layer_sizes": (64,), "max_steps": 1000, "learning_rate": 0.01}
    model = separate(early_stopping=True, patience=3, n_members=2, **settings).fit(X, y)
    assert len(model.variance_loss_curve_) < 60
    assert (np.ptp(std_of(model, X), axis=0) < 1.0).all()


@pytest.mark.parametrize("weighted", [False, True])
def test_gradients_of_the_likelihood_are_those_of_autograd(weighted: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    out = (4 * torch.randn((2, 7, 3), generator=generator)).double()
    y = torch.randn((2, 7, 3), generator=generator).double()
    weight = torch.linspace(0.1, 2.0, 14).double().view(2, 7, 1) if weighted else None
    low = torch.linspace(-5, -2, 6).double().view(2, 1, 3)
    loss = ResidualNLL(low, low + 6.0)
    raw = out.clone().requires_grad_()
    logvar = bounded(raw, loss.low, loss.high)
    terms = 0.5 * (logvar + y**2 / logvar.exp()) * (1.0 if weight is None else weight)
    value = terms.mean(dim=(1, 2))
    value.sum().backward()
    torch.testing.assert_close(loss.value(out, y, weight), value.detach())
    torch.testing.assert_close(loss.gradient(out, y, weight), raw.grad, rtol=1e-9, atol=1e-12)
    assert loss.parameters() == []


# -- the mean -----------------------------------------------------------------------------

WAYS: list[dict[str, Any]] = [
    {},
    {"n_members": 3, "batch_size": 16},
    {"early_stopping": True, "patience": 3},
    {"bootstrap": "row", "n_members": 2},
    {"bootstrap": "group", "n_members": 2, "batch_size": 16},
    {"activation": "relu", "weight_decay": 0.1},
]


@pytest.mark.parametrize("params", WAYS, ids=str)
def test_the_mean_is_to_the_bit_that_of_the_squared_error(params: dict[str, Any]) -> None:
    X, y = data(noise=0.2)
    groups = np.arange(60) // 6
    plain, other = (
        small(probabilistic=kind, **params).fit(X, y, groups=groups) for kind in (False, "separate")
    )
    np.testing.assert_array_equal(other.predict_members(X), plain.predict_members(X))
    np.testing.assert_array_equal(other.predict(X), plain.predict(X))
    np.testing.assert_array_equal(other.predict(X, return_std=True)[0], plain.predict(X))
    np.testing.assert_array_equal(other.residual_std_, plain.residual_std_)
    assert other.n_steps_ == plain.n_steps_
    assert not np.allclose(std_of(other, X), std_of(plain, X), rtol=0.01)


@pytest.mark.parametrize("way", ["stream", "passes", "warm start", "generator"])
def test_the_mean_is_the_same_however_it_is_fitted(way: str) -> None:
    X, y = data(200, noise=0.2)

    def fitted(kind: Any) -> MLPEnsembleRegressor:
        model = small(probabilistic=kind, batch_size=32, n_members=2, warm_start=way[0] == "w")
        if way == "stream":
            return model.fit_stream(clean)
        if way == "generator":
            model.set_params(random_state=np.random.RandomState(0)).fit(X, y)
        for _ in range(3):
            model = model.partial_fit(X, y) if way == "passes" else model.fit(X, y)
        return model

    np.testing.assert_array_equal(fitted("separate").predict(X), fitted(False).predict(X))


# -- weights, seeds, copies ---------------------------------------------------------------


@pytest.mark.parametrize(
    "params",
    [{}, {"n_members": 2, "bootstrap": "row"}, {"bootstrap": "group"}, {"early_stopping": True}],
    ids=str,
)
def test_weights_are_repeated_rows_to_the_bit(params: dict[str, Any]) -> None:
    X, y = data(50, noise=0.3)
    rng = np.random.default_rng(1)
    weight, groups = rng.integers(0, 12, size=50), rng.integers(8, size=50)
    repeated = np.repeat(np.arange(50), weight)[rng.permutation(weight.sum())]
    by_weight = separate(**params).fit(X, y, sample_weight=weight, groups=groups)
    by_rows = separate(**params).fit(X[repeated], y[repeated], groups=groups[repeated])
    np.testing.assert_array_equal(std_of(by_weight, X), std_of(by_rows, X))


@pytest.mark.parametrize("n", [50, 400])
def test_rows_without_weight_might_as_well_not_be_there(n: int) -> None:
    X, y = data(n, noise=0.3)
    weight = np.random.default_rng(0).integers(0, 2, size=n)
    keep = weight > 0
    wild = np.where(keep[:, None], y, 1e6)
    first = separate(batch_size=64).fit(X, wild, sample_weight=weight)
    other = separate(batch_size=64).fit(X[keep], y[keep], sample_weight=weight[keep])
    np.testing.assert_array_equal(std_of(first, X), std_of(other, X))


@pytest.mark.parametrize("stream", [False, True])
def test_weights_decide_how_much_noise_there_is(stream: bool) -> None:
    def draw(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
        X, wild = rng.uniform(-1, 1, (n, 1)), rng.random(n) < 0.5
        noise = np.where(wild, 3.0, 0.3) * rng.normal(size=n)
        return X, noise, np.where(wild, 0.001, 1.0)

    model = separate(max_steps=400)
    if stream:
        model.fit_stream(draw)
    else:
        X, y, weight = draw(2000, np.random.default_rng(1))
        model.fit(X, y, sample_weight=weight)
    np.testing.assert_allclose(std_of(model, GRID), 0.3, rtol=0.25)


def test_a_seed_decides_the_bits() -> None:
    X, y = data(300, noise=0.2)
    first, again, other = (
        std_of(separate(batch_size=32, random_state=seed).fit(X, y), X) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other, rtol=1e-3)


def test_copies_predict_the_same_bits_and_train_on() -> None:
    X, y = data(noise=0.2)
    model = separate(n_members=2).partial_fit(X, y)
    for other in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        np.testing.assert_array_equal(std_of(other, X), std_of(model, X))
        further = std_of(copy.deepcopy(model).partial_fit(X, y), X)
        np.testing.assert_array_equal(std_of(other.partial_fit(X, y), X), further)


def test_a_saved_model_predicts_the_same_bits(tmp_path: Any) -> None:
    from trajlearn._persistence import load, save

    X, y = data(noise=0.2)
    model = separate(n_members=2).fit(X, y)
    save(model, tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(std_of(again, X), std_of(model, X))
    again.set_params(warm_start=True).fit(X, y)


# -- going on, and other kinds ------------------------------------------------------------


@pytest.mark.parametrize("way", ["warm start", "passes"])
def test_going_on_keeps_what_the_variance_has_learned(way: str) -> None:
    X, y, _ = uneven_noise(256, np.random.default_rng(0))
    model = separate(warm_start=True, max_steps=300).fit(X, y)
    before = model.variance_loss_curve_
    assert before.shape == model.loss_curve_.shape
    if way == "passes":
        model.partial_fit(X, y)
    else:
        model.fit(X, y)
    gain = before[0] - before[-1]
    assert (gain > 0.05).all()
    assert (model.variance_loss_curve_[0] < before[-1] + 0.1 * gain).all()


def test_passes_keep_the_moments_of_the_variance() -> None:
    X, y = data(noise=0.3)
    model = separate().partial_fit(X, y).partial_fit(X, y)
    other = copy.deepcopy(model)
    other._variance_moments = [0 * part for part in model._variance_moments]
    assert not np.array_equal(
        std_of(model.partial_fit(X, y), X), std_of(other.partial_fit(X, y), X)
    )


def test_bounds_only_widen_while_training_goes_on() -> None:
    X, y = data(noise=0.3)
    model = separate(warm_start=True).fit(X, y)
    low, high = model.logvar_bounds_
    model.fit(X, y + 20 * (np.arange(60) == 7)[:, None])
    assert (model.logvar_bounds_[1] > high + 1).all()
    np.testing.assert_array_equal(model.logvar_bounds_[0], low)


def test_a_mean_without_variance_goes_on_with_one_and_back() -> None:
    X, y = data(noise=0.3)
    model = small(warm_start=True).fit(X, y)
    loss = model.loss_curve_[-1]
    model.set_params(probabilistic="separate").fit(X, y)
    assert model.loss_curve_[0] < loss + 1e-3
    assert model.variance_coefs_[0].shape == (1, 3, 16)
    model.set_params(probabilistic=False).fit(X, y)
    assert not hasattr(model, "variance_coefs_")
    assert model.logvar_bounds_.size == 0
    np.testing.assert_allclose(std_of(model, X) - model.residual_std_, 0, atol=1e-12)
    for kind in ("separate", False):
        model.set_params(probabilistic=kind, warm_start=True).fit(X, y)
        with pytest.raises(ValueError, match="changed since the last fit"):
            copy.deepcopy(model).set_params(probabilistic=True).fit(X, y)


def test_a_variance_that_was_never_fitted_is_not_made_up() -> None:
    X, y = data()
    model = small().fit(X, y).set_params(probabilistic="separate")
    with pytest.raises(NotFittedError):
        model.predict(X, return_std=True)


@pytest.mark.parametrize("kind", ["joint", "Separate", 1.5, None])
def test_another_kind_is_refused(kind: Any) -> None:
    with pytest.raises(ValueError, match=r"probabilistic.* must be .*'separate'"):
        small(probabilistic=kind).fit(*data())


# -- fast evaluation ----------------------------------------------------------------------


def test_every_way_to_evaluate_gives_means_then_log_variances() -> None:
    X, y = data(noise=0.3)
    model = separate(n_members=2, max_steps=200).fit(X, y)
    predictor = model.predictor()
    outputs = predictor(X)
    assert predictor.n_members == 2
    assert outputs.shape == (2, 60, 4)
    np.testing.assert_array_equal(outputs[..., :2], model.predict_members(X))
    np.testing.assert_array_equal(predictor.own(np.stack([X, X])), outputs)
    rows = np.arange(60)
    joined = predictor.product(X[:, [0, 2]], X[:, [1]], ([0, 2], [1]), (rows, rows))
    np.testing.assert_allclose(joined, outputs, rtol=1e-4, atol=1e-5)
    mean, variance = model.moments(outputs)
    total = variance.mean(axis=0) + mean.var(axis=0)
    np.testing.assert_allclose(std_of(model, X), np.sqrt(total))


def test_residuals_are_computed_for_few_batches_and_each_seen_often(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = []

    def draw(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, None]:
        drawn.append(n)
        return uneven_noise(n, rng)

    separate(max_steps=640).fit_stream(draw)
    # the reference, then 64 steps at once: ten pools for the mean, one more for the variance
    assert len(drawn) == 12
    monkeypatch.setattr(_variance, "_STEPS_A_BATCH", 1)
    drawn.clear()
    separate(max_steps=640).fit_stream(draw)
    assert len(drawn) == 21
