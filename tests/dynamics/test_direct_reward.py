"""Direct reward models: one number an episode, from its first state and theta alone."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.metrics import r2_score
from sklearn.preprocessing import FunctionTransformer

from trajlearn import (
    BlockScaler,
    DirectRewardGP,
    DirectRewardNN,
    EpisodeRelabeler,
    GPRegressor,
    MLPEnsembleRegressor,
    TrajectoryDataset,
)
from trajlearn.exceptions import MissingFieldError

FAST = {"estimator__hidden_layer_sizes": (16,), "estimator__max_steps": 300}


def decays(n=40, *, seed=0, steps=6, lengths=None, **fields):
    """s' = theta s; the logged reward of a step is -s^2 of the state it leads into."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.3, 0.9, size=n)
    lengths = np.full(n, steps) if lengths is None else np.asarray(lengths)
    first = rng.uniform(-1, 1, size=n)
    states = [s * th ** np.arange(t + 1)[:, None] for s, th, t in zip(first, theta, lengths)]
    rewards = [-(s[1:, 0] ** 2) for s in states]
    return TrajectoryDataset.from_arrays(states, params=theta[:, None], rewards=rewards, **fields)


def squared(states):
    return -(states[..., 0] ** 2)


def means(ds):
    return np.array([e.rewards.mean() for e in ds])


@pytest.mark.parametrize(
    ("model", "least"),
    [
        (DirectRewardGP(GPRegressor(n_restarts=0), random_state=0), 0.99),
        (DirectRewardNN(random_state=0), 0.85),
    ],
)
def test_the_mean_reward_is_learned_and_the_score_is_r2(model, least):
    train, test = decays(60), decays(30, seed=1)
    predicted = model.fit(train).predict(test)
    assert predicted.shape == (30,)
    assert np.isclose(model.score(test), r2_score(means(test), predicted))
    assert model.score(test) > least
    mean, std = model.predict(test, return_std=True)
    np.testing.assert_array_equal(mean, predicted)
    assert np.mean(np.abs(mean - means(test)) < 3 * std) > 0.85


def test_mean_and_std_are_in_units_of_the_reward():
    train, test = decays(20), decays(5, seed=1)
    once, tenfold = (
        DirectRewardGP(
            GPRegressor(n_restarts=0), reward=lambda s, k=k: -k * s[..., 0] ** 2, random_state=0
        )
        .fit(train)
        .predict(test, return_std=True)
        for k in (1.0, 10.0)
    )
    np.testing.assert_allclose(tenfold[0], 10 * once[0], rtol=1e-3)
    np.testing.assert_allclose(tenfold[1], 10 * once[1], rtol=1e-3)


def test_a_reward_function_of_the_states_is_as_good_as_the_log():
    train, test = decays(), decays(10, seed=1)
    by_log, by_function = (
        DirectRewardGP(GPRegressor(n_restarts=0), reward=reward, random_state=0).fit(train)
        for reward in (None, squared)
    )
    np.testing.assert_allclose(by_log.predict(test), by_function.predict(test), atol=1e-9)
    assert np.isclose(by_log.score(test), by_function.score(test))


@pytest.mark.parametrize("Model", [DirectRewardGP, DirectRewardNN])
def test_crashing_early_never_pays(Model):
    lengths = [6, 6, 2, 6] * 5
    crashed = np.array(lengths) == 2
    ds = decays(20, lengths=lengths, terminated=crashed)
    with pytest.raises(ValueError, match="terminal_reward"):
        Model().fit(ds)
    model = Model(terminal_reward=-9.0)
    rewards = EpisodeRelabeler(terminal_reward=-9.0).fit_resample(ds)[1]
    expected = [(e.rewards.sum() - 9.0 * (6 - e.length)) / 6 for e in ds]
    np.testing.assert_allclose(rewards, expected)
    assert (rewards[crashed] < -5).all()
    model.set_params(estimator=LinearRegression()).fit(ds)
    assert np.isclose(model.score(ds), r2_score(expected, model.predict(ds)))
    cut = decays(20, lengths=lengths)  # not terminated: what is missing is unknown
    with pytest.raises(ValueError, match="did not terminate by itself"):
        model.fit(cut)
    model.set_params(horizon=2).fit(cut)
    assert np.isclose(model.relabeler_.targets(cut)[0], cut[0].rewards[:2].mean())


@pytest.mark.parametrize(
    "change",
    [
        {"estimator": LinearRegression()},
        {"relabeler": EpisodeRelabeler(horizon=2)},
        {"relabeler__inputs": ("params",)},
        {"scaler": FunctionTransformer(np.square)},
        {"scaler__state": FunctionTransformer(np.square)},
        {"reward": lambda states: states[..., 0]},
        {"horizon": 3},
        {"random_state": 1},
    ],
    ids=lambda change: "+".join(change),
)
def test_every_parameter_changes_the_prediction(change):
    nn = DirectRewardNN(random_state=0).set_params(**FAST)
    changed = DirectRewardNN(random_state=0).set_params(
        **({} if "estimator" in change else FAST) | change
    )
    train, test = decays(), decays(8, seed=1)
    assert not np.array_equal(nn.fit(train).predict(test), changed.fit(train).predict(test))


def test_own_parameters_are_set_before_the_default_that_uses_them():
    model = DirectRewardGP().set_params(relabeler__horizon=2, reward=squared)
    assert model.relabeler.reward is squared
    model = DirectRewardNN().set_params(relabeler__inputs=("state",), terminal_reward=-1.0)
    assert model.relabeler.terminal_reward == -1.0


def test_the_reward_may_name_actions_references_and_times():
    base = decays(6, steps=4)
    ds = TrajectoryDataset.from_arrays(
        [e.states for e in base],
        actions=[np.full((4, 1), 2.0)] * 6,
        references=[np.full((5, 1), 3.0)] * 6,
        params=base.params,
        dt=0.5,
    )

    def reward(states, actions, references, times):
        return actions[..., 0] + references[..., 0] + times

    targets = EpisodeRelabeler(reward=reward).fit_resample(ds)[1]
    np.testing.assert_allclose(targets, 2 + 3 + np.mean([0.5, 1.0, 1.5, 2.0]))
    with pytest.raises(MissingFieldError, match=r"\['actions'\]"):
        DirectRewardGP(reward=lambda states, actions: actions[..., 0]).fit(base)


def test_nothing_but_the_first_state_and_theta_is_read():
    model = DirectRewardNN(random_state=0).set_params(**FAST).fit(decays())
    test = decays(8, seed=1)
    rows = np.hstack([test.states[test.offsets[:-1]], test.params])
    np.testing.assert_array_equal(model.predict(test), model.predict(rows))
    bare = TrajectoryDataset.from_arrays(
        [np.vstack([e.states[:1], 7e3 * np.ones((3, 1))]) for e in test], params=test.params
    )
    np.testing.assert_array_equal(model.predict(test), model.predict(bare))


def test_theta_may_change_on_the_way_and_the_first_counts():
    ds = decays(12)
    changing = TrajectoryDataset.from_arrays(
        [e.states for e in ds],
        params=[np.vstack([[e.params]] * 2 + [[e.params + 1]] * 4) for e in ds],
        rewards=[e.rewards for e in ds],
    )
    model = DirectRewardGP(LinearRegression())
    np.testing.assert_allclose(model.fit(changing).predict(changing), model.fit(ds).predict(ds))


def test_weights_and_groups_reach_the_network():
    ds, test = decays(20), decays(5, seed=1)
    model = DirectRewardNN(random_state=0).set_params(**FAST)
    weight = np.arange(20) % 3.0
    repeated = ds[np.repeat(np.arange(20), weight.astype(int))]
    np.testing.assert_allclose(
        model.fit(ds, sample_weight=weight).predict(test),
        model.fit(repeated).predict(test),
        rtol=1e-5,
    )
    model.set_params(estimator__early_stopping=True, estimator__validation_fraction=0.5)
    by_episode = model.fit(ds).predict(test)
    by_group = model.fit(ds, groups=np.arange(20) // 5).predict(test)
    assert not np.array_equal(by_episode, by_group)


@pytest.mark.parametrize("Model", [DirectRewardGP, DirectRewardNN])
def test_errors_name_what_is_wrong(Model):
    ds = decays(8)
    bare = TrajectoryDataset.from_arrays([e.states for e in ds], params=ds.params)
    with pytest.raises(MissingFieldError, match="rewards"):
        Model().fit(bare)
    with pytest.raises(ValueError, match="y must be omitted"):
        Model().fit(ds, np.zeros(8))
    model = Model(LinearRegression()).fit(ds)
    with pytest.raises(ValueError, match="y must be omitted"):
        model.score(ds, np.zeros(8))
    with pytest.raises(ValueError, match="0 params columns, the model was fitted on 1"):
        model.predict(TrajectoryDataset.from_arrays([e.states for e in ds]))
    with pytest.raises(ValueError, match="2 state columns, the model was fitted on 1"):
        model.predict(TrajectoryDataset.from_arrays(np.zeros((2, 3, 2)), params=np.zeros((2, 1))))
    with pytest.raises(ValueError, match="NaN"):
        Model(LinearRegression(), reward=lambda s: s[..., 0] * np.nan).fit(ds)
    with pytest.raises(ValueError, match="expected"):
        Model(LinearRegression(), reward=lambda s: s).fit(ds)


def test_a_constant_theta_that_changes_by_a_tenth_moves_the_prediction_little():
    ds = decays(20)
    constant = TrajectoryDataset.from_arrays(
        [e.states for e in ds], params=np.full((20, 1), 1e8), rewards=[e.rewards for e in ds]
    )
    later = TrajectoryDataset.from_arrays(
        [e.states for e in ds], params=np.full((20, 1), 1.1e8), rewards=[e.rewards for e in ds]
    )
    learner = MLPEnsembleRegressor(hidden_layer_sizes=(16,), max_steps=100)
    model = DirectRewardNN(learner, scaler=BlockScaler(), random_state=0).fit(constant)
    moved = np.abs(model.predict(later) - model.predict(constant)).max()
    assert 0 < moved < np.ptp(means(ds))
