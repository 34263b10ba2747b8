import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from tests.dynamics.systems import A, B, quadratic
from trajlearn import HorizonSelector, OneStepRegressor, TrajectoryDataset


def fed_back(n):
    """s' = A s + B a, a = -k s: each of the two gains k is the mean of four of eight params."""
    rng = np.random.default_rng(0)
    states, actions, params = [], [], []
    for _ in range(n):
        theta, path, acted = rng.uniform(0, 0.8, size=8), [rng.normal(size=2)], []
        for _ in range(12):
            acted.append([-theta.reshape(2, 4).mean(axis=1) @ path[-1]])
            path.append(A @ path[-1] + B @ acted[-1])
        states.append(path)
        actions.append(acted)
        params.append(theta)
    return TrajectoryDataset.from_arrays(states, actions=actions, params=params)


def worst(ds, **parameters):
    member = OneStepRegressor(LinearRegression(), **parameters)
    found = HorizonSelector([("D", member)], cv=len(ds), random_state=0).fit(ds)
    return found.cv_errors_["mean"].max()


@pytest.mark.parametrize(("n", "exact"), [(5, True), (6, False)])
def test_few_episodes_judge_by_the_policy_that_is_cloned_from_all_of_them(n, exact):
    # others do not determine how actions depend on the params of an episode; the plant is exact
    error = worst(fed_back(n), policy="clone", policy_estimator=quadratic())
    assert (error < 1e-16) == exact
    assert exact or error > 1e-5


def test_few_episodes_leave_a_given_policy_alone():
    def wrong(states, params, times):
        return np.ones((len(states), 1))

    assert worst(fed_back(5), policy=wrong) > 1e-2


def test_closed_loops_and_pipelines_are_judged_beside_clones():
    ds = fed_back(5)
    one = OneStepRegressor(LinearRegression(), policy="clone", policy_estimator=quadratic())
    members = [
        ("D", one),
        ("in a pipeline", make_pipeline(one)),
        ("C", OneStepRegressor(LinearRegression(), inputs="params", policy="clone")),
    ]
    found = HorizonSelector(members, policy="clone", random_state=0).fit(ds)
    error = found.cv_errors_.groupby("member")["mean"].max()
    assert error["D"] == error["in a pipeline"] < 1e-16
    assert error["C"] > 1e-5
