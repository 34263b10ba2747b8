"""A student that learns from what its teacher imagines."""

import numpy as np
import pytest
from sklearn.base import BaseEstimator, clone
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline, make_pipeline

from tests.dynamics.systems import SMALL, gain_policy, linear
from trajlearn import (
    BlockScaler,
    KalmanSmoother,
    LSTMRegressor,
    OneStepRegressor,
    ParamsTransformer,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
    load,
)
from trajlearn.dynamics._differentiable import differentiable
from trajlearn.dynamics._members import member_of, n_members
from trajlearn.dynamics.distilled import DistilledForecaster
from trajlearn.exceptions import MissingFieldError
from trajlearn.testing import check_dynamics_estimator

BOUNDS = [[0.0, 2.0]]
T = TrajectoryRegressor().set_params(**SMALL)


def decay_policy(states, params, times):
    return -params * states


def decays(theta, *, starts=(1.0,), steps=30, **fields):
    """s' = 0.9 s + 0.1 a with a = -theta s, so that s_t = (0.9 - 0.1 theta)^t s_0."""
    theta = np.asarray(theta, dtype=float)[:, None]
    first = np.resize(starts, len(theta))[:, None, None]
    states = first * (0.9 - 0.1 * theta)[..., None] ** np.arange(steps + 1)[:, None]
    actions = -theta[..., None] * states[:, :-1]
    return TrajectoryDataset.from_arrays(states, actions=actions, params=theta, **fields)


def exact(**settings):
    return OneStepRegressor(LinearRegression(), policy=decay_policy, **settings)


def distilled(teacher=None, student=T, **settings):
    settings = {"param_bounds": BOUNDS, "n_imagined": 20, "random_state": 0} | settings
    return DistilledForecaster(teacher or exact(), student, **settings)


class Unsure(BaseEstimator):
    """Teacher whose mean is that of a few particles; it says nothing of policies and inputs."""

    def __init__(self, policy=None):
        self.policy = policy

    def fit(self, X, y=None):
        self.model_ = exact().fit(X)
        return self

    def predict(self, X, *, random_state=None, **settings):
        found = self.model_.predict(X, **settings)
        noise = np.random.default_rng(random_state).normal(size=found.mean.shape)
        return found._replace(mean=found.mean + noise)


class Recorder(BaseEstimator):
    """Student that keeps what it was fitted with."""

    def fit(self, X, y=None, *, sample_weight=None):
        self.ds_, self.weight_ = X, sample_weight
        return self

    def predict(self, X):
        raise NotImplementedError


LOG = decays([0.2, 0.3, 1.0], starts=[1.0, -2.0, 1.5])


# -- what is imagined ---------------------------------------------------------------------


def test_imagined_episodes_are_those_of_the_plant_under_their_theta():
    imagined = distilled(student=Recorder()).fit(LOG).imagined_
    assert len(imagined) == 20
    theta = imagined.params[:, 0]
    assert theta.min() >= 0
    assert 1.5 < theta.max() <= 2
    for episode in imagined:
        first = episode.states[0, 0]
        assert first in (1.0, -2.0, 1.5)
        expected = first * (0.9 - 0.1 * episode.params[0]) ** np.arange(31)
        np.testing.assert_allclose(episode.states[:, 0], expected, atol=1e-9)
    assert len(np.unique(imagined.states[imagined.offsets[:-1]])) == 3


def test_without_bounds_theta_is_within_the_log():
    model = distilled(student=Recorder(), param_bounds=None, n_imagined=100).fit(LOG)
    theta = model.imagined_.params
    np.testing.assert_array_equal(model.param_bounds_, [[0.2, 1.0]])
    assert 0.2 <= theta.min() < 0.3
    assert 0.9 < theta.max() <= 1.0


def test_the_student_learns_from_logged_and_imagined_episodes():
    student = distilled(student=Recorder()).fit(LOG).student_
    assert len(student.ds_) == 23
    np.testing.assert_array_equal(student.ds_[:3].states, LOG.states)
    assert student.ds_.actions is None
    assert student.weight_ is None


def test_initial_states_and_horizon_are_chosen():
    starts = [[3.0], [5.0]]
    ds = decays([0.2, 0.4], steps=12, dt=0.5)
    settings = {"initial_states": starts, "horizon": 40}
    model = distilled(student=Recorder(), **settings).fit(ds)
    imagined = model.imagined_
    assert set(imagined.states[imagined.offsets[:-1], 0]) == {3.0, 5.0}
    assert (imagined.lengths == 40).all()
    np.testing.assert_allclose(imagined.times[:41], 0.5 * np.arange(41))
    assert model.dt_ == 0.5


def test_imagined_states_are_clipped_to_the_reach():
    # |0.9 - 0.1 theta| > 1 for theta > 19
    ds = decays([0.2, 2.0], starts=[1.0, -1.0])
    settings = {"param_bounds": [[0.0, 30.0]], "n_imagined": 60, "reach": 4.0, "horizon": 15}
    imagined = distilled(student=Recorder(), **settings).fit(ds).imagined_
    assert (imagined.lengths == 15).all()
    for episode in imagined:
        alone = episode.states[0, 0] * (0.9 - 0.1 * episode.params[0]) ** np.arange(16)
        # the log lies within -1 and 1
        np.testing.assert_allclose(episode.states[:, 0], np.clip(alone, -4, 4), atol=1e-9)
    assert (np.abs(imagined.states) == 4).sum() > 100


def test_what_diverges_is_as_it_was_before():
    ds = decays([0.2, 2.0], starts=[1.0, -1.0])
    settings = {"param_bounds": [[1e9, 2e9]], "n_imagined": 9}
    states = distilled(student=Recorder(), **settings).fit(ds).imagined_.states.reshape(9, 31)
    assert set(states[:, 0]) == {1.0, -1.0}
    np.testing.assert_array_equal(states, np.repeat(states[:, :1], 31, axis=1))


def test_other_signals_are_those_of_a_logged_episode():
    fields = {
        "references": [np.full((steps + 1, 1), 10.0 * steps) for steps in (9, 6, 9)],
        "context": {"task": ["a", "b", "c"]},
        "time_origin": [-1.0, -2.0, -3.0],
    }
    ds = linear(3, shortest=6, longest=6)
    ds = TrajectoryDataset.from_arrays(
        [e.states[: steps + 1] for e, steps in zip(linear(3, shortest=9, longest=9), (9, 6, 9))],
        params=ds.params,
        **fields,
    )
    teacher = OneStepRegressor(LinearRegression(), inputs="params")
    imagined = distilled(teacher, Recorder(), param_bounds=None).fit(ds).imagined_
    assert len(set(imagined.context["task"])) == 3
    for episode in imagined:
        of = {"a": 0, "b": 1, "c": 2}[episode.context["task"]]
        assert episode.time_origin == -(of + 1)
        assert episode.length == ds.lengths[of]
        assert (episode.references == ds[of].references[0]).all()


def test_where_the_time_step_varies_episodes_end_with_the_log():
    times = [np.cumsum(np.linspace(0.5, 1.5, k)) for k in (9, 7)]
    states = [np.sin(t)[:, None] for t in times]
    ds = TrajectoryDataset.from_arrays(states, params=[[1.0], [2.0]], times=times)
    teacher = OneStepRegressor(LinearRegression(), inputs=("params", "dt"))
    imagined = distilled(teacher, Recorder(), param_bounds=None).fit(ds).imagined_
    assert set(imagined.lengths) == {8, 6}
    for episode in imagined:
        of = 0 if episode.length == 8 else 1
        np.testing.assert_array_equal(episode.times, times[of])
        assert episode.states[0] == states[of][0]
    short = distilled(teacher, Recorder(), param_bounds=None, horizon=5).fit(ds).imagined_
    assert set(short.lengths) == {5}


def test_a_seed_fixes_what_particles_imagine():
    models = [distilled(Unsure(), Recorder(), random_state=seed).fit(LOG) for seed in (1, 1, 2)]
    assert models[0].imagined_ == models[1].imagined_ != models[2].imagined_
    table = [model.set_params(student=T).fit(LOG).fidelity(LOG) for model in models[:2]]
    np.testing.assert_array_equal(table[0], table[1])


def test_weights_count_as_repeated_episodes():
    weighted = distilled(student=Recorder()).fit(LOG, sample_weight=[2, 0, 1])
    repeated = distilled(student=Recorder()).fit(LOG[[0, 0, 2]])
    np.testing.assert_allclose(weighted.imagined_.states, repeated.imagined_.states)
    np.testing.assert_array_equal(weighted.imagined_.params, repeated.imagined_.params)
    np.testing.assert_array_equal(weighted.student_.weight_, [2, 1] + [1] * 20)
    model = distilled(student=Recorder(), weight_logged=5.0).fit(LOG)
    np.testing.assert_array_equal(model.student_.weight_, [5] * 3 + [1] * 20)


def test_weights_reach_the_last_step_of_a_pipeline_or_are_refused():
    student = make_pipeline(ParamsTransformer(np.square), Recorder())
    model = distilled(student=student, weight_logged=5.0).fit(LOG)
    np.testing.assert_array_equal(model.student_[-1].weight_, [5] * 3 + [1] * 20)
    with pytest.raises(TypeError, match="Unsure does not take sample_weight"):
        distilled(Unsure()).fit(LOG, sample_weight=[1, 2, 1])
    # a factor on all says nothing
    assert (
        distilled(Unsure(), Recorder()).fit(LOG, sample_weight=[2, 2, 2]).student_.weight_[0] == 2
    )


def test_groups_of_the_log_stay_together_and_imagined_ones_stand_alone():
    group = distilled(student=Recorder()).fit(LOG, groups=["x", "y", "x"]).student_.ds_.group
    assert group[0] == group[2] != group[1]
    assert len(set(group)) == 22


# -- what it is for -----------------------------------------------------------------------


def test_it_knows_theta_that_the_log_has_not():
    student = clone(T).set_params(estimator__max_steps=300)
    test = decays(np.linspace(0, 2, 15), starts=[-1.5, 0.5, 1.0])
    model = distilled(student=student, n_imagined=100).fit(LOG)
    plain = clone(student).set_params(random_state=0).fit(LOG)
    gap = [np.abs(m.predict(test).mean[..., 0] - truth(test)).mean() for m in (model, plain)]
    assert 4 * gap[0] < gap[1]


def truth(ds):
    return ds.states.reshape(len(ds), -1)[:, 1:]


def test_fidelity_tells_what_distilling_cost():
    test = decays([0.0, 1.3, 1.9], starts=[-1.5, 0.5, 1.0])
    model = distilled().fit(LOG)
    table = model.fidelity(test, horizons=[1, 5, 30])
    width = np.ptp(LOG.states)
    gap = (model.predict(test).mean[..., 0] - truth(test)) / width
    expected = np.sqrt((gap**2).mean(axis=0))[[0, 4, 29]]
    np.testing.assert_allclose(table["student"], expected)
    # this teacher is exact
    np.testing.assert_allclose(table["student_teacher"], expected, rtol=1e-6)
    assert (table["teacher"] < 1e-9).all()
    assert list(table["horizon"]) == [1, 5, 30]
    assert list(table["n"]) == [3, 3, 3]
    assert len(model.fidelity(test)) == 30
    with pytest.raises(ValueError, match="from 1 to 30"):
        model.fidelity(test, horizons=[31])


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.DivergenceWarning")
def test_fidelity_is_infinite_where_the_teacher_diverges():
    ds = decays([0.2, 2.0], starts=[1.0, -1.0])
    model = distilled(param_bounds=[[0.0, 100.0]]).fit(ds)
    test = decays([0.5, 0.1]).assign(params=[[0.5], [99.0]])
    table = model.fidelity(test, horizons=[1, 30])
    np.testing.assert_array_equal(np.isinf(table["student_teacher"]), [False, True])
    assert np.isfinite(table["student"]).all()


def test_fidelity_compares_the_steps_that_both_forecast():
    theta = np.repeat(LOG.params[:, None], 30, axis=1)
    theta[0, 12:] = 0.6
    test = LOG.assign(params=list(theta))
    model = distilled().fit(LOG)
    # the student ends where theta changes
    table = model.fidelity(test, horizons=[12, 13])
    assert list(table["n"]) == [3, 2]
    # beyond, the teacher is off, too: the states are those of the first theta
    assert (table["teacher"] < 1e-9).all()
    assert len(model.fidelity(test[:1])) == 12
    with pytest.raises(ValueError, match="from 1 to 12, the longest forecast of both"):
        model.fidelity(test[:1], horizons=[13])


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.SmoothingWarning")
def test_states_that_a_smoother_appends_are_told_from_the_logged_ones():
    smoother = KalmanSmoother(append_velocities=True, measurement_noise=1e-3)
    teacher = make_pipeline(smoother, OneStepRegressor(LinearRegression(), inputs="params"))
    model = distilled(teacher, make_pipeline(smoother, T)).fit(LOG)
    assert model.imagined_.state_names == ("s0",)
    forecast = model.predict(LOG)
    assert forecast.state_names == ("s0", "d_s0")
    np.testing.assert_array_equal(forecast.state_range[:, 0], [-2.0, 1.5])
    assert forecast.state_range.shape == (2, 2)
    table = model.fidelity(LOG, horizons=[3])
    gap = forecast.mean[:, 2, 0] - model.teacher_.predict(LOG).mean[:, 2, 0]
    np.testing.assert_allclose(table["student_teacher"], np.sqrt(np.mean((gap / 3.5) ** 2)))


def test_a_teacher_that_leaves_states_out_is_refused():
    ds = linear(3, shortest=5, longest=5)

    class Blind(Unsure):
        def fit(self, X, y=None):
            self.model_ = TrajectoryRegressor(LinearRegression()).fit(X.select_states(["s1"]))
            return self

        def predict(self, X, *, random_state=None, **settings):
            return self.model_.predict(X.select_states(["s1"]), **settings)

    with pytest.raises(
        ValueError, match=r"teacher \(Blind\) predicts the states \['s1'\].*\['s0'\]"
    ):
        distilled(Blind(), Recorder(), param_bounds=None).fit(ds)


def test_it_plans_if_the_student_does():
    assert hasattr(DistilledForecaster(), "predict_trajectory")
    assert not hasattr(distilled(student=make_pipeline(T)), "predict_trajectory")


def test_a_fit_that_fails_leaves_the_one_before():
    class Late(Recorder):
        def fit(self, X, y=None, *, sample_weight=None):
            raise RuntimeError("late")

    model = distilled().fit(LOG)
    before = vars(model).copy()
    with pytest.raises(RuntimeError, match="late"):
        model.set_params(student=Late()).fit(LOG[:2])
    fitted = [name for name in before if name.endswith("_")]
    assert "teacher_" in fitted
    assert all(getattr(model, name) is before[name] for name in fitted)


def test_forecasts_are_the_students():
    model = distilled(param_bounds=[[0.0, 25.0]]).fit(LOG)
    assert np.ptp(model.imagined_.states) > 2 * np.ptp(LOG.states)
    assert not hasattr(model.student_, "teacher")
    forecast = model.predict(LOG, return_std=True)
    np.testing.assert_array_equal(forecast.mean, model.student_.predict(LOG).mean)
    assert forecast.std is not None
    np.testing.assert_array_equal(forecast.state_range, [[-2.0], [1.5]])
    planned = {"params": [[0.5], [1.5]], "horizons": [2.5, 7.0]}
    np.testing.assert_array_equal(
        model.predict_trajectory([1.0], **planned).mean,
        model.student_.predict_trajectory([1.0], **planned).mean,
    )
    reward = model.predict_reward(LOG, lambda states: -(states[..., 0] ** 2))
    np.testing.assert_allclose(reward, -(forecast.mean[..., 0] ** 2).mean(axis=1))
    assert model.score(LOG) > -1
    assert model.max_horizon_ == 30


def test_what_looks_into_a_model_finds_the_student():
    student = clone(T).set_params(estimator__n_members=2)
    model = distilled(student=student).fit(LOG)
    theta, horizons = [[0.5], [1.5]], [2.0, 7.0]
    means = differentiable(model)([[1.0], [1.0]], theta, horizons).detach().numpy()
    found = model.predict_trajectory([1.0], params=theta, horizons=horizons)
    np.testing.assert_allclose(means.mean(axis=0), found.mean, atol=1e-5)
    assert n_members(model) == 2
    one = member_of(model, 1).predict_trajectory([1.0], params=theta, horizons=horizons)
    np.testing.assert_allclose(means[1], one.mean, atol=1e-5)


# -- teachers -----------------------------------------------------------------------------


def test_a_teacher_without_a_policy_is_refused_naming_it():
    for teacher in (None, OneStepRegressor(), Pipeline([("model", OneStepRegressor())])):
        with pytest.raises(ValueError, match=r"OneStepRegressor\(policy=.*inputs=\"params\""):
            DistilledForecaster(teacher).fit(LOG)
    model = DistilledForecaster(student=Recorder()).set_params(
        teacher__policy=decay_policy, teacher__estimator=LinearRegression()
    )
    assert model.fit(LOG).teacher_.clip_states == 3.0


@pytest.mark.parametrize(
    "teacher",
    [
        OneStepRegressor(LinearRegression(), inputs="params"),
        Pipeline([("model", exact())]),
        LSTMRegressor(policy=decay_policy, max_steps=2, hidden_size=2, clip_states=2.0),
        TrajectoryRegressor().set_params(**SMALL),
    ],
    ids=["closed loop", "pipeline", "lstm", "trajectory"],
)
def test_any_forecaster_teaches(teacher):
    model = distilled(teacher, Recorder(), reach=100.0).fit(LOG)
    assert len(model.imagined_) == 20
    assert (model.imagined_.lengths == 30).all()


def test_a_fitted_teacher_is_taken_as_it_is():
    teacher = exact().fit(LOG)
    other = LOG.assign(actions=[np.zeros((30, 1))] * 3)
    model = distilled(FrozenEstimator(teacher), Recorder()).fit(other)
    assert model.imagined_ == distilled(student=Recorder()).fit(LOG).imagined_


# -- bad input ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"param_bounds": [[0, 1], [0, 1]]}, r"shape \(2, 2\).*the 1 params, \(1, 2\)"),
        ({"param_bounds": [[2, 1]]}, "no lower bound above"),
        ({"param_bounds": [[0, np.nan]]}, "must be finite"),
        ({"initial_states": [[1.0, 2.0]]}, r"expected \(k, 1\)"),
        ({"initial_states": [[np.inf]]}, "NaN or infinite"),
        ({"n_imagined": 0}, "'n_imagined' parameter"),
        ({"reach": 0.5}, "'reach' parameter"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        distilled(**settings).fit(LOG)


def test_bad_episodes_are_refused():
    with pytest.raises(TypeError, match="not rows"):
        distilled().fit(np.ones((5, 3)))
    with pytest.raises(ValueError, match="at least one episode"):
        distilled().fit([])
    with pytest.raises(ValueError, match="y must be omitted"):
        distilled().fit(LOG, LOG)
    with pytest.raises(MissingFieldError, match="needs params"):
        distilled().fit(LOG.assign(params=None))
    with pytest.raises(ValueError, match="one finite weight"):
        distilled().fit(LOG, sample_weight=[1, 2])
    with pytest.raises(ValueError, match="zero everywhere"):
        distilled().fit(LOG, sample_weight=[0, 0, 0])


# -- as any other dynamics estimator ------------------------------------------------------


@pytest.mark.parametrize(
    "teacher",
    [
        OneStepRegressor(LinearRegression(), policy=gain_policy),
        OneStepRegressor(LinearRegression(), inputs="params"),
    ],
    ids=["policy", "closed loop"],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_contract_holds(teacher):
    student = clone(T).set_params(estimator__max_steps=10)
    check_dynamics_estimator(DistilledForecaster(teacher, student, n_imagined=10))


def test_search_reaches_teacher_student_and_defaults():
    names = DistilledForecaster().get_params()
    assert {"teacher__policy", "student__estimator__max_steps"} <= set(names)
    assert names["teacher"] is None
    grid = {"student__gate": [0.1, 0.5], "n_imagined": [5]}
    search = GridSearchCV(distilled(), grid, cv=3, error_score="raise").fit(LOG)
    assert search.best_estimator_.student_.gate in (0.1, 0.5)


def test_it_is_saved_with_what_it_imagined(tmp_path):
    student = clone(T).set_params(
        scaler=BlockScaler(param_bounds=np.array(BOUNDS)), relabeler=SubtrajectoryRelabeler()
    )
    teacher = OneStepRegressor(policy=decay_policy, clip_states=3.0).set_params(**SMALL)
    model = distilled(teacher, student, param_bounds=np.array(BOUNDS)).fit(LOG)
    model.save(tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors", callables={"decay_policy": decay_policy})
    np.testing.assert_array_equal(again.predict(LOG).mean, model.predict(LOG).mean)
    assert again.imagined_ == model.imagined_
    np.testing.assert_array_equal(again.fidelity(LOG), model.fidelity(LOG))
