"""Forecasts of chosen members: what a user is told."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from tests.dynamics.crossing import Off, decays
from tests.dynamics.systems import linear
from trajlearn import OneStepRegressor
from trajlearn.dynamics.selector import HorizonSelector
from trajlearn.exceptions import DivergenceWarning

CLOSED = OneStepRegressor(LinearRegression(), inputs="params")


def test_a_warning_points_to_the_line_that_asked():
    ds = decays(8)
    model = HorizonSelector([("gone", Off(diverges=0.5))], random_state=0).fit(ds)
    with pytest.warns(DivergenceWarning, match="4 of 8") as caught:
        model.predict(ds)
    assert caught[0].filename == __file__


def test_who_cannot_plan_is_named():
    model = HorizonSelector([("fine", CLOSED), ("piped", make_pipeline(CLOSED)), ("out", "drop")])
    with pytest.raises(AttributeError, match="has no attribute 'predict_trajectory'") as caught:
        _ = model.predict_trajectory
    assert str(caught.value.__cause__).startswith("members without predict_trajectory: piped. ")


def test_no_horizons_at_all_are_refused():
    model = HorizonSelector([("C", CLOSED)], random_state=0).fit(linear(6))
    with pytest.raises(ValueError, match="horizons is empty"):
        model.predict_trajectory(np.zeros(2), params=np.zeros((1, 1)), horizons=[])
