"""Uncertainty along a roll-out: against closed forms where there are any."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils._param_validation import InvalidParameterError

from tests.dynamics.systems import SMALL, A, Affine, B, closed_loop, gain_policy, linear, truth
from trajlearn import MLPEnsembleRegressor, OneStepRegressor, TrajectoryDataset
from trajlearn.exceptions import DivergenceWarning

PARTICLES = ["tsinf", "ts1", "expectation"]
GAUSSIANS = ["moment", "unscented"]


class Linear(LinearRegression):
    """Least squares of polynomials, with a known standard deviation."""

    def __init__(self, std=0.1, degree=1):
        super().__init__()
        self.std = std
        self.degree = degree

    def fit(self, X, y):
        return super().fit(PolynomialFeatures(self.degree).fit_transform(X), y)

    def predict(self, X, return_std=False):
        mean = super().predict(PolynomialFeatures(self.degree).fit_transform(X))
        return (mean, np.full(mean.shape, self.std)) if return_std else mean


def closed_form(transitions, inputs, noise, initial):
    """Means, covariances and cross-covariances of z' = F_t z + c_t + N(0, noise)."""
    mean, covariance = initial, np.zeros(noise.shape)
    means, joint = [], np.zeros((len(transitions), len(transitions), *noise.shape))
    for t, (f, c) in enumerate(zip(transitions, inputs)):
        mean, covariance = f @ mean + c, f @ covariance @ f.T + noise
        means.append(mean)
        joint[:t, t] = joint[:t, t - 1] @ f.T if t else 0.0
        joint[t, :t] = np.swapaxes(joint[:t, t], 1, 2)
        joint[t, t] = covariance
    return np.array(means), joint


def stds(joint, d_s=2):
    steps = np.arange(len(joint))
    return np.sqrt(np.diagonal(joint[steps, steps], axis1=1, axis2=2)[:, :d_s])


def noise_of(model, std=0.1):
    return np.diag((std * model.target_scale_) ** 2)


def logged(model, episode):
    steps = episode.length
    return [A] * steps, [B @ a for a in episode.actions], noise_of(model), episode.states[0]


def by_policy(model, episode):
    steps = episode.length
    loop = A - B @ episode.params[None, :]
    return [loop] * steps, [np.zeros(2)] * steps, noise_of(model), episode.states[0]


def with_theta(seed, n=10, steps=20):
    """s' = A s + B theta: linear in state and theta."""
    rng = np.random.default_rng(seed)
    states, params = rng.normal(size=(n, steps + 1, 2)), rng.normal(size=(n, 1))
    for t in range(steps):
        states[:, t + 1] = states[:, t] @ A.T + params @ B.T
    return TrajectoryDataset.from_arrays(states, params=params)


def by_theta(model, episode):
    steps = episode.length
    return [A] * steps, [B @ episode.params] * steps, noise_of(model), episode.states[0]


CASES = {
    "logged": ({}, lambda s: linear(6, seed=s, shortest=20, longest=20), {}, logged),
    "policy": (
        {"policy": gain_policy},
        lambda s: linear(6, seed=s, shortest=20, longest=20),
        {},
        by_policy,
    ),
    "params": ({"inputs": "params"}, with_theta, {}, by_theta),
    "params, state": ({"inputs": "params", "target": "state"}, with_theta, {}, by_theta),
}


def solved(case, propagation, **settings):
    """Forecast of two episodes, and their closed forms."""
    constructor, data, call, form = CASES[case]
    model = OneStepRegressor(Linear(), propagation=propagation, **constructor, **settings)
    model.fit(data(0))
    test = data(1)[:2]
    return model, test, call, [closed_form(*form(model, episode)) for episode in test]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_gaussians_of_a_linear_system_are_the_closed_form(case, propagation):
    model, test, call, forms = solved(case, propagation)
    forecast = model.predict(test, return_std=True, **call)
    for i, (means, joint) in enumerate(forms):
        np.testing.assert_allclose(forecast.mean[i], means, atol=1e-9)
        np.testing.assert_allclose(forecast.std[i], stds(joint), rtol=1e-9)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("propagation", PARTICLES)
def test_particles_of_a_linear_system_are_the_closed_form(case, propagation):
    model, test, call, forms = solved(case, propagation, n_particles=3000)
    forecast = model.predict(test, return_std=True, random_state=0, **call)
    for i, (means, joint) in enumerate(forms):
        np.testing.assert_allclose(forecast.mean[i], means, atol=1e-9)
        np.testing.assert_allclose(forecast.std[i], stds(joint), rtol=0.06)


@pytest.mark.parametrize("case", ["logged", "policy"])
@pytest.mark.parametrize("propagation", [*GAUSSIANS, "tsinf", "expectation"])
def test_samples_are_joint_over_states_and_time(case, propagation):
    model, test, call, forms = solved(case, propagation)
    samples = model.predict(test, n_samples=3000, random_state=0, **call).samples
    for i, (means, joint) in enumerate(forms):
        paths = samples[:, i] - means
        found = np.einsum("sti,suj->tuij", paths, paths) / len(paths)
        scale = stds(joint)
        size = scale[:, None, :, None] * scale[None, :, None, :]
        np.testing.assert_allclose(found / size, joint / size, atol=0.12)
        # the spread of a sum over time, such as a reward, lives on the covariances in between
        np.testing.assert_allclose(paths.sum(axis=(1, 2)).std(), np.sqrt(joint.sum()), rtol=0.06)


def test_the_action_before_is_carried_with_the_state():
    # s' = A s + B a + D a_before with a = -theta s is linear in (s, a_before)
    after = np.array([[0.3], [-0.2]])
    rng = np.random.default_rng(0)
    actions, states = rng.normal(size=(6, 20, 1)), rng.normal(size=(6, 21, 2))
    params = rng.uniform(0, 0.4, size=(6, 2))
    for t in range(20):
        before = actions[:, max(t - 1, 0)]
        states[:, t + 1] = states[:, t] @ A.T + actions[:, t] @ B.T + before @ after.T
    ds = TrajectoryDataset.from_arrays(states, actions=actions, params=params)
    model = OneStepRegressor(Linear(), inputs=("action", "previous")).fit(ds)
    noise = np.zeros((3, 3))
    noise[:2, :2] = noise_of(model)
    for start in (0, 4):
        steps, gain = 20 - start, -params[:1]
        loop = np.block([[A + B @ gain, after], [gain, np.zeros((1, 1))]])
        # the first action of an episode has none before but itself
        before = actions[0, start - 1] if start else gain @ states[0, 0]
        initial = np.concatenate([states[0, start], before])
        means, joint = closed_form([loop] * steps, [np.zeros(3)] * steps, noise, initial)
        fed = closed_form(
            [A] * steps,
            [
                B @ actions[0, start + t] + after @ actions[0, max(start + t - 1, 0)]
                for t in range(steps)
            ],
            noise_of(model),
            states[0, start],
        )
        for propagation in GAUSSIANS:
            model.set_params(propagation=propagation)
            settings = {"start": start, "return_std": True}
            closed = model.predict(ds[:1], policy=gain_policy, **settings)
            np.testing.assert_allclose(closed.mean[0], means[:, :2], atol=1e-9)
            np.testing.assert_allclose(closed.std[0], stds(joint), rtol=1e-8)
            replayed = model.predict(ds[:1], **settings)
            np.testing.assert_allclose(replayed.mean[0], fed[0], atol=1e-9)
            np.testing.assert_allclose(replayed.std[0], stds(fed[1]), rtol=1e-8)
            drawn = model.predict(
                ds[:1], policy=gain_policy, start=start, n_samples=3000, random_state=0
            )
            np.testing.assert_allclose(drawn.samples[:, 0].std(axis=0), stds(joint), rtol=0.06)


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_irregular_steps_have_slopes_of_their_own(propagation):
    # s' = s + dt (a - s)
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.05, 0.2, size=(8, 11)), axis=1)
    actions, states = rng.normal(size=(8, 10, 1)), rng.normal(size=(8, 11, 1))
    dt = np.diff(times, axis=1)
    for t in range(10):
        states[:, t + 1] = states[:, t] + dt[:, t, None] * (actions[:, t] - states[:, t])
    ds = TrajectoryDataset.from_arrays(states, actions=actions, times=times)
    model = OneStepRegressor(
        Linear(degree=2), inputs=("action", "dt"), propagation=propagation
    ).fit(ds)
    forecast = model.predict(ds, return_std=True)
    for i in range(2):
        loops = [np.array([[1 - step]]) for step in dt[i]]
        inputs = dt[i][:, None] * actions[i]
        means, joint = closed_form(loops, inputs, noise_of(model), states[i, 0])
        # time steps are rounded to a millionth
        np.testing.assert_allclose(forecast.mean[i], means, atol=1e-5)
        np.testing.assert_allclose(forecast.std[i], stds(joint, 1), rtol=1e-5)


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_deviations_from_references_spread_like_states(propagation):
    # the error e = s - r decays to half: s' = 0.5 s + a with a = r' - 0.5 r
    rng = np.random.default_rng(0)
    references = rng.normal(size=(6, 13, 1))
    states = references + 0.5 ** np.arange(13)[:, None] * rng.normal(size=(6, 1, 1))
    task = np.array(["slow", "fast"] * 3)
    ds = TrajectoryDataset.from_arrays(
        states, references=references, context={"task": task}, params=np.zeros((6, 1))
    )
    model = OneStepRegressor(
        Linear(), inputs="params", baseline=lambda r: r, propagation=propagation
    ).fit(ds)
    assert {"references", "context"} <= set(model.layout_)
    forecast = model.predict(ds, return_std=True, n_samples=2000, random_state=0)
    np.testing.assert_allclose(forecast.mean, truth(ds), atol=1e-9)
    size = np.sqrt(noise_of(model)[0, 0] * np.cumsum(0.25 ** np.arange(12)))
    np.testing.assert_allclose(forecast.std[:, :, 0], np.tile(size, (6, 1)), rtol=1e-6)
    spread = forecast.samples - forecast.mean
    np.testing.assert_allclose(spread.std(axis=0), forecast.std, rtol=0.07)


def with_a_baseline_and_actions():
    """Logged references and actions of a policy that follows them."""
    rng = np.random.default_rng(0)
    references = rng.normal(size=(6, 13, 1))
    states, actions = rng.normal(size=(6, 13, 1)), rng.normal(size=(6, 12, 1))
    for t in range(12):
        states[:, t + 1] = 0.9 * states[:, t] + 0.5 * actions[:, t]
    return TrajectoryDataset.from_arrays(
        states, references=references, actions=actions, params=np.zeros((6, 1))
    )


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_a_policy_gets_the_states_themselves_not_deviations(propagation):
    ds = with_a_baseline_and_actions()
    model = OneStepRegressor(
        Linear(),
        inputs=("action", "references"),
        baseline=lambda r: r,
        policy=lambda s, p, t: -s,
        propagation=propagation,
    ).fit(ds)
    forecast = model.predict(ds, actions="policy", return_std=True)
    expected = ds.states[::13, None] * 0.4 ** np.arange(1, 13)[:, None]
    np.testing.assert_allclose(forecast.mean, expected, atol=1e-9)
    size = np.sqrt(noise_of(model)[0, 0] * np.cumsum(0.16 ** np.arange(12)))
    np.testing.assert_allclose(forecast.std[0, :, 0], size, rtol=1e-7)


# -- members ----------------------------------------------------------------------------------


def drifting(drift=0.05, std=0.02, members=2):
    """Members that agree on s' = 0.9 s + 0.5 a but for a drift of +/- `drift`, exactly."""
    rng = np.random.default_rng(0)
    actions, states = rng.normal(size=(4, 15, 1)), rng.normal(size=(4, 16, 1))
    for t in range(15):
        states[:, t + 1] = 0.9 * states[:, t] + 0.5 * actions[:, t]
    ds = TrajectoryDataset.from_arrays(states, actions=actions)
    learner = MLPEnsembleRegressor(hidden_layer_sizes=(4,), n_members=members, max_steps=1)
    scaler = Unscaled()
    model = OneStepRegressor(learner, scaler=scaler, target="state", random_state=0).fit(ds)
    fitted = model.estimator_
    # relu(x) - relu(-x) = x: a linear network
    fitted.activation = "relu"
    first = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    last = np.array([[0.9], [-0.9], [0.5], [-0.5]])
    fitted.coefs_ = [np.repeat(w[None], members, axis=0).astype(np.float32) for w in (first, last)]
    fitted.intercepts_ = [
        np.zeros((members, 1, 4), dtype=np.float32),
        np.linspace(-drift, drift, members, dtype=np.float32).reshape(members, 1, 1),
    ]
    fitted.target_mean_, fitted.target_scale_ = np.zeros(1), np.ones(1)
    fitted.residual_std_ = np.full((members, 1), std)
    model.target_scale_ = np.ones(1)
    return model, ds


class Unscaled:
    """A scaler that does nothing."""

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return X

    def get_params(self, deep=True):
        return {}


@pytest.mark.parametrize("propagation", [*PARTICLES, *GAUSSIANS])
def test_what_members_disagree_about_lasts_or_is_noise(propagation):
    drift, std = 0.05, 0.02
    model, ds = drifting(drift, std)
    model.set_params(propagation=propagation, n_particles=3000)
    forecast = model.predict(ds, return_std=True, n_samples=3000, random_state=0)
    powers = 0.9 ** np.arange(15)
    within, between = std**2 * np.cumsum(powers**2), (drift * np.cumsum(powers)) ** 2
    if propagation in ("ts1", "expectation"):
        between = drift**2 * np.cumsum(powers**2)
    expected = np.sqrt(within + between)
    rtol = 1e-4 if propagation in GAUSSIANS else 0.06
    np.testing.assert_allclose(forecast.mean, truth(ds), atol=1e-5)
    np.testing.assert_allclose(forecast.std[:, :, 0], np.tile(expected, (4, 1)), rtol=rtol)
    spread = (forecast.samples - forecast.mean).std(axis=0)[:, :, 0]
    np.testing.assert_allclose(spread, np.tile(expected, (4, 1)), rtol=0.07)


def test_the_number_of_members_is_that_of_the_fit():
    model, ds = drifting(members=3)
    expected = model.predict(ds, return_std=True, random_state=0).std
    model.estimator_.n_members = 7
    np.testing.assert_array_equal(model.predict(ds, return_std=True, random_state=0).std, expected)


# -- one fitted model -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def network():
    settings = SMALL | {"estimator__n_members": 3, "estimator__probabilistic": True}
    return OneStepRegressor(random_state=0, policy=gain_policy).set_params(**settings).fit(linear())


def test_the_propagation_of_a_fitted_model_can_be_changed(network):
    ds, found = linear(4, seed=1), {}
    for propagation in (*PARTICLES, *GAUSSIANS):
        network.set_params(propagation=propagation)
        found[propagation] = network.predict(ds, return_std=True, random_state=0)
        fresh = OneStepRegressor(**network.get_params(deep=False)).fit(linear())
        again = fresh.predict(ds, return_std=True, random_state=0)
        np.testing.assert_array_equal(again.std, found[propagation].std)
    first = [forecast.std[0, 5, 0] for forecast in found.values()]
    assert len(set(first)) == 5
    # one step says the same to all
    one = np.array([forecast.std[:, 0] for forecast in found.values()])
    np.testing.assert_allclose(one[3], one[4], rtol=1e-6)
    np.testing.assert_allclose(one, np.broadcast_to(one[3], one.shape), rtol=0.35)
    means = [np.asarray(found[propagation]) for propagation in PARTICLES]
    np.testing.assert_array_equal(means[0], means[1])
    np.testing.assert_array_equal(means[0], means[2])
    np.testing.assert_allclose(found["moment"].mean[:, 0], means[0][:, 0], atol=1e-9)


@pytest.mark.parametrize("propagation", [*PARTICLES, *GAUSSIANS])
@pytest.mark.parametrize("source", ["logged", "policy"])
def test_means_and_known_stds_have_the_same_bits_alone_and_whatever_is_asked(
    network, propagation, source
):
    network.set_params(propagation=propagation)
    ds = linear(5, seed=1)
    settings = {"return_std": True, "n_samples": 3, "actions": source}
    whole = network.predict(ds, random_state=0, **settings)
    mean = network.predict(ds, actions=source)
    np.testing.assert_array_equal(mean, whole.mean)
    other = network.predict(ds, random_state=1, **settings)
    assert not np.array_equal(other.samples, whole.samples, equal_nan=True)
    again = network.predict(ds, random_state=0, **settings)
    np.testing.assert_array_equal(again.samples, whole.samples)
    np.testing.assert_array_equal(again.std, whole.std)
    for i in range(5):
        alone = network.predict(ds[[i]], random_state=0, **settings)
        steps = ds.lengths[i]
        np.testing.assert_array_equal(alone.mean[0], whole.mean[i, :steps])
        if propagation in GAUSSIANS:
            np.testing.assert_array_equal(alone.std[0], whole.std[i, :steps])
    if propagation in GAUSSIANS:
        np.testing.assert_array_equal(other.std, whole.std)


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_gaussians_are_near_the_particles_of_a_nonlinear_model(network, propagation):
    ds = linear(4, seed=1)
    network.set_params(propagation="tsinf", n_particles=3000)
    particles = network.predict(ds, return_std=True, n_samples=3000, random_state=0)
    network.set_params(propagation=propagation)
    found = network.predict(ds, return_std=True, n_samples=3000, random_state=0)
    known = np.isfinite(found.std)
    ratio = found.std[known] / particles.std[known]
    assert ratio.min() > 0.9
    assert ratio.max() < 1.1
    centre = particles.samples.mean(axis=0)
    assert np.nanmax(np.abs(found.mean - centre) / particles.std) < 0.15
    drawn = found.samples.std(axis=0)[known] / found.std[known]
    assert drawn.min() > 0.92
    assert drawn.max() < 1.08


# -- edges ------------------------------------------------------------------------------------


@pytest.mark.parametrize("propagation", GAUSSIANS)
@pytest.mark.parametrize("std", [0.0, 0.1])
def test_a_state_that_is_known_has_no_spread(propagation, std):
    class Half(Linear):
        """Noise in the first state only."""

        def predict(self, X, return_std=False):
            mean = super().predict(X)
            return (mean, np.full(mean.shape, [self.std, 0.0])) if return_std else mean

    # the second state never hears of the first: its variance is zero for good
    loop = np.array([[0.9, 0.5], [0.0, 0.8]])
    states = np.random.default_rng(0).normal(size=(5, 11, 2))
    for t in range(10):
        states[:, t + 1] = states[:, t] @ loop.T
    ds = TrajectoryDataset.from_arrays(states, params=np.zeros((5, 1)))
    model = OneStepRegressor(Half(std=std), inputs="params", propagation=propagation).fit(ds)
    forecast = model.predict(ds, return_std=True, n_samples=500, random_state=0)
    np.testing.assert_allclose(forecast.mean, truth(ds), atol=1e-9)
    size = std * model.target_scale_[0] * np.sqrt(np.cumsum(0.81 ** np.arange(10)))
    np.testing.assert_allclose(forecast.std[0, :, 0], size, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forecast.std[:, :, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(forecast.samples.std(axis=0), forecast.std, rtol=0.12, atol=1e-9)


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_a_mean_that_diverges_is_infinite_and_leaves_the_others_alone(propagation):
    ds = linear(4)
    far = TrajectoryDataset.from_arrays(
        [e.states * (1e9 if i == 1 else 1) for i, e in enumerate(ds)],
        actions=[e.actions for e in ds],
    )
    model = OneStepRegressor(Affine(-0.1, std=0.1), propagation=propagation).fit(ds)
    model.set_params(propagation=propagation)
    settings = {"return_std": True, "n_samples": 10, "random_state": 0}
    with pytest.warns(DivergenceWarning):
        forecast = model.predict(far, **settings)
    assert forecast.diverged_at.tolist() == [0, 1, 0, 0]
    for values in (forecast.mean[1], forecast.std[1], forecast.samples[:, 1]):
        assert np.isposinf(values[..., : ds.lengths[1], :]).all()
    for i in (0, 2, 3):
        alone, steps = model.predict(ds[[i]], **settings), ds.lengths[i]
        np.testing.assert_allclose(forecast.mean[i, :steps], alone.mean[0], atol=1e-12)
        np.testing.assert_allclose(forecast.std[i, :steps], alone.std[0], rtol=1e-9)
        assert np.isfinite(forecast.samples[:, i, :steps]).all()


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_a_covariance_that_diverges_leaves_the_mean(propagation):
    # s' = 100 s: from zero the mean stays there
    ds = TrajectoryDataset.from_arrays(
        100.0 ** np.arange(3)[:, None] * np.array([[[1.0]], [[-1.0]], [[0.5]]]),
        params=np.zeros((3, 1)),
    )
    model = OneStepRegressor(Linear(), inputs="params", propagation=propagation).fit(ds)
    zero = TrajectoryDataset.from_arrays(np.zeros((2, 13, 1)), params=np.zeros((2, 1)))
    forecast = model.predict(zero, return_std=True, n_samples=20, random_state=0)
    assert (forecast.diverged_at == 0).all()
    np.testing.assert_allclose(forecast.mean[:, :2], 0.0, atol=1e-6)
    assert np.isfinite(forecast.mean).all()
    gone = np.isposinf(forecast.std[0, :, 0])
    assert not gone[:2].any()
    assert gone[-3:].all()
    np.testing.assert_array_equal(gone, np.maximum.accumulate(gone))
    assert np.isposinf(forecast.samples[:, 0, gone]).all()
    assert not np.isnan(forecast.samples).any()


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_clipped_means_and_paths_stay_in_the_range(propagation):
    ds = linear(shortest=12)
    model = OneStepRegressor(Affine(0.0, 1.0, std=1.0), clip_states=1.5, propagation=propagation)
    model.fit(ds)
    low, high = model.state_range_
    centre, half = (low + high) / 2, 0.75 * (high - low)
    forecast = model.predict(ds, horizon=12, return_std=True, n_samples=50, random_state=0)
    for values in (forecast.mean, forecast.samples):
        assert (np.abs(values - centre) <= half + 1e-12).all()
    # all points of a Gaussian that is far out lie on the bound, some of one that is near it do
    reached = (forecast.mean.max(axis=(0, 1)) - centre) / half
    assert (reached > (1 - 1e-9 if propagation == "moment" else 0.9)).all()
    assert np.isclose(forecast.samples.max(axis=(0, 1, 2)), centre + half).all()
    # at the bound the past is forgotten, and the noise of one step is left
    noise = model.target_scale_
    assert (forecast.std >= noise * (1 - 1e-9)).all()
    assert (forecast.std[:, 11].min(axis=0) < 1.6 * noise).all()
    if propagation == "moment":
        assert np.isclose(forecast.std[:, 11].min(axis=0), noise).all()


def test_slopes_are_taken_only_where_somebody_asks_for_the_spread():
    class Counting(Linear):
        rows = 0

        def predict(self, X, return_std=False):
            type(self).rows += len(X)
            return super().predict(X, return_std)

    ds = linear(4, shortest=6, longest=6)
    model = OneStepRegressor(Counting(), propagation="moment").fit(ds)
    for settings, points in (({}, 1), ({"return_std": True}, 5), ({"n_samples": 2}, 5)):
        Counting.rows = 0
        model.predict(ds, **settings)
        assert Counting.rows == 4 * 6 * points


@pytest.mark.parametrize("propagation", [*PARTICLES, *GAUSSIANS])
def test_a_learner_without_a_std_gives_the_mean_alone(propagation):
    ds, test = linear(), linear(4, seed=1)
    model = OneStepRegressor(LinearRegression(), propagation=propagation).fit(ds)
    np.testing.assert_allclose(model.predict(test), truth(test), atol=1e-9)
    for settings in ({"return_std": True}, {"n_samples": 3}):
        with pytest.raises(ValueError, match="LinearRegression gives no standard deviation"):
            model.predict(test, **settings)


def test_an_unknown_propagation_is_refused():
    with pytest.raises(InvalidParameterError, match="propagation"):
        OneStepRegressor(Linear(), propagation="ts2").fit(linear())
    model = OneStepRegressor(Linear()).fit(linear())
    with pytest.raises(ValueError, match=r"choose one of.*'unscented'"):
        model.set_params(propagation="ts2").predict(linear())


@pytest.mark.parametrize("propagation", GAUSSIANS)
def test_closed_loop_of_second_degree(propagation):
    ds, test = closed_loop(), closed_loop(4, seed=1, switch=5)
    model = OneStepRegressor(Linear(degree=2), inputs="params", propagation=propagation).fit(ds)
    forecast = model.predict(test, return_std=True)
    for i, episode in enumerate(test):
        loops = [np.array([[0.9 - 0.2 * theta]]) for theta in episode.params[:, 0]]
        means, joint = closed_form(loops, 0.3 * episode.params, noise_of(model), episode.states[0])
        np.testing.assert_allclose(forecast.mean[i], means, atol=1e-8)
        np.testing.assert_allclose(forecast.std[i], stds(joint, 1), rtol=1e-8)
