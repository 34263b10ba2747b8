"""Promises about scikit-learn's model selection, with an episode as the sample."""

import numpy as np
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    KFold,
    cross_val_predict,
    cross_validate,
)

from trajlearn.testing._case import Case, NotApplicable, require


def check_cross_validation_takes_episodes(case: Case) -> None:
    """`cross_validate` gives a finite score a fold, also with groups."""
    for cv in (KFold(2, shuffle=True, random_state=0), GroupKFold(2)):
        scores = cross_validate(
            case.new(0), case.train, cv=cv, groups=case.train.group, error_score="raise"
        )["test_score"]
        require(np.isfinite(scores).all(), f"scores {scores} with {type(cv).__name__}.")


def check_out_of_fold_predictions_keep_the_order(case: Case) -> None:
    """`cross_val_predict` gives one prediction an episode, in the order of the episodes."""
    cv = KFold(2, shuffle=True, random_state=0)
    found = cross_val_predict(case.new(0), case.train, cv=cv)
    require(len(found) == len(case.train), f"{len(found)} for {len(case.train)} episodes.")
    learn, held_out = next(cv.split(case.train))
    expected = case.new(0).fit(case.train[learn]).predict(case.train[held_out])
    if case.forecasts:
        found, n_steps = found[held_out].mean, expected.mean.shape[1]
        require(np.isnan(found[:, n_steps:]).all(), "padding is not NaN.")
        case.require_same(found[:, :n_steps], expected.mean, "out of fold", exact=False)
    else:
        case.require_same(found[held_out], expected, "out of fold", exact=False)


def check_grid_search_reaches_nested_parameters(case: Case) -> None:
    """`GridSearchCV` sets a parameter of the estimator inside, and refits."""
    plain = (bool, int, float, str)
    parameters = sorted(case.new(0).get_params().items(), key=lambda item: item[0])
    nested = [(k, v) for k, v in parameters if "__" in k and isinstance(v, plain)]
    if not nested:
        raise NotApplicable
    name, value = nested[0]
    search = GridSearchCV(case.new(0), {name: [value]}, cv=2, error_score="raise")
    refitted = search.fit(case.train).predict(case.test)
    case.require_same(refitted, case.fitted.predict(case.test), f"{name}, refitted")
