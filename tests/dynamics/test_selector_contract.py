"""The contract of dynamics estimators, kept by a selector."""

import pytest
from sklearn.linear_model import LinearRegression

from tests.dynamics.systems import SMALL
from trajlearn import LinearFeedback, OneStepRegressor, TrajectoryRegressor
from trajlearn.dynamics.selector import HorizonSelector
from trajlearn.testing import check_dynamics_estimator

FEEDBACK = LinearFeedback(bounds=None)
T = TrajectoryRegressor(LinearRegression())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("members", "settings"),
    [
        ([("D", OneStepRegressor(LinearRegression())), ("T", T)], {"rule": "pick"}),
        (
            [("C", OneStepRegressor(inputs="params").set_params(**SMALL)), ("T", T)],
            {"rule": "blend"},
        ),
        ([("logged", OneStepRegressor(LinearRegression())), ("T", T)], {"policy": None}),
    ],
    ids=["pick", "blend", "logged actions"],
)
def test_the_contract_holds(members, settings):
    model = HorizonSelector(members, cv=2, **{"policy": FEEDBACK} | settings)
    ran = check_dynamics_estimator(model, policy=FEEDBACK, same_bits=False)
    assert "check_nothing_after_the_start_is_read" in ran
    assert len(ran) > 25
