"""Promises of direct reward models: one number an episode."""

import numpy as np
from sklearn.metrics import r2_score

from trajlearn.testing._case import Case, NotApplicable, refused, require
from trajlearn.testing._system import oscillators, rebuilt


def check_one_reward_an_episode(case: Case) -> None:
    """`predict` gives one finite number an episode, and a positive std if it is asked for."""
    found = case.fitted.predict(case.test)
    require(np.shape(found) == (len(case.test),), f"shape {np.shape(found)}.")
    require(np.isfinite(found).all(), "a reward is not finite.")
    try:
        mean, std = case.fitted.predict(case.test, return_std=True)
    except (TypeError, ValueError):
        return
    case.require_same(mean, found, "the mean with and without std")
    require(std.shape == found.shape and (std > 0).all(), "std is not one positive number each.")


def check_score_is_r2_of_the_mean_reward(case: Case) -> None:
    """`score` is R^2 of the mean reward per step over a common horizon."""
    settings = case.estimator.get_params()
    if any(settings.get(name) is not None for name in ("reward", "horizon", "relabeler")):
        raise NotApplicable
    truth = [episode.rewards.mean() for episode in case.test]
    expected = r2_score(truth, case.fitted.predict(case.test))
    found = case.fitted.score(case.test)
    require(np.isclose(found, expected), f"score {found:g}, by hand {expected:g}.")


def check_unequal_lengths_are_refused_in_words(case: Case) -> None:
    """Where episodes end early, `fit` asks what the missing steps are worth, or succeeds."""
    ragged = oscillators(24, seed=0)
    ragged = rebuilt(ragged, terminated=ragged.lengths < ragged.lengths.max())
    try:
        case.new(0).fit(ragged)
    except ValueError as error:
        require("terminal_reward" in str(error), f"the message names no way out: {error}")


def check_missing_rewards_are_refused(case: Case) -> None:
    """Without a reward function, episodes without logged rewards raise in `fit`."""
    settings = case.estimator.get_params()
    if any(settings.get(name) is not None for name in ("reward", "relabeler")):
        raise NotApplicable
    refused("no rewards", case.new(0).fit, rebuilt(case.train, rewards=None))
