"""Ensembles trained as one network are what they are when they are trained alone."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.linear_model import LinearRegression

from tests.regressors.small_mlp import clean, data, small
from trajlearn.regressors import _joint, _trained
from trajlearn.regressors._joint import can_join, fit_jointly

KINDS = [
    {},
    {"n_members": 3, "weight_decay": 0.3},
    {"probabilistic": True, "n_members": 2},
    {"probabilistic": "separate", "schedule": "constant"},
]
ARRAYS = ("coefs_", "intercepts_", "residual_std_", "target_mean_", "loss_curve_", "_moments")


@pytest.fixture(autouse=True)
def few_reference_rows(monkeypatch):
    monkeypatch.setattr(_trained, "REFERENCE_ROWS", 500)


def on_rows(X, y, weight=None):
    return lambda learner: learner._on_rows(X, y, weight, None)


def parts(n_parts=3, n=600):
    """Overlapping parts of rows, with other means and scales of the targets."""
    X, y = data(n)
    return [(X[i * 50 : n - 100], (i + 1) * y[i * 50 : n - 100] - i) for i in range(n_parts)]


def assert_alike(one, other, **tolerance):
    for name in ARRAYS + ("variance_coefs_", "logvar_bounds_") * hasattr(one, "variance_coefs_"):
        for a, b in zip(getattr(one, name), getattr(other, name), strict=True):
            np.testing.assert_allclose(a, b, err_msg=name, **tolerance)


@pytest.mark.parametrize("kind", KINDS)
def test_each_learner_becomes_what_it_is_alone(kind):
    learners = [small(random_state=i, batch_size=64, **kind) for i in range(3)]
    alone = [clone(learner).fit(*part) for learner, part in zip(learners, parts())]
    fit_jointly(learners, [on_rows(*part) for part in parts()])
    X = data(50, seed=1)[0]
    for one, other in zip(alone, learners):
        assert_alike(one, other, rtol=1e-4, atol=1e-5)
        for a, b in zip(one.predict(X, return_std=True), other.predict(X, return_std=True)):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    assert np.abs(learners[0].coefs_[0] - learners[1].coefs_[0]).max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_one_by_itself_gets_the_same_bits(kind):
    one, other = small(batch_size=64, **kind), small(batch_size=64, **kind)
    one.fit(*data(300))
    fit_jointly([other], [on_rows(*data(300))])
    assert_alike(one, other, rtol=0, atol=0)


def test_streams_are_drawn_from_apart():
    learners = [small(random_state=i, n_members=2) for i in range(2)]
    draws = [clean, lambda n, rng: (lambda X, y, w: (X, -y, np.ones(n)))(*clean(n, rng))]
    alone = [clone(one).fit_stream(draw, n_rows=500) for one, draw in zip(learners, draws)]
    fit_jointly(
        learners,
        [lambda learner, draw=draw: learner._on_stream(draw, None, 500) for draw in draws],
    )
    for one, other in zip(alone, learners):
        assert_alike(one, other, rtol=1e-4, atol=1e-5)


def test_all_take_the_steps_of_the_longest():
    learners = [small(random_state=i, max_steps=steps) for i, steps in enumerate((20, 50))]
    fit_jointly(learners, [on_rows(*part) for part in parts(2)])
    assert [learner.n_steps_ for learner in learners] == [50, 50]
    alone = small(random_state=0, max_steps=50).fit(*parts(2)[0])
    assert_alike(alone, learners[0], rtol=1e-4, atol=1e-5)


def test_a_variance_may_be_left_out_for_some():
    learners = [small(random_state=0), small(random_state=0, probabilistic="separate")]
    assert can_join(learners)
    fit_jointly(learners, [on_rows(*data(400))] * 2)
    np.testing.assert_allclose(learners[0].coefs_[0], learners[1].coefs_[0], atol=1e-6)
    assert not hasattr(learners[0], "variance_coefs_")
    alone = small(random_state=0, probabilistic="separate").fit(*data(400))
    assert_alike(alone, learners[1], rtol=1e-4, atol=1e-5)


def test_batches_of_other_sizes_are_trained_apart(monkeypatch):
    groups = []
    together = _joint._train_together
    monkeypatch.setattr(
        _joint, "_train_together", lambda e, *rest: groups.append(len(e)) or together(e, *rest)
    )
    learners = [small(random_state=i, batch_size=100) for i in range(4)]
    sizes = [300, 60, 400, 80]  # those of at most 100 rows are seen whole
    weights = [None, np.arange(60.0), None, None]
    jobs = [on_rows(*data(n), weight) for n, weight in zip(sizes, weights)]
    fit_jointly(learners, jobs)
    assert sorted(groups) == [1, 1, 2]
    for learner, n, weight in zip(learners, sizes, weights):
        alone = clone(learner).fit(*data(n), sample_weight=weight)
        assert_alike(alone, learner, rtol=1e-4, atol=1e-5)


def test_weights_of_one_learner_are_not_those_of_another():
    weights = [np.repeat([1.0, 3.0], 30), None]
    learners = [small(random_state=i) for i in range(2)]
    fit_jointly(learners, [on_rows(*data(60), weight) for weight in weights])
    for learner, weight in zip(learners, weights):
        alone = clone(learner).fit(*data(60), sample_weight=weight)
        assert_alike(alone, learner, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "other",
    [
        small(hidden_layer_sizes=(8,)),
        small(learning_rate=1e-2),
        small(probabilistic=True),
        small(early_stopping=True),
        small(bootstrap="row"),
        small(warm_start=True),
        LinearRegression(),
    ],
    ids=["width", "rate", "loss", "stops early", "bootstrap", "goes on", "no network"],
)
def test_those_that_do_not_go_together_are_told(other):
    assert can_join([small(), small(random_state=7, max_steps=9, n_members=2)])
    assert not can_join([small(), other])


def test_training_that_diverges_is_an_error_here_too():
    X, y = data(300)
    with pytest.raises(ValueError, match="training diverged"):
        fit_jointly([small(learning_rate=1e3), small(learning_rate=1e3)], [on_rows(X, y)] * 2)
