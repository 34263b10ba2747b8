"""Models that see the last k states: for plants whose state is logged in part."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.linear_model import LinearRegression

from trajlearn import OneStepRegressor, TrajectoryDataset, TransitionRelabeler
from trajlearn.dynamics._query import make_query
from trajlearn.dynamics._rollouts.window import Window
from trajlearn.exceptions import InvalidEpisodeError, MissingFieldError

DT = 0.1


def masses(n=20, *, seed=0, steps=30, shortest=None, policy=True, **fields):
    """Positions of a mass that is pushed: x' = x + dt v, v' = v + dt a; velocities not logged."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.5, 2.0, size=(n, 2))
    lengths = rng.integers(shortest or steps, steps + 1, size=n)
    states, actions = [], []
    for i in range(n):
        x, v, own, pushed = rng.normal(), rng.normal(), [], []
        for _ in range(lengths[i]):
            a = -theta[i] @ [x, v] if policy else rng.normal()
            own.append([x])
            pushed.append([a])
            x, v = x + DT * v, v + DT * a
        states.append([*own, [x]])
        actions.append(pushed)
    return TrajectoryDataset.from_arrays(states, actions=actions, params=theta, dt=DT, **fields)


def model(history=1, **settings):
    return OneStepRegressor(LinearRegression(), history=history, random_state=0, **settings)


def test_rows_are_differences_and_actions_padded_at_the_start():
    states = np.array([[[1.0], [3.0], [4.0], [9.0]], [[5.0], [5.5], [7.0], [8.0]]])
    actions = np.array([[[10.0], [20.0], [30.0]], [[40.0], [50.0], [60.0]]])
    ds = TrajectoryDataset.from_arrays(states, actions=actions)
    relabeler = TransitionRelabeler(history=3)
    rows, targets = relabeler.fit_resample(ds)
    assert list(relabeler.layout_) == ["state", "action", "past_states", "past_actions"]
    assert relabeler.get_feature_names_out().tolist() == [
        *("s0", "a0", "change of s0-1", "change of s0-2", "a0-1", "a0-2")
    ]
    assert rows.tolist() == [
        [1, 10, 0, 0, 0, 0],
        [3, 20, 2, 0, 10, 0],
        [4, 30, 1, 2, 20, 10],
        [5, 40, 0, 0, 0, 0],
        [5.5, 50, 0.5, 0, 40, 0],
        [7, 60, 1.5, 0.5, 50, 40],
    ]
    assert targets.ravel().tolist() == [3, 4, 9, 5.5, 7, 8]


def test_closed_loop_sees_no_actions():
    relabeler = TransitionRelabeler(inputs="params", history=2).fit(masses())
    assert list(relabeler.layout_) == ["state", "params", "past_states"]


@pytest.mark.parametrize("actions", ["logged", "policy"])
def test_hidden_velocities_are_found_exactly(actions):
    """x' = 2 x - x_before + dt^2 a_before; the action follows from what that says of v."""
    train, test = masses(), masses(6, seed=1)
    policy = "clone" if actions == "policy" else None
    truth = test.states.reshape(6, 31)
    full = {"relabeler": TransitionRelabeler(history=2, pad=False)}
    forecast = model(policy=policy, **full).fit(train).predict(test, start=3)
    assert forecast.actions == actions
    assert_allclose(forecast.mean[..., 0], truth[:, 4:], atol=1e-4)
    blind = model(policy=policy).fit(train).predict(test, start=3)
    assert np.abs(blind.mean[..., 0] - truth[:, 4:]).mean() > 0.05


def test_padded_rows_tell_what_to_expect_of_an_episode_that_has_only_begun():
    """Pushed before the log began, all at a speed of 1."""
    rng = np.random.default_rng(0)
    start, t = rng.normal(size=(30, 1, 1)), DT * np.arange(9)[:, None]
    ds = TrajectoryDataset.from_arrays(start + t, dt=DT)

    def first_step(pad):
        relabeler = TransitionRelabeler(inputs=(), history=2, pad=pad)
        return model(relabeler=relabeler).fit(ds).predict(ds, horizon=1).mean[..., 0]

    still = ds.states.reshape(30, 9)[:, :1]
    assert_allclose(first_step(True) - still, DT, atol=1e-6)
    with pytest.raises(InvalidEpisodeError, match="no episode has the 4 states"):
        TransitionRelabeler(inputs=(), history=3, pad=False).fit_resample(ds.truncate(2))
    rows, _ = TransitionRelabeler(inputs=(), history=3, pad=False).fit_resample(ds)
    assert len(rows) == 30 * 6
    assert_allclose(rows[:, 1:], DT)


def test_window_of_a_roll_out_is_that_of_the_rows():
    """Teacher forcing: rows that a roll-out builds along the log are the relabeler's."""
    ds = masses(3, policy=False)
    relabeler = TransitionRelabeler(history=4)
    rows, _ = relabeler.fit_resample(ds)
    query, _ = make_query(ds, 2, None, within_log=True, within_stretch=False)
    window = Window(4, 1, 1)
    carried = window.before(query)
    states, actions = ds.states.reshape(3, 31, 1), ds.actions.reshape(3, 30, 1)
    for t in range(2, 30):
        blocks = window.blocks(carried, states[:, t])
        want = rows.reshape(3, 30, -1)[:, t]
        for name in ("past_states", "past_actions"):
            assert_allclose(blocks[name], want[:, relabeler.layout_[name]], atol=1e-12)
        carried = window.after(carried, states[:, t], actions[:, t])


def test_history_before_the_start_is_read_and_nothing_after():
    train, test = masses(shortest=20), masses(4, seed=1)
    fitted = model(3, policy="clone").fit(train)
    before = fitted.predict(test, start=5).mean
    states, actions = test.states.reshape(4, 31, 1).copy(), test.actions.reshape(4, 30, 1).copy()
    states[:, 6:], actions[:, 5:] = 1e6, -1e6

    def changed():
        return TrajectoryDataset.from_arrays(states, actions=actions, params=test.params, dt=DT)

    assert (fitted.predict(changed(), start=5).mean == before).all()
    states[:, 2], actions[:, 2] = 7.0, 7.0  # beyond the window
    assert (fitted.predict(changed(), start=5).mean == before).all()
    states[:, 3] += 0.1
    assert not (fitted.predict(changed(), start=5).mean == before).any()
    states[:, 3] -= 0.1
    actions[:, 3] += 0.1
    assert not (fitted.predict(changed(), start=5).mean == before).any()


def test_starts_are_independent_and_particles_carry_their_own():
    train, test = masses(), masses(4, seed=1)
    fitted = model(3, policy="clone").fit(train)
    together = fitted.predict(test, start=[0, 1, 5, 9]).mean
    for i, start in enumerate([0, 1, 5, 9]):
        alone = fitted.predict(test[i : i + 1], start=start).mean[0]
        assert_allclose(together[i, : len(alone)], alone, rtol=1e-12)
    network = OneStepRegressor(history=2, policy="clone", random_state=0)
    network.set_params(estimator__max_steps=50, estimator__hidden_layer_sizes=(8,))
    samples = network.fit(train).predict(test, n_samples=5, random_state=0).samples
    assert samples.shape == (5, 4, 30, 1)
    assert (samples.std(axis=0)[:, -1] > 0).all()


def test_given_policy_gets_the_newest_state():
    train, test, asked = masses(), masses(4, seed=1), []

    def policy(states, params, times):
        asked.append(states.shape)
        return -states

    model(3, policy=policy).fit(train).predict(test)
    assert set(asked) == {(4, 1)}


def test_baseline_and_planning():
    train = masses()
    relative = model(2, policy="clone", baseline="mean", inputs=("action", "references"))
    with pytest.raises(ValueError, match="Leave one of the three out"):
        relative.fit(train)
    plan = (
        model(2, policy="clone")
        .fit(train)
        .predict_trajectory([[1.0]], params=[[1.0, 1.0]], horizons=[DT, 5 * DT])
    )
    assert plan.mean.shape == (1, 2, 1)


def test_what_cannot_work_is_refused():
    train = masses()
    with pytest.raises(ValueError, match="shows the model several"):
        model(2, propagation="moment", policy="clone").fit(train).predict(train)
    with pytest.raises(ValueError, match="history=2 needs episodes"):
        model(2).fit(np.zeros((5, 2)), np.zeros(5))
    with pytest.raises(ValueError, match="denoise"):
        model(2, denoise="em").fit(train)
    with pytest.raises(ValueError, match='"previous"'):
        model(2, inputs=("action", "previous")).fit(train)
    with pytest.raises(ValueError, match='only where "action" is an input'):
        model(2, inputs=("params", "past_actions")).fit(masses())
    with pytest.raises(ValueError, match="needs history="):
        model(1, inputs=("action", "past_states")).fit(train)
    without = TrajectoryDataset.from_arrays(train.states.reshape(20, 31, 1), params=train.params)
    with pytest.raises(MissingFieldError, match="actions before"):
        model(2, policy="clone").fit(train).predict(
            TrajectoryDataset.from_arrays(
                train.states.reshape(20, 31, 1), params=train.params, dt=DT
            ),
            start=4,
        )
    with pytest.raises(MissingFieldError):
        model(2, policy="clone").fit(without)


@pytest.mark.parametrize("settings", [{"history": 3}, {"inputs": ("action", "previous")}])
def test_past_actions_are_those_of_training(settings):
    train, test = masses(), masses(4, seed=1)

    def still(states, params, times):
        return np.zeros((len(states), 2))

    two = [np.hstack([e.actions, e.actions**2]) for e in train]
    fitted = model(policy=still, **settings).fit(train.assign(actions=two))
    assert fitted.predict(test, horizon=2).actions == "policy"
    with pytest.raises(ValueError, match="have 1 actions, the model was fitted on 2"):
        fitted.predict(test, start=5)
    none = TrajectoryDataset.from_arrays([e.states for e in test], params=test.params, dt=DT)
    with pytest.raises(MissingFieldError, match="no actions before the start"):
        fitted.predict(none, start=5)


def test_episodes_shorter_than_the_window():
    short = masses(6, steps=2, shortest=1)
    fitted = model(5).fit(short)
    assert np.isfinite(fitted.predict(short, horizon=1).mean).all()
    assert fitted.predict(short[short.lengths == 2], start=1).mean.shape[1:] == (1, 1)
