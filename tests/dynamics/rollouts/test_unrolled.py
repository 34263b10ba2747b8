"""Training on roll-outs: gradients that are right, and models that are better far ahead."""

import numpy as np
import pytest
import torch
from sklearn.linear_model import LinearRegression
from sklearn.preprocessing import FunctionTransformer, QuantileTransformer

from tests.dynamics.systems import SMALL, A, B, gain_policy, linear
from trajlearn import (
    BlockScaler,
    MLPEnsembleRegressor,
    OneStepRegressor,
    TrajectoryDataset,
    TransitionRelabeler,
)
from trajlearn.dynamics._query import make_query
from trajlearn.dynamics._rollouts import unrolled as module
from trajlearn.dynamics._rollouts.unrolled import _Trainer
from trajlearn.dynamics._rollouts.unrolled_steps import Stretches, Unrolled
from trajlearn.regressors.control_law import ControlLawRegressor


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr(module, "_STEPS_A_STAGE", 20)


def model(loss_horizon=1, **settings):
    estimator = OneStepRegressor(loss_horizon=loss_horizon, random_state=0, **settings)
    return estimator.set_params(**SMALL, estimator__batch_size=32)


def rich(n=6, **settings):
    """Ragged, with references, a context and irregular times; theta changes."""
    ds = linear(n, shortest=9, longest=14)
    rng = np.random.default_rng(0)
    return TrajectoryDataset.from_arrays(
        [episode.states for episode in ds],
        actions=[episode.actions for episode in ds],
        params=[rng.uniform(0, 0.4, size=(episode.length, 2)) for episode in ds],
        references=[rng.normal(size=(episode.length + 1, 1)) for episode in ds],
        context={"plant": np.array(["a", "b"] * (n // 2))},
        times=[np.cumsum(rng.uniform(0.5, 1.5, size=episode.length + 1)) for episode in ds],
    )


def unrolled(fitted, ds):
    relative = ds
    source, policy = fitted._source(ds, "auto", None)
    return Unrolled(fitted, ds, relative, source, policy, torch.device("cpu"))


def trainer(fitted, ds):
    training = module._training(fitted, ds, None, np.random.default_rng(0))
    ensemble = fitted.estimator_._begun(training)
    return _Trainer(fitted, unrolled(fitted, ds), ensemble, ds)


FORMULATIONS = {
    "logged": {},
    "policy": {"policy": gain_policy},
    "closed loop": {"inputs": "params"},
    "state": {"policy": gain_policy, "target": "state", "clip_states": 0.8},
    "clone": {"policy": "clone", "inputs": ("action", "dt")},
    "all blocks": {
        "inputs": ("action", "params", "dt", "previous", "context", "references"),
        "policy": gain_policy,
    },
    "window": {"history": 3, "inputs": ("action", "dt"), "policy": gain_policy},
    "closed window": {"history": 2, "inputs": ("params", "dt")},
}


def formulation(name, **more):
    settings = dict(FORMULATIONS[name])
    if settings.get("inputs", "action") in ("action", "params") or "dt" not in settings["inputs"]:
        own = settings.get("inputs", "action")
        settings["inputs"] = (own, "dt")
    return model(**settings, **more)


@pytest.mark.parametrize("name", FORMULATIONS)
@pytest.mark.parametrize("start", [0, 4])
def test_paths_are_those_of_forecasts(name, start):
    ds = rich()
    fitted = formulation(name).fit(ds)
    n_steps = int(ds.lengths.min()) - start
    begin = (ds.offsets[:-1] + start)[None]
    stretches = Stretches.of(ds, begin, n_steps)
    train = trainer(fitted, ds)
    with torch.no_grad():
        paths = [after for _, after in train._unrolled.paths(stretches, train._step)]
    found = torch.stack(paths, dim=2)[0].numpy()
    want = fitted.predict(ds, start=start, horizon=n_steps).mean
    np.testing.assert_allclose(found, want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", FORMULATIONS)
def test_gradients_are_those_of_finite_differences(name):
    ds = rich()
    fitted = formulation(name).fit(ds)
    train = trainer(fitted, ds)
    stretches = Stretches.of(ds, (ds.offsets[:-1] + 1)[None], 5)
    network = train._ensemble.network
    direction = torch.as_tensor(np.random.default_rng(0).normal(size=len(network.flat_weights)))
    direction = (direction / direction.norm()).to(torch.float32)
    network.flat_weights.requires_grad_(True)
    train._loss(stretches).sum().backward()
    slope = float(network.flat_weights.grad @ direction)
    network.flat_weights.requires_grad_(False)
    values = []
    for reach in (3e-3, -3e-3):
        network.flat_weights += reach * direction
        values.append(float(train._missed(stretches)[0].sum()))
        network.flat_weights -= reach * direction
    assert slope == pytest.approx((values[0] - values[1]) / 6e-3, rel=0.03, abs=1e-6)


def test_the_slope_of_a_policy_counts():
    """With a policy the gradient is another one than with its actions taken as given."""
    ds = linear(6, shortest=10, longest=12)
    slopes = []
    for policy in (gain_policy, None):
        fitted = model(policy=gain_policy).fit(ds)
        train = trainer(fitted, ds)
        train._unrolled._policy = policy
        train._ensemble.network.flat_weights.requires_grad_(True)
        train._loss(Stretches.of(ds, ds.offsets[:-1][None], 8)).sum().backward()
        slopes.append(train._ensemble.network.flat_weights.grad.clone())
    assert (slopes[0] - slopes[1]).norm() > 0.05 * slopes[0].norm()


def test_stretches_end_with_their_episodes():
    ds = TrajectoryDataset.from_arrays(
        [np.zeros((4, 1)), np.zeros((6, 1))], params=np.zeros((2, 1))
    )
    stretches = Stretches.of(ds, np.array([[1, 4], [2, 8]]), 3)
    assert stretches.episode.tolist() == [0, 1, 0, 1]
    assert stretches.state.T.tolist() == [[1, 2, 2], [4, 5, 6], [2, 2, 2], [8, 8, 8]]
    assert stretches.known.T.tolist() == [[1, 1, 0], [1, 1, 1], [1, 0, 0], [1, 0, 0]]


def test_what_follows_an_episode_is_no_target():
    ds = linear(5, shortest=6, longest=6)
    fitted = model(loss_horizon=16).fit(ds)
    other = ds.concatenate(linear(1, seed=9, shortest=6, longest=6))
    train = trainer(fitted, ds)
    first = Stretches.of(ds, ds.offsets[:-1][None], 16)
    again = Stretches.of(other, other.offsets[:5][None], 16)
    with torch.no_grad():
        losses = [
            train._missed(first)[0].item(),
            _same_weights(train, trainer(fitted, other))._missed(again)[0].item(),
        ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def _same_weights(one, other):
    other._weight = one._weight
    return other


# -- what it is for -----------------------------------------------------------------------


def controlled(n=20, seed=0, length=40):
    """s' = A s + B a with a = -theta s, and the same with noisy states."""
    rng = np.random.default_rng(seed)
    params = rng.uniform(0, 0.4, size=(n, 2))
    states, actions = np.empty((n, length + 1, 2)), np.empty((n, length, 1))
    states[:, 0] = 3 * rng.normal(size=(n, 2))
    for t in range(length):
        actions[:, t] = gain_policy(states[:, t], params, t) + rng.normal(size=(n, 1))
        states[:, t + 1] = states[:, t] @ A.T + actions[:, t] @ B.T
    clean = TrajectoryDataset.from_arrays(states, actions=actions, params=params)
    return clean, clean.add_noise(0.3, random_state=seed)


def noisy(n=20):
    return controlled(n)[1]


@pytest.mark.parametrize("source", ["logged", "policy"])
def test_noise_matters_less_to_roll_outs_than_to_steps(source, monkeypatch):
    monkeypatch.setattr(module, "_STEPS_A_STAGE", 60)
    test, _ = controlled(seed=1)
    truth = np.stack([episode.states[1:] for episode in test])
    settings = {"policy": gain_policy, "rollout_actions": source}
    errors = []
    for horizon in (1, 8):
        fitted = model(horizon, **settings).fit(noisy())
        # far ahead of a start that is known, with the actions that were taken
        missed = np.asarray(fitted.predict(test, actions="logged")) - truth
        errors.append(float((missed**2).mean()))
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.parametrize("probabilistic", [False, True, "separate"])
def test_members_are_trained_together_and_know_their_residuals(probabilistic):
    ds = noisy()
    settings = {"estimator__n_members": 3, "estimator__probabilistic": probabilistic}
    before, after = (model(h).set_params(**settings).fit(ds) for h in (1, 4))
    for member in range(3):
        moved = after.estimator_.coefs_[0][member] - before.estimator_.coefs_[0][member]
        assert np.abs(moved).max() > 1e-3
    rows, targets = TransitionRelabeler().fit_resample(ds)
    mean, std = after.predict(rows, return_std=True)
    missed = np.sqrt(((mean - targets) ** 2).mean())
    assert 0.7 * missed < np.sqrt((std**2).mean()) < 1.4 * missed
    assert not np.allclose(after.estimator_.residual_std_, before.estimator_.residual_std_)


def test_members_get_what_they_would_alone():
    """The gradient of one member has nothing of the others in it."""
    ds = linear(6, shortest=10, longest=12)
    fitted = model(policy=gain_policy).set_params(estimator__n_members=2).fit(ds)
    train = trainer(fitted, ds)
    begin = np.stack([ds.offsets[:-1], ds.offsets[:-1] + 2])
    network = train._ensemble.network
    network.flat_weights.requires_grad_(True)
    train._loss(Stretches.of(ds, begin, 4))[0].backward()
    grads = network.layers_of(network.flat_weights.grad, network.weights)
    assert all(grad[0].abs().max() > 0 and grad[1].abs().max() == 0 for grad in grads)


# -- parameters ---------------------------------------------------------------------------


def test_parameters_change_the_outcome_and_seeds_repeat_it():
    ds = noisy(8)
    settings = [{}, {}, {"loss_horizon": 3}, {"loss_discount": 0.5}]
    found = [np.asarray(model(**({"loss_horizon": 5} | s)).fit(ds).predict(ds)) for s in settings]
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(found[0] - found[2]).max() > 1e-4
    assert np.abs(found[0] - found[3]).max() > 1e-4


def test_a_horizon_of_one_is_the_fit_of_single_steps():
    ds = linear()
    plain = OneStepRegressor(random_state=0).set_params(**SMALL).fit(ds)
    same = OneStepRegressor(loss_horizon=1, loss_discount=0.5, random_state=0).set_params(**SMALL)
    np.testing.assert_array_equal(plain.predict(ds).mean, same.fit(ds).predict(ds).mean)


def test_the_curriculum_doubles_up_to_the_horizon(monkeypatch):
    seen = []
    stage = _Trainer._train_stage
    monkeypatch.setattr(
        _Trainer, "_train_stage", lambda self, s, n: seen.append(n) or stage(self, s, n)
    )
    for horizon in (2, 3, 8, 20):
        model(horizon).fit(linear())
    assert seen == [2, 2, 3, 2, 4, 8, 2, 4, 8, 16, 20]


def test_the_best_weights_of_all_stages_are_kept(monkeypatch):
    """A stage that spoils the network is taken back."""
    ds = noisy(8)

    def spoil(self, starts, n_steps):
        self._ensemble.network.flat_weights += 1.0

    kept = model(4).fit(ds)
    monkeypatch.setattr(_Trainer, "_train_stage", spoil)
    spoilt, plain = model(4).fit(ds), model(1).fit(ds)
    np.testing.assert_array_equal(spoilt.estimator_.coefs_[0], plain.estimator_.coefs_[0])
    assert np.abs(kept.estimator_.coefs_[0] - plain.estimator_.coefs_[0]).max() > 1e-4


def test_gradients_that_are_not_finite_are_left_out():
    fitted = model(policy=gain_policy).fit(linear())
    train = trainer(fitted, linear())
    network = train._ensemble.network
    network.flat_weights.grad.fill_(np.nan)
    network.flat_biases.grad.fill_(5.0)
    train._cut_gradients()
    assert network.flat_weights.grad.abs().max() == 0
    assert torch.isfinite(network.flat_biases.grad).all()


def test_episodes_of_more_weight_are_rolled_out_more_often():
    ds = linear(2, shortest=20, longest=20)
    fitted = model().fit(ds)
    starts = module._Starts(fitted, ds, np.array([1.0, 3.0]), np.random.default_rng(0))
    share = starts.draw(2, 2000, 1).episode.mean()
    assert share == pytest.approx(0.75, abs=0.03)


def test_denoised_models_are_rolled_out_from_smoothed_states(monkeypatch):
    ds = linear(12, shortest=100, longest=100).add_noise(0.5, random_state=0)
    trained_on = []
    monkeypatch.setattr(
        "trajlearn.dynamics.one_step.train_on_rollouts",
        lambda model, ds, weight, rng: trained_on.append(ds),
    )
    fitted = OneStepRegressor(denoise="em", loss_horizon=2, random_state=0)
    fitted.set_params(estimator__hidden_layer_sizes=(16,), estimator__max_steps=300).fit(ds)
    assert fitted.noisy_
    np.testing.assert_allclose(trained_on[0].states, fitted.smooth(ds).states)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e6 / 3])
def test_a_state_that_never_changes_has_no_say(value):
    ds = linear(6, shortest=10, longest=12)
    still = TrajectoryDataset.from_arrays(
        [np.column_stack([e.states, np.full(e.length + 1, value)]) for e in ds],
        actions=[e.actions for e in ds],
    )
    weight = trainer(model().fit(still), still)._weight.numpy()
    np.testing.assert_allclose(weight, [*(1 / ds.states.std(axis=0) ** 2), 0.0])


def test_episodes_of_one_step_are_taken():
    ds = linear(20, shortest=1, longest=1)
    assert np.isfinite(model(4).fit(ds).predict(ds).mean).all()


def test_a_baseline_is_taken_off_states_and_given_back_to_the_policy():
    ds = linear(8, shortest=10, longest=10)
    fitted = model(baseline="mean", inputs=("action", "params", "references"), policy=gain_policy)
    ds = TrajectoryDataset.from_arrays(
        np.stack([episode.states for episode in ds]) + 5.0,
        actions=np.stack([episode.actions for episode in ds]),
        params=ds.params,
        references=np.zeros((8, 11, 1)),
    )
    told = []

    def policy(states, params, times):
        told.append(states.mean())
        return gain_policy(states, params, times)

    fitted.set_params(policy=policy, loss_horizon=4).fit(ds)
    assert np.mean(told) == pytest.approx(5.0, abs=1.0)


# -- what it refuses ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"estimator": LinearRegression()}, "give an MLPEnsembleRegressor, not LinearRegression"),
        ({"estimator": MLPEnsembleRegressor(bootstrap="row")}, "leave bootstrap="),
        ({"estimator": MLPEnsembleRegressor(early_stopping=True)}, "early_stopping="),
        ({"scaler": FunctionTransformer()}, "give a BlockScaler"),
        (
            {"scaler": BlockScaler(state=QuantileTransformer(n_quantiles=10))},
            "one of its parts is not linear",
        ),
        (
            {"policy": "clone", "history": 2, "policy_estimator": ControlLawRegressor()},
            "leave history=2 out",
        ),
    ],
    ids=["learner", "bootstrap", "early stopping", "scaler", "not linear", "clone of a window"],
)
def test_what_has_no_gradient_is_refused(settings, message):
    with pytest.raises(ValueError, match=f"loss_horizon=4 .*{message}"):
        OneStepRegressor(loss_horizon=4, **settings).fit(linear())


def test_rows_are_refused():
    rows = np.random.default_rng(0).normal(size=(20, 3))
    with pytest.raises(ValueError, match="loss_horizon=2 needs episodes"):
        OneStepRegressor(loss_horizon=2).fit(rows, rows[:, :2])


def test_a_cloned_policy_of_a_window_may_be_there_for_forecasts_alone():
    settings = {"policy": "clone", "history": 2, "rollout_actions": "logged"}
    fitted = model(loss_horizon=2, policy_estimator=LinearRegression(), **settings).fit(linear())
    assert np.isfinite(fitted.predict(linear(), actions="policy").mean).any()


def test_queries_begin_where_stretches_do():
    ds = rich()
    query, _ = make_query(ds, 2, 3, within_log=True, within_stretch=False)
    np.testing.assert_array_equal(Stretches.of(ds, query.rows[None], 3).state[0], query.rows)
