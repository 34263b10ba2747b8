"""scikit-learn's own checks, on every public estimator and scaler of `dynamics` as constructed."""

import pytest

from tests.sklearn_checks import run_checks
from trajlearn import (
    BlockScaler,
    DirectRewardGP,
    DirectRewardNN,
    HorizonFeatures,
    OneStepRegressor,
    TrajectoryRegressor,
)

SKIPS = {"check_array_api_input": "needs SCIPY_ARRAY_API=1 before scipy is imported"}


@pytest.mark.parametrize(
    "estimator",
    [
        TrajectoryRegressor(),
        OneStepRegressor(),
        DirectRewardGP(),
        DirectRewardNN(),
        BlockScaler(),
        HorizonFeatures(),
    ],
    ids=lambda estimator: type(estimator).__name__,
)
@pytest.mark.filterwarnings("ignore")
def test_sklearn_checks_pass(estimator):
    results = run_checks(estimator, allowed_skips=SKIPS)
    assert sum(result["status"] == "passed" for result in results) >= 45
