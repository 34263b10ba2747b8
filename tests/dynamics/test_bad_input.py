"""Bad input, and input that is merely unusual: a clear error or a stated behaviour for each."""

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from tests.dynamics.systems import SMALL, Affine, linear
from trajlearn import (
    CalibratedForecaster,
    DirectRewardGP,
    DirectRewardNN,
    HorizonSelector,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    Trajectory,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.exceptions import InvalidEpisodeError, MissingFieldError


def position(states):
    return states[..., 0]


def models():
    return [
        TrajectoryRegressor(random_state=0).set_params(**SMALL),
        OneStepRegressor(random_state=0).set_params(**SMALL),
        OneStepRegressor(inputs="params", random_state=0).set_params(**SMALL),
        DirectRewardGP(reward=position, random_state=0).set_params(estimator__n_restarts=0),
        DirectRewardNN(reward=position, random_state=0).set_params(**SMALL),
    ]


EVERY_MODEL = pytest.mark.parametrize("model", models(), ids=["T", "D", "C", "GP", "NN"])


def equal(n=8, **settings):
    return linear(n, shortest=6, longest=6, **settings)


@EVERY_MODEL
def test_before_fit_there_is_nothing_to_predict(model):
    with pytest.raises(NotFittedError):
        model.predict(equal())
    with pytest.raises(NotFittedError):
        model.predict(np.zeros((2, 5)))


@EVERY_MODEL
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_state_is_found_when_the_episode_is_built(model, bad):
    states = equal()[0].states.copy()
    states[3, 1] = bad
    with pytest.raises(InvalidEpisodeError, match=r"states is (nan|inf) at row 3, column 1"):
        model.fit([Trajectory(states, params=[0.0, 0.0])])


@pytest.mark.parametrize("wrong", [-1, 2.5, True, "many"])
@pytest.mark.parametrize("kind", ["T", "D", "selector", "calibrated"])
def test_a_number_of_samples_that_is_none(kind, wrong):
    ds = equal(12)
    member = OneStepRegressor(LinearRegression())
    model = {
        "T": TrajectoryRegressor(LinearRegression()),
        "D": member,
        "selector": HorizonSelector([("D", member)]),
        "calibrated": CalibratedForecaster(member),
    }[kind].fit(ds)
    with pytest.raises(ValueError, match="give the number of trajectories"):
        model.predict(ds, n_samples=wrong)
    given = {"actions": ds[0].actions[None, :2]} if kind != "T" else {}
    with pytest.raises(ValueError, match="give the number of trajectories"):
        model.predict_trajectory(
            ds[0].states[:1], horizons=[1.0, 2.0], params=ds.params[:1], n_samples=wrong, **given
        )


@pytest.mark.parametrize("none", [0, None])
def test_no_samples_may_be_asked_for(none):
    ds = equal()
    model = OneStepRegressor(LinearRegression()).fit(ds)
    assert model.predict(ds, n_samples=none).samples is None


@EVERY_MODEL
def test_no_episodes(model):
    with pytest.raises(InvalidEpisodeError, match="X is empty: give at least one episode"):
        model.fit([])
    with pytest.raises(InvalidEpisodeError, match="the dataset is empty"):
        model.fit(TrajectoryDataset([]))


@EVERY_MODEL
def test_not_episodes_at_all(model):
    with pytest.raises((TypeError, ValueError)):
        model.fit("episodes.csv")
    with pytest.raises((TypeError, ValueError)):
        model.fit(equal()).predict(None)


@EVERY_MODEL
def test_one_episode_of_one_step_is_enough(model):
    ds = TrajectoryDataset.from_arrays(
        [[[0.0, 1.0], [1.0, 3.0]]], actions=[[[1.0]]], params=[[0.1, 0.2]]
    )
    found = np.asarray(model.fit(ds).predict(ds))
    assert np.isfinite(found).all()
    assert found.shape in ((1,), (1, 1, 2))


@EVERY_MODEL
@pytest.mark.parametrize("dtype", [np.float32, np.int64])
def test_other_numbers_become_float64(model, dtype):
    ds = equal()
    rounded = [np.round(8 * e.states).astype(dtype) for e in ds]
    actions = [np.round(8 * e.actions).astype(dtype) for e in ds]
    first, second = (
        np.asarray(model.fit(data).predict(data))
        for data in (
            TrajectoryDataset.from_arrays(rounded, actions=actions, params=ds.params),
            TrajectoryDataset.from_arrays(
                [s.astype(float) for s in rounded],
                actions=[a.astype(float) for a in actions],
                params=ds.params,
            ),
        )
    )
    assert first.dtype == np.float64
    np.testing.assert_array_equal(first, second)


@EVERY_MODEL
@pytest.mark.parametrize("value", [0.0, 1e8, -3.0])
def test_a_constant_theta_may_change_by_a_tenth_later(model, value):
    ds = equal()
    fields = {"actions": [e.actions for e in ds]}
    before, after = (
        TrajectoryDataset.from_arrays([e.states for e in ds], params=np.full((8, 2), v), **fields)
        for v in (value, 1.1 * value if value else 0.1)
    )
    model.fit(before)
    moved = np.abs(np.asarray(model.predict(after)) - np.asarray(model.predict(before))).max()
    assert moved < np.ptp(ds.states)


@EVERY_MODEL
def test_a_state_that_never_changes_is_predicted_as_it_is(model):
    ds = equal()
    states = [np.hstack([e.states, np.full((7, 1), 2.5)]) for e in ds]
    still = TrajectoryDataset.from_arrays(states, actions=[e.actions for e in ds], params=ds.params)
    found = np.asarray(model.fit(still).predict(still))
    assert np.isfinite(found).all()
    if found.ndim == 3:
        np.testing.assert_allclose(found[:, :, 2], 2.5, atol=1e-9)
        assert np.isfinite(model.score(still))


@EVERY_MODEL
def test_no_params_at_all(model):
    ds = linear(8, shortest=6, longest=6, params=False)
    if getattr(model, "inputs", None) == "params":
        with pytest.raises(MissingFieldError, match="'params'"):
            model.fit(ds)
        return
    assert np.isfinite(np.asarray(model.fit(ds).predict(ds))).all()


@EVERY_MODEL
@pytest.mark.parametrize("start_in", ["T", "D", "C"])
def test_an_index_outside_an_episode_names_it(model, start_in):
    if not hasattr(model, "forecast"):
        return
    ds = equal()
    with pytest.raises(IndexError, match=r"start 7 is outside episode 0, whose states are 0\.\.6"):
        model.fit(ds).predict(ds, start=7)
    with pytest.raises(ValueError, match="nothing to forecast"):
        model.predict(ds, start=6)


def test_rows_with_too_few_columns():
    with pytest.raises(ValueError, match="n_features = 1"):
        OneStepRegressor().fit(np.zeros((5, 1)), np.zeros((5, 2)))
    with pytest.raises(ValueError, match=r"n_features = 2.*at least 3 columns"):
        TrajectoryRegressor().fit(np.zeros((5, 2)), np.zeros((5, 2)))
    model = OneStepRegressor(LinearRegression()).fit(np.eye(4), np.eye(4)[:, :2])
    with pytest.raises(ValueError, match="3 features, but OneStepRegressor is expecting 4"):
        model.predict(np.zeros((2, 3)))


def test_keywords_for_episodes_are_refused_with_rows():
    model = OneStepRegressor(LinearRegression()).fit(np.eye(4), np.eye(4)[:, :2])
    with pytest.raises(TypeError, match=r"\['horizon'\] are for episodes"):
        model.predict(np.eye(4), horizon=3)
    with pytest.raises(TypeError, match="start"):
        model.predict(np.eye(4), start=2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"start": 0.5}, "whole numbers"),
        ({"start": [0, 1]}, r"shape \(2,\) for 8 episodes"),
        ({"start": np.zeros((8, 2, 1), int)}, "several per episode"),
        ({"horizon": 0}, "at least 1"),
        ({"horizon": 2.5}, "whole number of steps"),
        ({"horizon": True}, "whole number of steps"),
        ({"actions": "replay"}, '"auto", "logged" or "policy"'),
    ],
    ids=str,
)
def test_bad_arguments_of_a_forecast(settings, message):
    ds = equal()
    with pytest.raises(ValueError, match=message):
        OneStepRegressor(LinearRegression()).fit(ds).predict(ds, **settings)


def test_episodes_that_do_not_fit_the_model_are_told_apart_by_name():
    ds = equal()
    named = TrajectoryDataset.from_arrays(
        [e.states for e in ds], params=ds.params, state_names=["angle", "speed"]
    )
    model = TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(named)
    more = TrajectoryDataset.from_arrays(np.zeros((1, 3, 3)), params=np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"3 states \(s0, s1, s2\).*2 \(angle, speed\)"):
        model.predict(more)
    with pytest.raises(MissingFieldError, match=r"TrajectoryRegressor \(fitted with params\)"):
        model.predict(linear(2, params=False))
    thin = TrajectoryDataset.from_arrays([e.states for e in ds], params=ds.params[:, :1])
    with pytest.raises(ValueError, match="1 params, the model was fitted on 2"):
        model.predict(thin)


def test_a_block_that_the_episodes_lack_is_named():
    with pytest.raises(MissingFieldError, match="'references'"):
        TrajectoryRegressor(
            relabeler=SubtrajectoryRelabeler(inputs=("state", "horizon", "references"))
        ).fit(equal())
    with pytest.raises(ValueError, match="unknown blocks"):
        TrajectoryRegressor(
            relabeler=SubtrajectoryRelabeler(inputs=("state", "horizon", "torque"))
        ).fit(equal())
    with pytest.raises(ValueError, match=r"missing blocks \['horizon'\]"):
        TrajectoryRegressor(relabeler=SubtrajectoryRelabeler(inputs=("state",))).fit(equal())


def test_a_failed_fit_leaves_no_trace_in_the_next():
    ds, model = equal(), OneStepRegressor(LinearRegression(), random_state=0)
    with pytest.raises(ValueError, match="y must be omitted"):
        model.fit(ds, np.zeros(8))
    fresh = OneStepRegressor(LinearRegression(), random_state=0).fit(ds)
    assert set(vars(model.fit(ds))) == set(vars(fresh))


def test_rows_after_episodes_and_back():
    ds = equal()
    model = OneStepRegressor(LinearRegression())
    expected = np.asarray(model.fit(ds).predict(ds))
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(np.random.default_rng(0).normal(size=(9, 3)), columns=list("abc"))
    model.fit(frame, frame[["a"]])
    assert model.feature_names_in_.tolist() == ["a", "b", "c"]
    assert model.predict(frame).shape == (9, 1)
    np.testing.assert_array_equal(np.asarray(model.fit(ds).predict(ds)), expected)
    assert not hasattr(model, "feature_names_in_")


def test_states_of_any_magnitude():
    small, large = (equal(scale=scale) for scale in (1e-9, 1e9))
    for ds in (small, large):
        model = OneStepRegressor(LinearRegression()).fit(ds)
        assert model.score(ds) > -1e-18
        model = TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(ds)
        assert model.score(ds) > -1.0
        assert not model.predict(ds).diverged_at.any()


def test_uncertainty_that_a_learner_lacks_is_asked_for_in_vain():
    ds = equal()
    rows = np.eye(4)
    model = OneStepRegressor(LinearRegression()).fit(rows, rows[:, :2])
    with pytest.raises(ValueError, match="LinearRegression gives no standard deviation"):
        model.predict(rows, return_std=True)
    with pytest.raises(ValueError, match="gives no standard deviation"):
        TrajectoryRegressor(LinearRegression()).fit(ds).predict(ds, n_samples=3)
    assert OneStepRegressor(Affine(std=1.0)).fit(ds).predict(ds, n_samples=3).std is None
