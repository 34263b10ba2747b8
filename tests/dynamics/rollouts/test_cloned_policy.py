"""A policy learned from the log: exact for feedback, within its limits, in every roll-out."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.base import clone
from sklearn.linear_model import LinearRegression
from sklearn.neighbors import KNeighborsRegressor

from tests.dynamics.systems import A, B, gain_policy, linear
from trajlearn import (
    LSTMRegressor,
    OneStepRegressor,
    TrajectoryDataset,
    TransitionRelabeler,
    load,
)
from trajlearn.exceptions import MissingFieldError
from trajlearn.regressors.control_law import ControlLawRegressor

# from actions that saturate, the clone and the policy behind it
LIMIT = 0.25


def limited(states, params, times):
    return np.clip(gain_policy(states, params, times), -LIMIT, LIMIT)


def controlled(n=20, *, policy=limited, seed=0, steps=15, params=True, reference=None, **fields):
    """s' = A s + B a under a policy, the gains another in each episode."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.2, 0.9, size=(n, 2))
    states, actions = [rng.normal(size=(n, 2))], []
    for t in range(steps):
        error = states[-1] - (0.0 if reference is None else reference[:, t])
        actions.append(policy(error, theta, np.full(n, float(t))))
        states.append(states[-1] @ A.T + actions[-1] @ B.T)
    if reference is not None:
        fields["references"] = reference
    if params:
        fields["params"] = theta
    return TrajectoryDataset.from_arrays(
        np.stack(states, axis=1), actions=np.stack(actions, axis=1), **fields
    )


def model(**settings):
    return OneStepRegressor(LinearRegression(), policy="clone", random_state=0, **settings)


def test_clone_rolls_out_like_the_policy_behind_the_log():
    train, test = controlled(), controlled(5, seed=1)
    assert (np.abs(train.actions) >= LIMIT).mean() > 0.2
    fitted = model().fit(train)
    forecast = fitted.predict(test)
    assert forecast.actions == "policy"
    assert_allclose(forecast.mean, test.states.reshape(5, 16, 2)[:, 1:], atol=1e-6)
    rng = np.random.default_rng(2)
    states, params = rng.normal(size=(50, 2)), rng.uniform(0.2, 0.9, size=(50, 2))
    cloned = fitted.policy_(states, params, np.zeros(50))
    assert_allclose(cloned, limited(states, params, np.zeros(50)), atol=1e-6)


def test_actions_stay_in_the_range_of_the_log():
    fitted = model(policy_estimator=LinearRegression()).fit(controlled())
    far = fitted.policy_(1e3 * np.ones((1, 2)), np.ones((1, 2)), np.zeros(1))
    assert np.abs(far).max() == LIMIT


def test_policy_estimator_changes_the_forecast():
    train, test = controlled(), controlled(5, seed=1)
    law = model().fit(train).predict(test).mean
    neighbour = model(policy_estimator=KNeighborsRegressor(1)).fit(train).predict(test).mean
    assert np.abs(law - neighbour).max() > 1e-3
    assert np.abs(law - neighbour).max() < 1.0


def test_without_params():
    gains = np.array([0.5, 0.3])

    def fixed(states, params, times):
        return -states @ gains[:, None]

    train, test = (controlled(policy=fixed, seed=s, params=False) for s in (0, 1))
    fitted = model().fit(train)
    assert fitted.policy_.blocks == {"state"}
    # the range of the logged actions is all that is lost
    assert_allclose(fitted.predict(test).mean, test.states.reshape(20, 16, 2)[:, 1:], atol=0.05)
    assert_allclose(fitted.predict(train).mean, train.states.reshape(20, 16, 2)[:, 1:], atol=1e-6)
    empty = np.empty((3, 0))
    assert fitted.policy_(np.zeros((3, 2)), empty, np.zeros(3)).shape == (3, 1)


def test_references_and_context_are_seen():
    rng = np.random.default_rng(3)
    steps = rng.normal(size=(40, 16, 2))
    train = controlled(40, reference=steps, context={"task": ["a", "b"] * 20})
    fitted = model().fit(train)
    assert fitted.policy_.blocks == {"state", "params", "references", "context"}
    # the plant is no function of the reference, and the model did not ask for it
    assert "references" not in fitted.layout_
    test = controlled(5, seed=4, reference=rng.normal(size=(5, 16, 2)), context={"task": ["a"] * 5})
    assert_allclose(fitted.predict(test).mean, test.states.reshape(5, 16, 2)[:, 1:], atol=0.02)
    # known ahead only as far as they are logged
    assert (fitted.predict(test, start=10, horizon=20).lengths == 5).all()
    with pytest.raises(ValueError, match="sees context, references"):
        fitted.policy_(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1))
    with pytest.raises(MissingFieldError, match="needs references"):
        fitted.predict(controlled(5, context={"task": ["a"] * 5}))
    wide = controlled(5, context={"task": ["a"] * 5}).assign(references=np.zeros((5, 16, 3)))
    with pytest.raises(ValueError, match="other references"):
        fitted.predict(wide)


def test_policy_gets_states_not_what_they_are_relative_to():
    train, test = controlled(), controlled(5, seed=1)
    fitted = model(baseline="mean", inputs=("action", "references")).fit(train)
    plain = model().fit(train)
    states, params = test.states[:9], np.full((9, 2), 0.4)
    assert_allclose(
        fitted.policy_(states, params, np.zeros(9)),
        plain.policy_(states, params, np.zeros(9)),
        atol=1e-6,
    )
    assert_allclose(fitted.predict(test).mean, test.states.reshape(5, 16, 2)[:, 1:], atol=1e-5)


def test_references_are_those_logged_not_those_that_tell_a_baseline():
    rng = np.random.default_rng(6)
    train, test = (controlled(n, reference=rng.normal(size=(n, 16, 2)), seed=n) for n in (40, 5))
    fitted = model(baseline="mean", inputs=("action", "references")).fit(train)
    assert fitted.policy_.relabeler.layout_["references"].stop == 8
    assert_allclose(fitted.predict(test).mean, test.states.reshape(5, 16, 2)[:, 1:], atol=0.02)


def test_students_and_searches_take_the_clone():
    from trajlearn import DistilledForecaster
    from trajlearn.control._futures import policy_of

    train = controlled()
    fitted = model(clip_states=3.0).fit(train)
    assert policy_of(fitted, None) is fitted.policy_
    assert policy_of(model(), None) is None
    student = DistilledForecaster(model(clip_states=3.0), n_imagined=20, random_state=0)
    student.set_params(student__estimator__max_steps=20).fit(train)
    assert student.predict(train).mean.shape == (20, 15, 2)


def test_what_follows_the_start_is_not_read():
    train, test = controlled(), controlled(5, seed=1)
    fitted = model().fit(train)
    states, actions = test.states.reshape(5, 16, 2).copy(), test.actions.reshape(5, 15, 1).copy()
    states[:, 5:], actions[:, 4:] = 1e6, -1e6
    other = TrajectoryDataset.from_arrays(states, actions=actions, params=test.params)
    first, second = (fitted.predict(ds, start=4).mean for ds in (test, other))
    assert (first == second).all()


def test_logged_actions_and_given_policies_override_the_clone():
    train, test = controlled(), controlled(5, seed=1)
    fitted = model().fit(train)
    assert fitted.predict(test, actions="logged").actions == "logged"
    still = fitted.predict(test, policy=lambda s, p, t: np.zeros((len(s), 1))).mean
    free = test.states[test.offsets[:-1]]
    for k in range(15):
        free = free @ A.T
        assert_allclose(still[:, k], free, atol=1e-6)
    assert model(rollout_actions="logged").fit(train).predict(test).actions == "logged"


def test_sample_weight_counts_episodes():
    ds, other = controlled(6), controlled(6, seed=5)
    both = ds.concatenate(other)
    learner = LinearRegression()
    weighted = model(policy_estimator=learner).fit(both, sample_weight=np.repeat([1.0, 0.0], 6))
    alone = model(policy_estimator=learner).fit(ds)
    states, params = np.ones((1, 2)), np.full((1, 2), 0.3)
    assert_allclose(
        weighted.policy_(states, params, np.zeros(1)), alone.policy_(states, params, np.zeros(1))
    )
    double = model(policy_estimator=learner).fit(both, sample_weight=np.repeat([3.0, 1.0], 6))
    several = model(policy_estimator=learner).fit(both[[0, 1, 2, 3, 4, 5] * 3 + list(range(6, 12))])
    assert_allclose(
        double.policy_(states, params, np.zeros(1)), several.policy_(states, params, np.zeros(1))
    )


def test_nested_names_reach_the_default():
    estimator = model()
    assert estimator.get_params()["policy_estimator__degree"] == 3
    estimator.set_params(policy_estimator__degree=1)
    assert isinstance(estimator.policy_estimator, ControlLawRegressor)
    train = linear(20, params=True)
    fitted = clone(estimator).fit(train)
    assert fitted.policy_.estimator.degree == 1
    assert "policy_estimator__degree" not in OneStepRegressor().get_params()


def test_pickle_and_save(tmp_path):
    train, test = controlled(), controlled(5, seed=1)
    fitted = OneStepRegressor(policy="clone", random_state=0, relabeler=None)
    fitted.set_params(estimator__max_steps=20, estimator__hidden_layer_sizes=(8,)).fit(train)
    want = fitted.predict(test).mean
    assert (pickle.loads(pickle.dumps(fitted)).predict(test).mean == want).all()
    fitted.save(tmp_path / "model.safetensors")
    assert (load(tmp_path / "model.safetensors").predict(test).mean == want).all()


def test_lstm_clones_too():
    train, test = controlled(), controlled(5, seed=1)
    fitted = LSTMRegressor(hidden_size=4, max_steps=5, policy="clone", random_state=0).fit(train)
    assert fitted.predict(test).actions == "policy"
    states, params = np.array([[0.1, 0.1]]), np.full((1, 2), 0.4)
    assert_allclose(
        fitted.policy_(states, params, np.zeros(1)),
        limited(states, params, np.zeros(1)),
        atol=1e-6,
    )


def test_closed_loop_models_need_no_clone():
    fitted = model(inputs="params").fit(controlled())
    assert not hasattr(fitted, "policy_")
    assert fitted.predict(controlled(5, seed=1)).actions == "none"


def test_errors_say_what_to_do():
    ds = controlled()
    quiet = TrajectoryDataset.from_arrays(ds.states.reshape(20, 16, 2), params=ds.params)
    with pytest.raises(MissingFieldError, match="action"):
        model().fit(quiet)
    with pytest.raises(ValueError, match="policy='clone' needs episodes"):
        model().fit(np.zeros((5, 3)), np.zeros((5, 2)))
    late = OneStepRegressor(LinearRegression()).fit(ds).set_params(policy="clone")
    with pytest.raises(ValueError, match="fit it again"):
        late.predict(ds)
    with pytest.raises(ValueError, match="expected \\(n, 2\\)"):
        model().fit(ds).policy_(np.zeros((3, 2)), np.zeros((3, 1)), np.zeros(3))


def test_a_second_fit_without_forgets_the_clone():
    fitted = model().fit(controlled())
    fitted.set_params(policy=None).fit(controlled())
    assert not hasattr(fitted, "policy_")


def test_a_second_fit_on_rows_forgets_the_clone():
    fitted = model().fit(controlled())
    rows, targets = TransitionRelabeler().fit_resample(controlled())
    fitted.set_params(policy=None).fit(rows, targets)
    assert not hasattr(fitted, "policy_")


@pytest.mark.parametrize(("n", "steps"), [(1, 15), (3, 1), (1, 1)])
def test_few_and_short_episodes(n, steps):
    ds = controlled(n, steps=steps)
    forecast = model().fit(ds).predict(ds)
    assert forecast.mean.shape == (n, steps, 2)
    assert np.isfinite(forecast.mean).all()


@pytest.mark.parametrize(("unit", "of_actions"), [(1e6, 1e-6), (1e-6, 1e6)])
def test_units_do_not_matter(unit, of_actions):
    scaled = [
        TrajectoryDataset.from_arrays(
            [e.states * unit for e in ds],
            actions=[e.actions * of_actions for e in ds],
            params=ds.params,
        )
        for ds in (controlled(), controlled(5, seed=1))
    ]
    fitted = model().fit(scaled[0])
    assert fitted.policy_.estimator.exact_.all()
    truth = scaled[1].states.reshape(5, 16, 2)[:, 1:]
    assert_allclose(fitted.predict(scaled[1]).mean / unit, truth / unit, atol=1e-6)


def test_a_controller_that_does_nothing():
    ds = controlled(policy=lambda s, p, t: np.full((len(s), 1), 0.1))
    cloned = model().fit(ds).policy_
    assert_allclose(cloned(np.ones((3, 2)), np.ones((3, 2)), np.zeros(3)), 0.1)
