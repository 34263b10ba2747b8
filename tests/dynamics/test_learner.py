"""Any regressor under a formulation: means and variances by member."""

import numpy as np
import pytest
from sklearn.linear_model import BayesianRidge, LinearRegression

from trajlearn import OneStepRegressor, TrajectoryDataset
from trajlearn.dynamics._learner import fit_learner, moments_of
from trajlearn.exceptions import NoUncertaintyError


@pytest.fixture
def rows():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(60, 2))
    return x, x @ [[1.0, 2.0], [3.0, 4.0]] + [0.1, 0.5] * rng.normal(size=(60, 2))


def test_a_learner_of_one_target_gives_its_variance_for_each(rows):
    x, y = rows
    learner = fit_learner(BayesianRidge(), x, y, weight=None, groups=None)
    means, variances = moments_of(learner)(x[:7])
    assert means.shape == variances.shape == (1, 7, 2)
    for column in range(2):
        alone, std = BayesianRidge().fit(x, y[:, column]).predict(x[:7], return_std=True)
        np.testing.assert_allclose(means[0, :, column], alone)
        np.testing.assert_allclose(variances[0, :, column], std**2)
    assert moments_of(learner, means_only=True)(x)[1] is None


def test_a_learner_without_a_variance_gives_none(rows):
    learner = fit_learner(LinearRegression(), *rows, weight=None, groups=None)
    assert moments_of(learner)(rows[0])[1] is None


def test_a_roll_out_has_the_spread_of_a_learner_of_one_target():
    rng = np.random.default_rng(1)
    states = np.cumsum(rng.normal(0, [0.1, 0.3], size=(20, 30, 2)), axis=1)
    ds = TrajectoryDataset.from_arrays(states, params=np.zeros((20, 1)))
    model = OneStepRegressor(BayesianRidge(), inputs="params", n_particles=400, random_state=0)
    std = model.fit(ds).forecast(ds[:3], return_std=True, horizon=4, random_state=0).std
    # a random walk
    np.testing.assert_allclose(std[:, 0].mean(axis=0), [0.1, 0.3], rtol=0.1)
    np.testing.assert_allclose(std[:, 3] / std[:, 0], 2.0, rtol=0.25)
    model.set_params(estimator=LinearRegression()).fit(ds)
    with pytest.raises(NoUncertaintyError, match="gives no standard deviation"):
        model.forecast(ds[:3], return_std=True)
