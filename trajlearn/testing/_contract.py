"""Running the contract: which checks apply to an estimator, and what a failure says."""

import inspect
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from trajlearn.testing import (
    _errors,
    _fitting,
    _forecasts,
    _information,
    _rewards,
    _scores,
    _selection,
    _uncertainty,
)
from trajlearn.testing._case import Case, NotApplicable

Check = Callable[[Case], None]


def checks(case: Case) -> Iterator[tuple[str, Callable[[], None]]]:
    """Name and function of every check for the kind of estimator at hand."""
    special = (_forecasts, _uncertainty, _scores) if case.forecasts else (_rewards,)
    for module in (_fitting, _information, *special, _errors, _selection):
        for name, check in list(vars(module).items()):
            if name.startswith("check_") and check.__module__ == module.__name__:
                yield name, partial(_run, name, check, case)


def check_dynamics_estimator(
    estimator: Any, *, policy: Any = None, same_bits: bool = True
) -> list[str]:
    """Run the contract of dynamics estimators on one, on small data made inside.

    Every check is one promise, such as that a forecast reads nothing after its start, or that an
    episode gets the same forecast alone as among others. Estimators whose ``predict(dataset)``
    returns a `Forecast` and direct reward models (one number an episode) are told apart by what
    they return; a `Pipeline` that ends in either will do.

    Parameters
    ----------
    estimator : estimator
        Unfitted, with settings that make it fast: it is fitted some twenty times on 24 episodes
        of about ten steps, two states, one action and two params.
    policy : callable, optional
        ``policy(states (n, 2), params (n, 2), times (n,)) -> actions (n, 1)``. Forecasts are then
        checked with ``actions="policy"`` too; the logged actions are minus params times states.
    same_bits : bool, default=True
        False compares a forecast of one episode alone with that in a batch to 1e-9 of the
        training range. For learners that multiply matrices of as many rows as there are
        episodes, which rounds differently with their number; most of scikit-learn's do.

    Returns
    -------
    list of str
        Names of the checks that ran. One that does not apply (such as saving, for an estimator
        without `save`) is left out.

    Raises
    ------
    AssertionError
        At the first broken promise; the message says what was promised and what was found.

    Examples
    --------
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import OneStepRegressor
    >>> from trajlearn.testing import check_dynamics_estimator
    >>> names = check_dynamics_estimator(OneStepRegressor(LinearRegression()), same_bits=False)
    >>> "check_nothing_after_the_start_is_read" in names
    True
    """
    ran = []
    for name, check in checks(Case(estimator, policy, same_bits)):
        try:
            check()
        except NotApplicable:
            continue
        ran.append(name)
    return ran


def _run(name: str, check: Check, case: Case) -> None:
    promise = " ".join((inspect.getdoc(check) or name).split())
    broken = f"{type(case.estimator).__name__} breaks a promise ({name}): {promise}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check(case)
    except NotApplicable:
        raise
    except AssertionError as error:
        raise AssertionError(f"{broken}\nFound: {error}") from error
    except Exception as error:
        raise AssertionError(f"{broken}\nRaised {type(error).__name__}: {error}") from error
