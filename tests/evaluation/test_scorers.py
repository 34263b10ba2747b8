import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.linear_model import BayesianRidge, LinearRegression, Ridge
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score, cross_validate
from sklearn.pipeline import make_pipeline

from trajlearn import MLPEnsembleRegressor, TrajectoryRegressor
from trajlearn.evaluation import horizon_scorer
from trajlearn.evaluation.scorers import crps_scorer
from trajlearn.evaluation.uncertainty import crps


def test_score_is_minus_the_mean_error_of_the_episodes_that_reach_the_horizon(
    persistence, make_ramps
):
    model = persistence().fit(make_ramps([1.0], [10]))
    test = make_ramps([1.0, 2.0, 9.0], [5, 4, 3])
    assert_allclose(horizon_scorer(4)(model, test), -((4 / 10) ** 2 + (8 / 10) ** 2) / 2)
    assert_allclose(horizon_scorer(5)(model, list(test)), -((5 / 10) ** 2))
    assert horizon_scorer(3)(model, make_ramps([0.0], [3])) == 0


def test_a_diverged_episode_counts_error_score_and_no_episode_less(persistence, make_ramps):
    train, test = make_ramps([1.0], [10]), make_ramps([1.0, 1.0], [3, 3])
    exploding = persistence(diverges_at=3).fit(train)
    assert horizon_scorer(3)(exploding, test) == -1e12
    assert horizon_scorer(3, error_score=-5)(exploding, test) == -5
    assert np.isnan(horizon_scorer(3, error_score=np.nan)(exploding, test))
    # it explodes at step 3, not before
    assert_allclose(horizon_scorer(2)(exploding, test), -((2 / 10) ** 2))
    poor = persistence(offset=1e3).fit(train)
    assert horizon_scorer(3)(poor, test) > horizon_scorer(3)(exploding, test)
    assert horizon_scorer(3, error_score=-5)(poor, test) == -5
    assert horizon_scorer(3, error_score=np.nan)(poor, test) < -100


def test_some_diverged_episodes_do_not_hide_behind_the_others(persistence, make_ramps):
    model = persistence().fit(make_ramps([1.0], [10]))
    test = make_ramps([1.0, 1.0], [5, 5])

    class Half:
        def predict(self, ds):
            forecast = model.predict(ds)
            forecast.diverged_at[0] = 2
            forecast.mean[0, 1:] = np.inf
            return forecast

    assert_allclose(horizon_scorer(5, error_score=-9)(Half(), test), (-9 - 0.25) / 2)


def test_repr_equality_and_pickle():
    scorer = horizon_scorer(20, error_score=np.inf * -1)
    assert repr(horizon_scorer(np.int64(20))) == "horizon_scorer(20)"
    assert repr(scorer) == "horizon_scorer(20, error_score=-inf)"
    assert pickle.loads(pickle.dumps(scorer)) == scorer != horizon_scorer(20)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, "at least 1"),
        ({"horizon": 0.5}, "whole numbers of steps"),
        ({"horizon": [1, 2]}, "one number"),
        ({"horizon": 1, "error_score": 1.0}, "must not exceed 0"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        horizon_scorer(**arguments)


def test_bad_calls_are_refused(persistence, make_ramps):
    ds = make_ramps([1.0, 2.0], [4, 6])
    model = persistence().fit(ds)
    with pytest.raises(ValueError, match=r"horizon_scorer\(7\).*longest episode has 6 steps"):
        horizon_scorer(7)(model, ds)
    with pytest.raises(ValueError, match="omit y"):
        horizon_scorer(1)(model, ds, np.zeros(2))
    with pytest.raises(TypeError, match="expected a TrajectoryDataset"):
        horizon_scorer(1)(model, np.zeros((2, 3)))


def test_grid_search_over_networks_takes_the_one_that_wins_at_the_horizon(decays):
    net = MLPEnsembleRegressor(hidden_layer_sizes=(16,), max_steps=30)
    search = GridSearchCV(
        TrajectoryRegressor(net, random_state=0),
        {"estimator__learning_rate": [1e-8, 1e-2]},
        scoring=horizon_scorer(20),
        cv=GroupKFold(2),
        error_score="raise",
    ).fit(decays, groups=decays.group)
    assert search.best_params_ == {"estimator__learning_rate": 1e-2}
    assert search.best_score_ > search.cv_results_["mean_test_score"].min()
    assert search.score(decays) == horizon_scorer(20)(search, decays)


def test_several_horizons_at_once_and_a_pipeline(decays, state_selector):
    pipe = make_pipeline(
        state_selector(["s0"]), TrajectoryRegressor(LinearRegression(), random_state=0)
    )
    scores = cross_validate(
        pipe,
        decays,
        scoring={"near": horizon_scorer(1), "far": horizon_scorer(20)},
        cv=3,
        error_score="raise",
    )
    assert scores["test_near"].shape == scores["test_far"].shape == (3,)
    for name, horizon in [("near", 1), ("far", 20)]:
        alone = cross_validate(pipe, decays, scoring=horizon_scorer(horizon), cv=3)
        assert_allclose(scores[f"test_{name}"], alone["test_score"])
        assert (scores[f"test_{name}"] < 0).all()


def test_an_exploding_candidate_ranks_last(persistence, make_ramps):
    search = GridSearchCV(
        persistence(),
        {"diverges_at": [3, 0], "offset": [0.0, 50.0]},
        scoring=horizon_scorer(4),
        cv=2,
        error_score="raise",
    ).fit(make_ramps(np.ones(4), [5] * 4))
    rank = search.cv_results_["rank_test_score"]
    assert rank.tolist() == [3, 3, 1, 2]


def test_the_winner_depends_on_the_horizon(persistence, make_ramps):
    # an offset of 4 is right for step 4 of a ramp, and wrong for step 1
    train = make_ramps(np.ones(4), [5] * 4).select_states(["x"])
    for horizon, best in [(1, 0.0), (4, 4.0)]:
        search = GridSearchCV(
            persistence(), {"offset": [0.0, 4.0]}, scoring=horizon_scorer(horizon), cv=2
        ).fit(train)
        assert search.best_params_ == {"offset": best}


def test_a_stronger_penalty_scores_worse(decays):
    scorer = horizon_scorer(10)
    free, stiff = (
        TrajectoryRegressor(estimator, random_state=0).fit(decays)
        for estimator in (LinearRegression(), Ridge(1e9))
    )
    assert scorer(free, decays) > scorer(stiff, decays)


# -- crps_scorer --------------------------------------------------------------------------


class Certain:
    """What a forecaster predicts, with a std of its own."""

    def __init__(self, model, std):
        self.model, self.std = model, std

    def predict(self, ds, *, return_std=False):
        forecast = self.model.predict(ds)
        if return_std:
            forecast.std = np.where(np.isnan(forecast.mean), np.nan, self.std)
        return forecast


def test_crps_is_averaged_over_the_steps_of_an_episode_then_over_episodes(persistence, make_ramps):
    model = persistence().fit(make_ramps([1.0], [10]))
    test = make_ramps([1.0, 2.0, 9.0], [5, 4, 3])
    sure = Certain(model, 0.0)  # the CRPS is the absolute error, slope * h / 10
    assert_allclose(crps_scorer(4)(sure, test), -(4 / 10 + 8 / 10) / 2)
    assert_allclose(crps_scorer(5)(sure, list(test)), -5 / 10)
    assert_allclose(crps_scorer()(sure, test), -(1 * 3 + 2 * 2.5 + 9 * 2) / 10 / 3)
    unsure = Certain(model, 3.0)
    scores = crps(unsure.predict(test, return_std=True), test)
    assert_allclose(crps_scorer()(unsure, test), -np.nanmean(scores, axis=(1, 2)).mean())
    assert_allclose(crps_scorer(4)(unsure, test), -scores[:2, 3].mean())


def test_crps_of_a_diverged_episode_is_error_score(persistence, make_ramps):
    train, test = make_ramps([1.0], [10]), make_ramps([1.0, 1.0], [3, 2])
    exploding = Certain(persistence(diverges_at=3).fit(train), 0.0)
    assert_allclose(crps_scorer(error_score=-5)(exploding, test), (-5 - 0.15) / 2)
    assert crps_scorer(3)(exploding, test) == -1e12
    assert_allclose(crps_scorer(2)(exploding, test), -0.2)
    assert np.isnan(crps_scorer(error_score=np.nan)(exploding, test))
    assert crps_scorer(3, error_score=-0.1)(Certain(persistence().fit(train), 0.0), test) == -0.1


def test_crps_prefers_the_right_std(decays, state_selector):
    ds = decays.add_noise(0.3, of="std", random_state=0)
    search = GridSearchCV(
        TrajectoryRegressor(BayesianRidge(), random_state=0),
        # priors: 1e9 insists on weights of 0, 1e5 on a large noise
        {"estimator__lambda_1": [1e-6, 1e9], "estimator__alpha_2": [1e-6, 1e5]},
        scoring=crps_scorer(),
        cv=3,
        error_score="raise",
    ).fit(ds)
    assert search.best_params_ == {"estimator__lambda_1": 1e-6, "estimator__alpha_2": 1e-6}
    pipe = make_pipeline(state_selector(["s0"]), search.best_estimator_)
    scores = cross_val_score(pipe, ds, scoring=crps_scorer(20), cv=3, error_score="raise")
    assert (scores < 0).all()


def test_crps_scorers_are_told_apart_and_refuse_what_they_cannot_score(persistence, make_ramps):
    scorer = crps_scorer(20, error_score=-7)
    assert repr(scorer) == "crps_scorer(20, error_score=-7)"
    assert repr(crps_scorer()) == "crps_scorer()"
    assert pickle.loads(pickle.dumps(scorer)) == scorer != crps_scorer(20)
    assert crps_scorer(20) != horizon_scorer(20)
    for arguments, message in [
        ({"horizon": 0}, "at least 1"),
        ({"horizon": [1, 2]}, "one number"),
        ({"error_score": 1.0}, "must not exceed 0"),
    ]:
        with pytest.raises(ValueError, match=message):
            crps_scorer(**arguments)
    ds = make_ramps([1.0, 2.0], [4, 6])
    model = Certain(persistence().fit(ds), 1.0)
    with pytest.raises(ValueError, match=r"crps_scorer\(7\).*longest episode has 6 steps"):
        crps_scorer(7)(model, ds)
    with pytest.raises(ValueError, match="omit y"):
        crps_scorer()(model, ds, np.zeros(2))
    linear = TrajectoryRegressor(LinearRegression(), random_state=0).fit(ds)
    with pytest.raises(ValueError, match="return_std"):
        crps_scorer()(linear, ds)
