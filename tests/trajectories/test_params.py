"""ParamsTransformer: other parameters, everything else the same, in front of a model."""

import pickle
from functools import partial

import numpy as np
import pytest
from sklearn import config_context
from sklearn.base import clone
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from trajlearn.dynamics import TrajectoryRegressor
from trajlearn.exceptions import MissingFieldError
from trajlearn.policies import NetworkPolicy
from trajlearn.trajectories import SubtrajectoryRelabeler, TrajectoryDataset
from trajlearn.trajectories.edits import assign
from trajlearn.trajectories.kalman import KalmanSmoother
from trajlearn.trajectories.params import ParamsTransformer


def doubled(params):
    return np.hstack([2 * params, params[:, :1] + 1])


def halves(params):
    """The same for theta that differ by less than one."""
    return np.floor(params[:, :1])


@pytest.mark.parametrize("seed", range(20))
def test_new_parameters_and_everything_else_as_before(make_dataset, seed):
    ds = make_dataset(seed)
    params = [np.full(2, float(i)) for i in range(len(ds))]
    ds = assign(ds, params=params, param_names=["p", "q"])
    new = ParamsTransformer(doubled, names=["2p", "2q", "p+1"]).fit_transform(ds)
    assert new.param_names == ("2p", "2q", "p+1")
    np.testing.assert_array_equal(new.params, doubled(np.array(params)))
    back = assign(new, params=params, param_names=["p", "q"])
    assert back == ds


def test_parameters_that_change_on_the_way_do_so_after_it():
    first, second = np.repeat([[1.0], [2.0], [1.5]], [2, 3, 1], axis=0), np.array([4.0])
    ds = TrajectoryDataset.from_arrays([np.zeros((7, 1)), np.zeros((4, 1))], params=[first, second])
    new = ParamsTransformer(doubled).fit_transform(ds)
    assert new.params_vary
    assert new.param_names == ("theta0", "theta1")
    np.testing.assert_array_equal(new[0].params, doubled(first))
    np.testing.assert_array_equal(new[1].params, [8.0, 5.0])
    same = ParamsTransformer(halves).fit_transform(ds[:1])
    assert same.params_vary
    # where the new description does not change, nothing changes on the way any more
    constant = ParamsTransformer(halves).fit_transform(assign(ds, params=[first / 3, second]))
    assert not constant.params_vary
    assert constant.params.tolist() == [[0.0], [4.0]]


def test_function_may_work_in_place_and_the_data_stay():
    def in_place(params):
        params *= 3
        return params

    ds = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)), params=[[1.0], [2.0]])
    new = ParamsTransformer(in_place).fit_transform(ds)
    assert new.params.ravel().tolist() == [3.0, 6.0]
    assert ds.params.ravel().tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        new.params[0] = 0.0


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.SmoothingWarning")
def test_measured_states_stay_behind_a_smoother():
    states = np.cumsum(np.random.default_rng(0).normal(size=(3, 30, 1)), axis=1)
    ds = TrajectoryDataset.from_arrays(states, params=[[1.0], [2.0], [3.0]], state_names=["x"])
    smooth = KalmanSmoother(measurement_noise=0.1).fit_transform(ds)
    new = ParamsTransformer(doubled).fit_transform(smooth)
    np.testing.assert_array_equal(new.observed, smooth.observed)
    assert new.hindsight


def policies(n=30, seed=0):
    """Linear decays whose rate is the response of a network, whatever its weights are."""
    policy = NetworkPolicy((3,), n_states=1, n_actions=1)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(-2, 2, size=(n, policy.n_params))
    rates = policy.responses(weights, [[1.0]])
    states = np.exp(0.1 * rates * np.arange(9))[:, :, None]
    return policy, TrajectoryDataset.from_arrays(states, params=weights)


def test_in_a_pipeline_before_a_model():
    policy, ds = policies()
    describe = ParamsTransformer(partial(policy.responses, probe_states=np.ones((1, 1))))
    model = TrajectoryRegressor(
        LinearRegression(), relabeler=SubtrajectoryRelabeler(max_rows=None), random_state=0
    )
    pipe = clone(make_pipeline(describe, model)).fit(ds[:20])
    forecast = pipe.predict(ds[20:])
    assert forecast.mean.shape == (10, 8, 1)
    error = np.abs(np.asarray(forecast) - ds[20:].states.reshape(10, 9, 1)[:, 1:]).mean()
    raw = clone(model).fit(ds[:20]).predict(ds[20:])
    raw_error = np.abs(np.asarray(raw) - ds[20:].states.reshape(10, 9, 1)[:, 1:]).mean()
    assert error < 0.7 * raw_error
    again = pickle.loads(pickle.dumps(pipe)).predict(ds[20:])
    np.testing.assert_array_equal(again.mean, forecast.mean)
    assert pipe[-1].layout_.columns["params"] == ("theta0",)


def test_output_stays_a_dataset_whatever_scikit_learn_wraps():
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)), params=[[1.0], [2.0]])
    with config_context(transform_output="pandas"):
        assert isinstance(ParamsTransformer(doubled).fit_transform(ds), TrajectoryDataset)


def test_list_of_trajectories_is_taken():
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)), params=[[1.0], [2.0]])
    new = ParamsTransformer(doubled).fit(list(ds)).transform(list(ds))
    assert new.params.tolist() == [[2.0, 2.0], [4.0, 3.0]]


@pytest.mark.parametrize(
    ("func", "names", "message"),
    [
        (lambda params: params[:, 0], None, r"shape \(2,\) for params of shape \(2, 1\)"),
        (lambda params: params[:1], None, "one row each"),
        (lambda params: params[:, :0], None, r"expected \(2, k\)"),
        (lambda params: np.log(params - 1), None, r"NaN or infinity for the params \[1.0\]"),
        (doubled, ["only one"], "name each once"),
        (doubled, ["same", "same"], "name each once"),
    ],
    ids=["flat", "rows lost", "no column", "infinite", "too few names", "name twice"],
)
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
def test_what_cannot_be_is_said(func, names, message):
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)), params=[[1.0], [2.0]])
    with pytest.raises(ValueError, match=message):
        ParamsTransformer(func, names=names).fit_transform(ds)


def test_episodes_without_params_or_with_others_are_refused():
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)), params=[[1.0], [2.0]])
    fitted = ParamsTransformer(doubled).fit(ds)
    bare = assign(ds, params=None)
    with pytest.raises(MissingFieldError, match="ParamsTransformer needs params"):
        ParamsTransformer(doubled).fit(bare)
    with pytest.raises(MissingFieldError, match="ParamsTransformer needs params"):
        fitted.transform(bare)
    with pytest.raises(ValueError, match=r"have 2 params, ParamsTransformer was fitted on 1"):
        fitted.transform(assign(ds, params=np.ones((2, 2))))
    with pytest.raises(ValueError, match="func"):
        ParamsTransformer(3).fit(ds)
