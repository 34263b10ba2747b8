"""Promises about wrong input: each is refused in words, or changes nothing."""

from typing import Any

import numpy as np

from trajlearn.testing._case import Case, NotApplicable, explained, refused
from trajlearn.testing._system import rebuilt


def check_wrong_states_are_refused(case: Case) -> None:
    """Episodes with another number of states raise."""
    wide = rebuilt(case.test, states=[np.hstack([e.states, e.states]) for e in case.test])
    narrow = rebuilt(case.test, states=[e.states[:, :1] for e in case.test])
    refused("4 states instead of 2", case.fitted.predict, wide)
    refused("1 state instead of 2", case.fitted.predict, narrow)


def _refused_or_unread(case: Case, what: str, **changes: Any) -> None:
    """A field that is missing or of another width either is not read, or its lack is refused."""
    odd = rebuilt(case.test, **changes)
    try:
        found = case.fitted.predict(odd)
    except (ValueError, TypeError) as error:
        explained(what, error)
        return
    case.require_same(found, case.fitted.predict(case.test), f"{what}: taken, but read")


def check_missing_params_are_refused_or_unread(case: Case) -> None:
    """Episodes without theta, or with a wider one, raise unless the model does not read it."""
    _refused_or_unread(case, "no params", params=None)
    wider = [np.append(episode.params, 0.0) for episode in case.test]
    _refused_or_unread(case, "3 params instead of 2", params=wider)
    _refused_or_unread(case, "1 param instead of 2", params=[e.params[:1] for e in case.test])


def check_missing_actions_are_refused_or_unread(case: Case) -> None:
    """Episodes without actions, or with more of them, raise unless the model does not read them."""
    _refused_or_unread(case, "no actions", actions=None)
    wider = [np.hstack([episode.actions] * 2) for episode in case.test]
    _refused_or_unread(case, "2 actions instead of 1", actions=wider)


def check_bad_rows_are_refused(case: Case) -> None:
    """Rows with NaN, with infinity or with a column too few raise."""
    width = getattr(case.fitted, "n_features_in_", None)
    if width is None or not hasattr(case.fitted, "layout_"):
        raise NotApplicable
    rows = np.zeros((3, width))
    for value in (np.nan, np.inf):
        bad = rows.copy()
        bad[1, 0] = value
        refused(f"a row with {value}", case.fitted.predict, bad)
    refused("rows with a column too few", case.fitted.predict, rows[:, 1:])
    if case.forecasts:
        refused("one column, two targets", case.new(0).fit, rows[:, :1], np.zeros((3, 2)))


def check_no_episodes_are_refused(case: Case) -> None:
    """An empty list raises, in `fit` and in `predict`."""
    refused("fit([])", case.new(0).fit, [])
    refused("predict([])", case.fitted.predict, [])
