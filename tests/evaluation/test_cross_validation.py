import joblib
import numpy as np
import pandas as pd
import pytest
import torch
from numpy.testing import assert_allclose
from sklearn.base import BaseEstimator
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GroupKFold, KFold, ShuffleSplit, cross_val_predict
from sklearn.pipeline import make_pipeline

from trajlearn import Forecast, MLPEnsembleRegressor, TrajectoryDataset, TrajectoryRegressor
from trajlearn.evaluation import (
    cross_val_forecast,
    cross_validate_horizons,
    horizon_errors,
    summarise,
)

COLUMNS = ["fold", "horizon", "n_episodes", "n_diverged", "median", "mean", "q65", "q95"]


def linear_model():
    return TrajectoryRegressor(LinearRegression(), random_state=0)


def tiny_net():
    net = MLPEnsembleRegressor(hidden_layer_sizes=(16,), max_steps=30)
    return TrajectoryRegressor(net, random_state=0)


class NeverFit(BaseEstimator):
    def fit(self, ds):
        raise AssertionError("fitted before the arguments were checked")


class Splits(BaseEstimator):
    """Writes down what each clone is trained and tested on."""

    def __init__(self, model, log):
        self.model = model
        self.log = log

    def __sklearn_clone__(self):
        return self

    def fit(self, ds):
        self.model.fit(ds)
        self.trained = ds
        return self

    def predict(self, ds, **settings):
        self.log.append((self.trained, ds))
        return self.model.predict(ds, **settings)


# -- cross_validate_horizons --------------------------------------------------------------


def test_each_fold_is_judged_by_a_model_of_the_others(decays):
    table = cross_validate_horizons(linear_model(), decays, [20, 1, 5], cv=KFold(3))
    assert list(table.columns) == COLUMNS
    assert table["fold"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert table["horizon"].tolist() == [1, 5, 20] * 3
    assert table.attrs == {"truth": "observed", "actions": "none"}
    train, test = np.arange(4, 12), np.arange(4)
    model = linear_model().fit(decays[train])
    expected = summarise(horizon_errors(model.predict(decays[test]), decays[test]))
    own = table[table["fold"] == 0].set_index("horizon").drop(columns="fold")
    pd.testing.assert_frame_equal(own, expected.loc[[1, 5, 20]])


def test_errors_by_hand(persistence, make_ramps):
    # slopes 1 and 2, 4 steps: trained on one, the range is 4 or 8, the other moves 2 or 1 a step
    ds = make_ramps([1.0, 2.0], [4, 4])
    table = cross_validate_horizons(persistence(), ds, [1, 4], cv=KFold(2))
    assert_allclose(table["median"], [(1 / 8) ** 2, (4 / 8) ** 2, (2 / 4) ** 2, (8 / 4) ** 2])


@pytest.mark.parametrize("explicit", [False, True])
def test_groups_are_never_parted_and_explicit_ones_win(persistence, make_ramps, explicit):
    ds = make_ramps(np.ones(12), [3] * 12, group=np.repeat([0, 1, 2, 3], 3))
    groups = np.tile([0, 1, 2, 3], 3) if explicit else ds.group
    log = []
    cross_validate_horizons(
        Splits(persistence(), log), ds, 3, cv=4, groups=groups if explicit else None
    )
    label = dict(zip(ds.ids, groups))
    assert len(log) == 4
    for trained, tested in log:
        in_training, in_test = ({label[i] for i in part.ids} for part in (trained, tested))
        assert len(in_test) == 1
        assert not in_training & in_test


def test_without_groups_folds_are_shuffled_with_a_fixed_seed(persistence, make_ramps):
    ds = make_ramps(np.ones(10), [3] * 10)
    log = []
    cross_validate_horizons(Splits(persistence(), log), ds, 1)
    expected = KFold(5, shuffle=True, random_state=0).split(np.zeros(10))
    for (_, tested), (_, test) in zip(log, expected, strict=True):
        assert tested.ids.tolist() == test.tolist()


def test_a_splitter_gets_the_groups_it_can_use(persistence, make_ramps, recwarn):
    ds = make_ramps(np.ones(6), [3] * 6, group=list("aabbcc"))
    log = []
    cross_validate_horizons(Splits(persistence(), log), ds, 1, cv=GroupKFold(3))
    assert all(len(set(tested.group)) == 1 for _, tested in log)
    cross_validate_horizons(persistence(), ds, 1, cv=KFold(3))
    assert not recwarn.list
    with pytest.warns(UserWarning, match="groups parameter is ignored"):
        cross_validate_horizons(persistence(), ds, 1, cv=KFold(3), groups=ds.group)
    splits = [(np.arange(4), np.array([4, 5]))]
    assert cross_validate_horizons(persistence(), ds, 1, cv=splits)["n_episodes"].tolist() == [2]


def test_short_episodes_count_where_they_reach(persistence, make_ramps):
    ds = make_ramps(np.ones(4), [9, 9, 2, 5])
    table = cross_validate_horizons(persistence(), ds, [2, 5, 9], cv=KFold(2))
    assert table["n_episodes"].tolist() == [2, 2, 2, 2, 1, 0]
    assert table["median"].isna().tolist() == [False] * 5 + [True]


def test_nothing_is_forecast_beyond_the_longest_horizon(persistence, make_ramps):
    log = []
    cross_validate_horizons(
        Splits(persistence(), log), make_ramps(np.ones(4), [9, 2, 9, 9]), [1, 4], cv=KFold(2)
    )
    assert [tested.lengths.tolist() for _, tested in log] == [[4, 2], [4, 4]]
    assert [trained.lengths.tolist() for trained, _ in log] == [[9, 9], [9, 2]]


def test_diverged_forecasts_are_counted_not_dropped(persistence, make_ramps):
    ds = make_ramps(np.ones(4), [2, 6, 6, 6])
    table = cross_validate_horizons(persistence(diverges_at=3), ds, [2, 6], cv=KFold(2))
    assert table["n_diverged"].tolist() == [0, 1, 0, 2]
    assert np.isinf(table.loc[table["horizon"] == 6, ["median", "mean", "q95"]]).all(axis=None)
    assert np.isfinite(table.loc[table["horizon"] == 2, ["median", "mean", "q95"]]).all(axis=None)


def test_a_pipeline_is_as_good(persistence, state_selector, make_ramps):
    ds = make_ramps([1.0, 2.0, 3.0, 4.0], [4] * 4)
    pipe = make_pipeline(state_selector(["y"]), persistence())
    table = cross_validate_horizons(pipe, ds, [1, 4], cv=2)
    alone = cross_validate_horizons(persistence(), ds.select_states(["y"]), [1, 4], cv=2)
    pd.testing.assert_frame_equal(table, alone)


def test_workers_give_the_same_numbers(decays):
    serial = cross_validate_horizons(tiny_net(), decays, [1, 10, 20], cv=2)
    parallel = cross_validate_horizons(tiny_net(), decays, [1, 10, 20], cv=2, n_jobs=2)
    pd.testing.assert_frame_equal(parallel, serial, check_exact=True)


def test_workers_keep_to_one_thread(persistence, make_ramps):
    seen = []

    class Watch(Splits):
        def fit(self, ds):
            seen.append(torch.get_num_threads())
            return super().fit(ds)

    ds = make_ramps(np.ones(4), [3] * 4)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        cross_validate_horizons(Watch(persistence(), []), ds, 1, cv=2)
        assert seen == [2, 2]
        with joblib.parallel_config(backend="threading"):
            cross_validate_horizons(Watch(persistence(), []), ds, 1, cv=2, n_jobs=2)
        assert seen[2:] == [1, 1]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_progress_is_shown_on_request(persistence, make_ramps, capsys):
    ds = make_ramps(np.ones(4), [3] * 4)
    model = persistence()
    cross_validate_horizons(model, ds, 1, cv=2)
    assert capsys.readouterr().err == ""
    cross_validate_horizons(model, ds, 1, cv=2, verbose=1)
    assert "2/2" in capsys.readouterr().err
    assert not hasattr(model, "state_range_")  # clones are fitted


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizons": [2, 7, 9]}, r"horizons \[7, 9\] are longer than every test episode.*6 steps"),
        ({"horizons": [1.5]}, "whole numbers of steps, not times"),
        ({"horizons": [np.nan]}, "whole numbers"),
        ({"horizons": True}, "whole numbers"),
        ({"horizons": []}, "whole numbers"),
        ({"horizons": [[1, 2]]}, "whole numbers"),
        ({"horizons": [0, 1]}, "at least 1 step"),
        ({"horizons": 1, "groups": [1, 2, 3]}, r"groups has shape \(3,\).*\(4,\)"),
        ({"horizons": 1, "cv": 5}, "n_splits=5"),
        ({"horizons": 1, "cv": "five"}, "cv"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_fitted(make_ramps, arguments, message):
    ds = make_ramps(np.ones(4), [3, 4, 5, 6])
    with pytest.raises(ValueError, match=message):
        cross_validate_horizons(NeverFit(), ds, **{"cv": 2} | arguments)


def test_a_horizon_that_only_a_training_episode_reaches_is_refused(make_ramps):
    ds = make_ramps(np.ones(3), [3, 3, 6])
    splits = [(np.array([1, 2]), np.array([0]))]
    with pytest.raises(ValueError, match=r"\[6\] are longer than every test episode"):
        cross_validate_horizons(NeverFit(), ds, [1, 6], cv=splits)


def test_a_horizon_beyond_every_stretch_of_constant_theta_is_refused():
    theta = [np.repeat([[0.0], [1.0]], 5, axis=0)] * 4
    states = np.random.default_rng(0).normal(size=(4, 11, 1))
    ds = TrajectoryDataset.from_arrays(states, params=theta)
    table = cross_validate_horizons(linear_model(), ds, [1, 5], cv=2)
    assert table["n_episodes"].tolist() == [2] * 4
    with pytest.raises(ValueError, match=r"no forecast reaches the horizons \[8\].*theta changes"):
        cross_validate_horizons(linear_model(), ds, [1, 8], cv=2)


class Mean(BaseEstimator):
    def fit(self, ds):
        return self

    def predict(self, ds, **settings):
        return np.zeros(len(ds))


@pytest.mark.parametrize(
    "call", [lambda *args: cross_validate_horizons(*args, 1), cross_val_forecast]
)
def test_a_model_of_something_else_is_refused(make_ramps, call):
    with pytest.raises(TypeError, match=r"Mean.predict returned ndarray, not a Forecast"):
        call(Mean(), make_ramps(np.ones(6), [3] * 6))


# -- cross_val_forecast -------------------------------------------------------------------


def test_forecasts_come_in_the_order_of_the_episodes(decays):
    cv = KFold(3, shuffle=True, random_state=1)
    forecast = cross_val_forecast(linear_model(), decays, cv)
    assert isinstance(forecast, Forecast)
    for train, test in cv.split(decays):
        own = linear_model().fit(decays[train]).predict(decays[test])
        assert_allclose(forecast[test].mean, own.mean)
    sklearns = cross_val_predict(linear_model(), decays, cv=cv)
    assert isinstance(sklearns, Forecast)
    assert_allclose(sklearns.mean, forecast.mean)


def test_unequal_lengths_and_groups(persistence, make_ramps):
    ds = make_ramps(np.arange(1.0, 7.0), [2, 5, 3, 4, 1, 5], group=list("abcabc"))
    forecast = cross_val_forecast(persistence(), ds, 3)
    assert forecast.lengths.tolist() == ds.lengths.tolist()
    assert_allclose(forecast.initial_states, 0)
    # states are slope * t, and what was at the start is predicted for ever
    errors = horizon_errors(forecast, ds)
    assert errors.notna().sum(axis=1).tolist() == ds.lengths.tolist()
    assert_allclose(errors[1], (np.arange(1.0, 7.0) / 30) ** 2)


def test_each_episode_may_have_its_own_start(persistence, make_ramps):
    ds = make_ramps(np.ones(6), [5] * 6)
    start = np.array([0, 1, 2, 3, 2, 1])
    forecast = cross_val_forecast(persistence(), ds, KFold(3, shuffle=True), start=start, horizon=2)
    assert_allclose(forecast.initial_states[:, 0], start)
    assert forecast.start.tolist() == start.tolist()
    assert len(forecast.horizons) == 2


@pytest.mark.parametrize("ragged", [True, False])
def test_several_starts_an_episode(decays, ragged):
    starts = [[0, 10, 15], [3], *[[2, 7]] * 10] if ragged else np.array([[2, 7]] * 12)
    cv = KFold(3, shuffle=True, random_state=1)
    forecast = cross_val_forecast(linear_model(), decays, cv, start=starts, horizon=4)
    assert forecast.episode.tolist() == [i for i, own in enumerate(starts) for _ in own]
    assert forecast.start.tolist() == [s for own in starts for s in own]
    for train, test in cv.split(decays):
        model = linear_model().fit(decays[train])
        for i in test:
            own = model.predict(decays[[i]], start=[starts[i]], horizon=4)
            assert_allclose(forecast[forecast.episode == i].mean, own.mean)
    errors = horizon_errors(forecast, decays)
    assert errors.index.names == ["episode", "start"]
    assert errors.notna().all(axis=None)


def test_settings_reach_predict(decays):
    net = MLPEnsembleRegressor(probabilistic=True, hidden_layer_sizes=(16,), max_steps=30)
    model = TrajectoryRegressor(net, random_state=0)
    forecast = cross_val_forecast(model, decays, 2, return_std=True, n_samples=3, random_state=0)
    assert forecast.std.shape == forecast.mean.shape
    assert forecast.samples.shape == (3, *forecast.mean.shape)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cv": ShuffleSplit(3, random_state=0)}, "exactly one test set"),
        ({"start": [0, 1]}, "start has 2 entries for 6 episodes"),
        ({"start": np.zeros((2, 6), dtype=int)}, "start has 2 entries for 6 episodes"),
        ({"groups": [1]}, "groups has shape"),
    ],
)
def test_bad_arguments_of_a_forecast_are_refused(make_ramps, arguments, message):
    with pytest.raises(ValueError, match=message):
        cross_val_forecast(NeverFit(), make_ramps(np.ones(6), [3] * 6), **{"cv": 2} | arguments)
