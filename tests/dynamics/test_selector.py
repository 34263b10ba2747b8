"""The member that is best at each horizon, on held-out episodes."""

import pickle
import warnings

import numpy as np
import pytest
from joblib import parallel_config
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, GroupKFold, KFold
from sklearn.pipeline import Pipeline

from tests.dynamics.crossing import Off, decays
from tests.dynamics.systems import SMALL, gain_policy, linear
from trajlearn import (
    CalibratedForecaster,
    HoldForecaster,
    LinearFeedback,
    OneStepRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
    load,
)
from trajlearn.control import PolicySearch
from trajlearn.dynamics.selector import HorizonSelector
from trajlearn.evaluation import cross_val_forecast
from trajlearn.exceptions import DivergenceWarning

T = TrajectoryRegressor().set_params(**SMALL)
C = OneStepRegressor(inputs="params").set_params(**SMALL)
D = OneStepRegressor(LinearRegression())
EARLY, LATE = Off(0.0, 0.2), Off(0.2, 0.0)


def selector(*members, **settings):
    names = [f"m{i}" for i in range(len(members))]
    # all members are judged by all episodes; the race has tests of its own
    settings = {"random_state": 0, "race": False, **settings}
    return HorizonSelector(list(zip(names, members)), **settings)


def law(ds, steps=40):
    """0.9^h s_0."""
    return ds.states[ds.offsets[:-1]][:, None] * 0.9 ** np.arange(1, steps + 1)[None, :, None]


# -- who is chosen where ------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["pick", "blend"])
def test_each_member_forecasts_where_it_is_right(rule):
    ds = decays()
    model = selector(EARLY, LATE, rule=rule, bandwidth=0.0).fit(ds)
    np.testing.assert_array_equal(model.choice_, ["m0"] * 10 + ["m1"] * 30)
    assert model.best_ == "m1"
    np.testing.assert_allclose(model.weights_.sum(axis=1), 1)
    gap = np.abs(model.predict(ds).mean - law(ds)).max()
    assert gap < (1e-12 if rule == "pick" else 0.02)
    assert list(model.names_) == ["m0", "m1"]
    assert [type(m) for m in model.estimators_] == [Off, Off]


def test_the_errors_are_those_of_held_out_episodes_in_training_ranges():
    ds = decays(noise=0.05)
    model = selector(HoldForecaster(), Off(0.3, by_param=True), cv=3).fit(ds)
    low, high = ds.states.min(), ds.states.max()
    truth = np.stack([e.states[1:, 0] for e in ds])
    first = ds.states[ds.offsets[:-1]]
    hold = ((truth - first) / (high - low)) ** 2
    off = (truth - law(ds)[..., 0] - 0.3 * ds.params * (np.arange(40) < 10)) / (high - low)
    table = model.cv_errors_.set_index(["member", "horizon"])
    np.testing.assert_allclose(table.loc["m0", "median"], np.median(hold, axis=0))
    np.testing.assert_allclose(table.loc["m1", "mean"], (off**2).mean(axis=0))
    assert (table["n_episodes"] == 24).all()
    assert (table["n_diverged"] == 0).all()


def test_members_are_judged_on_episodes_they_were_not_fitted_on():
    class Memory(Off):
        """Right about the episodes it was fitted on, off by 1 elsewhere."""

        def _learn(self, ds):
            self.ids_ = ds.ids

        def _forecast(self, query, request):
            prediction = super()._forecast(query, request)
            prediction.mean[~np.isin(query.ds.ids, self.ids_)] += 1.0
            return prediction

    model = selector(Memory(), Off(0.1, 0.1)).fit(decays())
    assert model.best_ == "m1"
    # and fitted on all in the end
    assert len(model.estimators_[0].ids_) == 24


def test_a_member_that_is_better_by_chance_does_not_override():
    ds = decays(noise=0.2, steps=60)
    members = [Off(0.005, 0.005), Off(-0.005, -0.005)]
    changes = [
        int(np.diff(selector(*members, margin=m, bandwidth=0.0).fit(ds).weights_[:, 0] > 0).sum())
        for m in (0.0, 5.0)
    ]
    assert changes[0] > 3
    assert changes[1] == 0


def test_the_bandwidth_joins_neighbouring_horizons():
    ds = decays(noise=0.2, steps=60)
    members = [Off(0.005, 0.005), Off(-0.005, -0.005)]
    changes = [
        np.count_nonzero(
            np.diff(selector(*members, margin=0.0, bandwidth=b).fit(ds).weights_[:, 0])
        )
        for b in (0.0, 1.0)
    ]
    assert changes[1] < changes[0] / 2


def test_equal_members_are_decided_for_the_first():
    model = selector(EARLY, clone(EARLY), margin=0.0).fit(decays())
    assert set(model.choice_) == {"m0"}
    report = model.report()
    assert report["ratio"].tolist() == [1.0]


def test_one_member_is_chosen_everywhere():
    model = selector(EARLY).fit(decays())
    assert set(model.choice_) == {"m0"}
    report = model.report()
    assert report.shape[0] == 1
    assert report.loc[0, "second"] is None


def test_two_episodes_are_left_out_one_by_one():
    model = selector(EARLY, LATE, bandwidth=0.0).fit(decays(2))
    assert (model.cv_errors_["n_episodes"] == 2).all()
    # sure enough all the same
    np.testing.assert_array_equal(model.choice_, ["m0"] * 10 + ["m1"] * 30)


@pytest.mark.parametrize(("n", "n_fits"), [(2, 2), (5, 5), (6, 4), (30, 4)])
def test_few_episodes_are_left_out_one_by_one(n, n_fits):
    fits = []

    class Counts(Off):
        def _learn(self, ds):
            fits.append(len(ds))

    selector(Counts()).fit(decays(n))
    assert len(fits) == n_fits + 1
    assert fits[-1] == n


def test_episodes_that_end_early_count_for_the_horizons_they_have():
    lengths = np.r_[np.full(20, 8), np.full(4, 40)]
    model = selector(EARLY, LATE, bandwidth=0.0).fit(decays(lengths=lengths))
    np.testing.assert_array_equal(model.choice_, ["m0"] * 10 + ["m1"] * 30)
    count = model.cv_errors_.query("member == 'm0'")["n_episodes"]
    np.testing.assert_array_equal(count, [24] * 8 + [4] * 32)


def test_who_forecasts_to_the_end_of_a_stretch_only_is_not_chosen_beyond():
    ds = decays()
    model = selector(Off(0.1, 0.1), Off(goes=15)).fit(ds)
    np.testing.assert_array_equal(model.choice_, ["m1"] * 15 + ["m0"] * 25)
    forecast = model.predict(ds)
    assert (forecast.lengths == 40).all()
    assert np.isfinite(forecast.mean).all()
    # alone it decides how far forecasts go
    assert (selector(Off(goes=15)).fit(ds).predict(ds).lengths == 15).all()


def test_groups_stay_together():
    seen = []

    class Looks(Off):
        def _learn(self, ds):
            seen.append(set(ds.group))

    ds = decays(12, group=np.repeat(["a", "b", "c", "d", "e", "f"], 2))
    selector(Looks(), cv=3).fit(ds)
    assert [len(groups) for groups in seen] == [4, 4, 4, 6]
    seen.clear()
    selector(Looks(), cv=3).fit(decays(12), groups=np.repeat([0, 1], 6))
    assert [len(groups) for groups in seen] == [1, 1, 2]


def test_few_groups_are_as_unsure_as_they_are_few():
    ds = decays(40, noise=0.0, seed=3)
    # in which of four groups an episode is decides whether the member is off
    theta = np.repeat([1.0, 1.0, 0.0, 0.05], 10)
    ds = ds.assign(params=theta[:, None])
    members = Off(0.05, 0.05), Off(0.04, 0.12, by_param=True)
    alone = selector(*members, margin=2.0).fit(ds)
    grouped = selector(*members, margin=2.0).fit(ds, groups=np.repeat(np.arange(4), 10))
    errors = [m.report()["standard_errors"].abs().max() for m in (alone, grouped)]
    assert errors[1] < errors[0] / 2


def test_splitters_are_taken_and_double_use_is_refused():
    ds = decays(12, group=np.arange(12) // 2)
    for cv in (KFold(3), GroupKFold(3), [(np.arange(6), np.arange(6, 12))]):
        model = selector(EARLY, LATE, cv=cv).fit(ds)
        assert len(set(model.choice_)) == 2
    with pytest.raises(ValueError, match="holds out an episode twice"):
        selector(EARLY, cv=[(np.arange(6), np.arange(6, 12))] * 2).fit(ds)
    with pytest.raises(ValueError, match="trains on episodes that it holds out"):
        selector(EARLY, cv=[(np.arange(12), np.arange(6, 12))]).fit(ds)


# -- divergence ---------------------------------------------------------------------------


def test_a_member_that_diverges_loses_where_it_does():
    ds = decays()
    with warnings.catch_warnings():
        warnings.simplefilter("error", DivergenceWarning)
        model = selector(Off(diverges=0.5), Off(0.05, 0.05), bandwidth=0.0).fit(ds)
    np.testing.assert_array_equal(model.choice_, ["m0"] * 5 + ["m1"] * 35)
    members = model.report(by="member")
    assert members.loc["m0", "n_diverged"] == 12
    assert "m0 12" in model.diagnosis()
    table = model.cv_errors_.set_index(["member", "horizon"])
    assert np.isinf(table.loc[("m0", 6), "mean"])
    assert np.isfinite(model.predict(ds).mean).all()


@pytest.mark.parametrize("rule", ["pick", "blend"])
def test_where_all_diverge_the_forecast_does_and_says_so_once(rule):
    ds = decays()
    model = selector(Off(diverges=0.5), Off(0.01, diverges=0.5), rule=rule).fit(ds)
    with pytest.warns(DivergenceWarning, match="12 of 24 forecasts diverged") as caught:
        forecast = model.predict(ds, return_std=True, n_samples=2, random_state=0)
    assert len([w for w in caught if w.category is DivergenceWarning]) == 1
    np.testing.assert_array_equal(forecast.diverged_at, np.where(ds.params[:, 0] > 0.5, 6, 0))
    for values in (forecast.mean, forecast.std, forecast.samples[0]):
        assert np.isinf(values[-1, 5:]).all()
        assert np.isfinite(values[0]).all()


# -- forecasts ----------------------------------------------------------------------------


def test_members_are_asked_only_as_far_as_they_are_chosen():
    asked = []

    class Tells(Off):
        def _forecast(self, query, request):
            asked.append((self.early, query.n_steps))
            return super()._forecast(query, request)

    ds = decays()
    model = selector(Tells(0.0, 0.2), Tells(0.3, 0.0), Tells(0.5, 0.5), bandwidth=0.0).fit(ds)
    asked.clear()
    whole = model.predict(ds)
    assert asked == [(0.0, 10), (0.3, 40)]
    asked.clear()
    short = model.predict(ds, horizon=7)
    assert asked == [(0.0, 7)]
    np.testing.assert_array_equal(short.mean, whole.mean[:, :7])
    asked.clear()
    late = model.predict(ds, start=np.arange(24), horizon=None)
    assert asked[0][1] == 23 + 10
    np.testing.assert_array_equal(late.lengths, 40 - np.arange(24))


def test_beyond_the_longest_held_out_episode_the_last_choice_is_kept():
    ds = decays()
    model = selector(EARLY, LATE).fit(ds)
    forecast = model.predict(ds, horizon=60)
    np.testing.assert_allclose(forecast.mean[:, 10:], law(ds, 60)[:, 10:])
    assert forecast.mean.shape == (24, 60, 1)


def test_horizons_in_time_are_those_of_the_next_step():
    ds = linear(12, shortest=12, longest=12, dt=0.5)
    members = [("D", clone(D).set_params(policy=gain_policy)), ("T", T)]
    model = HorizonSelector(members, random_state=0, bandwidth=0.0).fit(ds)
    model.weights_ = np.repeat(np.eye(2), [4, 8], axis=0)
    first = ds.states[ds.offsets[:-1]]
    settings = {"params": ds.params, "horizons": 0.5 * np.arange(1, 9)}
    found = model.predict_trajectory(first, **settings)
    one, other = (m.predict_trajectory(first, **settings).mean for m in model.estimators_)
    np.testing.assert_array_equal(found.mean[:, :4], one[:, :4])
    np.testing.assert_array_equal(found.mean[:, 4:], other[:, 4:])
    assert found.actions == "policy"
    # known actions go to all members
    actions = np.zeros((8, 1))
    found = model.predict_trajectory(first, actions=actions, **settings)
    assert found.actions == "logged"
    assert np.abs(found.mean[:, :4] - one[:, :4]).max() > 1e-3


def test_planning_takes_what_its_members_take():
    ds = decays()
    assert not hasattr(selector(HoldForecaster(), T), "predict_trajectory")
    assert hasattr(selector(C, T), "predict_trajectory")
    # who is not chosen is not asked
    closed = OneStepRegressor(LinearRegression(), inputs="params")
    model = selector(HoldForecaster(), closed).fit(ds)
    assert set(model.choice_) == {"m1"}
    assert hasattr(model, "predict_trajectory")


def test_actions_are_recorded_whoever_is_chosen():
    ds = linear(12)
    members = [("D", D), ("T", T)]
    model = HorizonSelector(members, random_state=0).fit(ds)
    for weights in np.eye(2):
        model.weights_ = np.tile(weights, (12, 1))
        assert model.predict(ds).actions == "logged"
        # logged actions end with the log
        assert (model.predict(ds, horizon=50).lengths == ds.lengths).all()
        assert model.predict(ds, actions="policy", policy=gain_policy).actions == "policy"
    assert HorizonSelector([("C", C), ("T", T)]).fit(ds).predict(ds).actions == "none"


def test_the_policy_goes_to_members_without_one():
    ds = linear(12)
    other = LinearFeedback(bounds=None)
    behind = Pipeline([("model", OneStepRegressor(LinearRegression()))])
    members = [("D", D), ("own", clone(D).set_params(policy=other))]
    members += [("piped", behind), ("T", T)]
    model = HorizonSelector(members, policy=gain_policy).fit(ds)
    assert model.estimators_[0].policy is gain_policy
    assert model.estimators_[1].policy is not gain_policy
    assert model.estimators_[2][-1].policy is gain_policy
    assert members[0][1].policy is None


# -- uncertainty --------------------------------------------------------------------------


def test_members_without_std_get_their_held_out_errors():
    ds = decays(400, noise=0.1)
    model = selector(Off(0.0, 0.3)).fit(ds)
    std = model.predict(ds[:3], return_std=True).std[..., 0]
    np.testing.assert_allclose(std[:, :6], 0.1, rtol=0.1)
    np.testing.assert_allclose(std[:, 20:], np.hypot(0.1, 0.3), rtol=0.1)
    samples = model.predict(ds[:3], n_samples=4000, random_state=0).samples[..., 0]
    np.testing.assert_allclose(samples.std(axis=0), std, rtol=0.1)
    # the error late in an episode is the same at all steps, the noise is not
    late = np.corrcoef(samples[:, 0, 20:].T)[np.triu_indices(20, 1)].mean()
    early = np.corrcoef(samples[:, 0, :6].T)[np.triu_indices(6, 1)].mean()
    assert late > 0.6
    assert abs(early) < 0.2


def test_members_with_std_keep_theirs():
    ds = decays()
    model = selector(Off(0.0, 0.3, std=0.5), Off(0.3, 0.0, std=2.0), bandwidth=0.0).fit(ds)
    std = model.predict(ds, return_std=True).std
    assert (std[:, :10] == 0.5).all()
    assert (std[:, 10:] == 2.0).all()


def test_a_blend_is_the_mixture_of_its_members():
    ds = decays(60)
    members = Off(0.1, 0.1, std=0.5), Off(-0.2, -0.2, std=0.1)
    model = selector(*members, rule="blend").fit(ds)
    np.testing.assert_allclose(model.weights_, np.tile([2 / 3, 1 / 3], (40, 1)), atol=0.03)
    forecast = model.predict(ds[:2], return_std=True, n_samples=20_000, random_state=0)
    w = model.weights_.T[..., None]
    means = np.stack([law(ds[:2]) + 0.1, law(ds[:2]) - 0.2], axis=0)
    mean = (w[:, None] * means).sum(axis=0)
    np.testing.assert_allclose(forecast.mean, mean)
    within = w[:, None] * (np.array([0.25, 0.01])[:, None, None, None] + (means - mean) ** 2)
    np.testing.assert_allclose(forecast.std, np.sqrt(within.sum(axis=0)))
    np.testing.assert_allclose(forecast.samples.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(forecast.samples.std(axis=0), forecast.std, rtol=0.03)
    # whole trajectories: each stays with its member (its noise is the same at all steps)
    steps = forecast.samples[:, 0, :, 0] - mean[0, :, 0]
    assert np.corrcoef(steps[:, 0], steps[:, -1])[0, 1] > 0.95


def test_seeds_decide_the_samples():
    ds = decays()
    model = selector(EARLY, LATE).fit(ds)
    one, again, other = (model.predict(ds, n_samples=2, random_state=s).samples for s in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_calibration_goes_around_it():
    ds = decays(120, noise=0.1)
    model = CalibratedForecaster(selector(EARLY, LATE), cv=0.4, random_state=0).fit(ds[:80])
    lower, upper = model.predict(ds[80:], return_std=True).interval(0.9)
    truth = np.stack([e.states[1:] for e in ds[80:]])
    assert 0.85 < ((lower <= truth) & (truth <= upper)).mean() < 0.97


# -- as an estimator ----------------------------------------------------------------------


def test_members_are_reached_by_their_names():
    model = HorizonSelector([("D", clone(D)), ("T", clone(T))])
    params = model.get_params()
    assert params["T__estimator__max_steps"] == 40
    assert params["D"] is model.estimators[0][1]
    model.set_params(T__estimator__max_steps=7, D=C, margin=2.0)
    assert model.estimators[1][1].estimator.max_steps == 7
    assert model.estimators[0][1] is C
    assert model.margin == 2.0
    assert [name for name, _ in model.set_params(D="drop").estimators] == ["D", "T"]
    assert model.fit(decays(6)).names_ == ("T",)
    with pytest.raises(ValueError, match="Invalid parameter 'E'"):
        model.set_params(E__inputs="params")
    assert "estimators" in HorizonSelector().get_params()


def test_search_reaches_members_and_rules():
    grid = {"m0__early": [0.0, 1.0], "rule": ["pick", "blend"]}
    search = GridSearchCV(selector(EARLY), grid, cv=2).fit(decays(12))
    assert search.best_params_["m0__early"] == 0.0


def test_out_of_fold_forecasts_of_changing_choices_are_joined():
    ds = linear(12)
    model = HorizonSelector([("D", clone(D)), ("T", T)], policy=gain_policy, random_state=0)
    forecast = cross_val_forecast(model, ds, cv=3)
    assert len(forecast) == 12
    assert forecast.actions == "policy"


def test_the_number_of_workers_changes_nothing():
    ds = decays(8)
    alone = HorizonSelector([("C", C), ("T", T)], random_state=0).fit(ds)
    with parallel_config("threading"):
        together = clone(alone).set_params(n_jobs=2).fit(ds)
    np.testing.assert_array_equal(alone.weights_, together.weights_)
    np.testing.assert_array_equal(alone.predict(ds).mean, together.predict(ds).mean)


def test_progress_is_shown_if_asked_for(capsys):
    selector(EARLY).fit(decays(6))
    assert capsys.readouterr().err == ""
    selector(EARLY, LATE, verbose=1).fit(decays(6))
    shown = capsys.readouterr().err
    assert "members" in shown
    assert "2 of 2 members, folds 1-4 and all" in shown
    assert "10/10" in shown


def test_pickled_and_saved(tmp_path):
    ds = decays(8)
    model = HorizonSelector([("C", C), ("T", T)], rule="blend", random_state=0).fit(ds)
    model.save(tmp_path / "model.safetensors")
    settings = {"return_std": True, "n_samples": 2, "random_state": 0}
    expected = model.predict(ds, **settings)
    for copy in (pickle.loads(pickle.dumps(model)), load(tmp_path / "model.safetensors")):
        found = copy.predict(ds, **settings)
        for name in ("mean", "std", "samples"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        assert copy.report().equals(model.report())
        assert copy.diagnosis() == model.diagnosis()


def test_a_frozen_member_is_taken_as_it_is():
    ds = decays()
    fitted = Off(0.0, 0.1).fit(ds[:3])
    model = selector(FrozenEstimator(fitted), Off(0.5, 0.5)).fit(ds[3:])
    assert model.estimators_[0].estimator is fitted
    assert model.best_ == "m0"


def test_distilled_into_one_trajectory_model():
    ds = linear(20, seed=3)
    members = [("D", clone(D).set_params(policy=gain_policy)), ("T", T)]
    model = HorizonSelector(members, random_state=0).fit(ds[:15])
    student = TrajectoryRegressor().set_params(**SMALL | {"estimator__max_steps": 400})
    distilled = model.distill(ds[:15], student, n_imagined=100, random_state=0)
    fidelity = distilled.fidelity(ds[15:], horizons=[1, 5])
    # the noise of the logged actions is all that the teacher does not know
    assert (fidelity["student_teacher"] < 0.1).all()
    assert (fidelity["teacher"] < 0.2).all()
    assert distilled.teacher_.estimator is model


# -- bad input ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("estimators", "message"),
    [
        ([("a", EARLY), ("a", LATE)], "a name twice"),
        ([("a__b", EARLY)], "the name 'a__b'"),
        ([("margin", EARLY)], "the name 'margin'"),
        ([(1, EARLY)], "the name 1"),
        ([EARLY, LATE], r"list of \(name, estimator\)"),
        ([("a", "drop")], "one estimator or more"),
        ([("a", "drops"), ("b", EARLY)], "'drop' leaves one out"),
        ([], "one estimator or more"),
    ],
)
def test_wrong_members_are_refused(estimators, message):
    with pytest.raises(ValueError, match=message):
        HorizonSelector(estimators).fit(decays(4))


def test_what_is_no_estimator_is_refused():
    with pytest.raises(TypeError, match="lacks fit or predict"):
        HorizonSelector([("a", 3.0)]).fit(decays(4))

    class PredictsNumbers(Off):
        def predict(self, X, **settings):
            return np.zeros(len(X))

    with pytest.raises(TypeError, match="not a Forecast"):
        HorizonSelector([("a", PredictsNumbers())]).fit(decays(4))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cv": 1}, "'cv' parameter"),
        ({"rule": "best"}, "'rule' parameter"),
        ({"margin": -1}, "'margin' parameter"),
        ({"bandwidth": -1}, "'bandwidth' parameter"),
        ({"n_blended": 0}, "'n_blended' parameter"),
        ({"policy": "learn"}, "'policy' parameter"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        selector(EARLY, **settings).fit(decays(4))


def test_too_little_to_judge_by_is_refused():
    with pytest.raises(ValueError, match="only one episode"):
        selector(EARLY).fit(decays(1))
    with pytest.raises(ValueError, match="only one group"):
        selector(EARLY).fit(decays(4), groups=[0, 0, 0, 0])
    with pytest.raises(TypeError, match="whole episodes"):
        selector(EARLY).fit(np.zeros((4, 2)))


def test_members_of_different_states_are_refused():
    class Renames(Off):
        def _learn(self, ds):
            self.state_names_ = ("other",)

    with pytest.raises(ValueError, match="'m0' s0; 'm1' other"):
        selector(EARLY, Renames()).fit(decays(4))


def test_an_error_names_the_member():
    class Fails(Off):
        def _learn(self, ds):
            raise ValueError("no")

    with pytest.raises(ValueError, match="no") as caught:
        selector(EARLY, Fails()).fit(decays(4))
    assert "'m1'" in caught.value.__notes__[0]


def test_a_report_is_by_horizon_or_member():
    model = selector(EARLY, LATE, bandwidth=0.0).fit(decays())
    with pytest.raises(ValueError, match="by = 'time'"):
        model.report(by="time")


def test_control_searches_on_top_of_it():
    # s' = 0.9 s + 0.1 a with a = -theta s falls fastest with the largest theta
    theta = np.linspace(0.2, 1.0, 8)[:, None]
    states = (0.9 - 0.1 * theta)[..., None] ** np.arange(21)[:, None]
    actions = -theta[..., None] * states[:, :-1]
    ds = TrajectoryDataset.from_arrays(states, actions=actions, params=theta)
    members = [("D", clone(D)), ("T", T)]
    model = HorizonSelector(members, policy=lambda s, theta, t: -theta * s, random_state=0)
    search = PolicySearch(
        model,
        bounds=[[0.0, 2.0]],
        reward=lambda states: -(states[..., 0] ** 2),
        horizon=10,
        initial_states=[[1.0]],
        n_evaluations=60,
        random_state=0,
    )
    for episode in ds:
        search.tell(episode)
    assert search.ask()[0] > 1.5
