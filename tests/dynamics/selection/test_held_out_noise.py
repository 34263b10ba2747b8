"""Uncertainty from held-out errors where they say something, and where they say nothing."""

import numpy as np
import pytest

from tests.dynamics.crossing import Off, decays
from trajlearn.dynamics.selector import HorizonSelector


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.DivergenceWarning")
def test_where_all_forecasts_diverged_the_spread_is_the_training_range():
    ds = decays(12)
    # it diverges after step 5 in every episode it was judged by, but not for such a theta
    model = HorizonSelector([("m", Off(diverges=-1.0))], bandwidth=0.0, random_state=0).fit(ds)
    stays = ds.assign(params=np.full((12, 1), -2.0))
    width = np.ptp(ds.states)
    forecast = model.predict(stays, return_std=True, n_samples=2000, random_state=0)
    np.testing.assert_allclose(forecast.std[:, 6:], width)
    np.testing.assert_allclose(forecast.std[:, :5], 0.01, rtol=0.7)
    np.testing.assert_allclose(forecast.samples[..., 6:, :].std(axis=0), width, rtol=0.1)
