"""Recurrent models: a memory that is trained on sequences, warmed up, and rolled out."""

import numpy as np
import pytest
import torch
from torch import nn

from tests.dynamics.systems import closed_loop, gain_policy, linear, truth
from tests.sklearn_checks import run_checks
from trajlearn import (
    BlockScaler,
    LinearFeedback,
    LSTMRegressor,
    OneStepRegressor,
    TrajectoryDataset,
    TransitionRelabeler,
    load,
)
from trajlearn.dynamics._recurrent import BLOCK, SequenceNetwork, Sequences, Stepper
from trajlearn.dynamics._sequence import SequenceLearner
from trajlearn.exceptions import DivergenceWarning, MissingFieldError, MixedSamplingError
from trajlearn.testing import check_dynamics_estimator


def small(**settings):
    return LSTMRegressor(**{"hidden_size": 8, "max_steps": 30, "random_state": 0} | settings)


def masses(n, *, seed, shortest=20, longest=30):
    """A damped mass pushed at random, of which only the position is logged."""
    rng = np.random.default_rng(seed)
    states, actions = [], []
    for steps in rng.integers(shortest, longest + 1, size=n):
        x, v, path = rng.normal(), rng.normal(), []
        pushes = rng.normal(size=(steps, 1))
        for push in [*pushes[:, 0], 0.0]:
            path.append([x])
            x, v = x + 0.2 * v, 0.95 * v - 0.2 * x + 0.2 * push
        states.append(path)
        actions.append(pushes)
    return TrajectoryDataset.from_arrays(states, actions=actions)


@pytest.fixture(scope="module")
def hidden_velocity():
    ds = masses(80, seed=0)
    return LSTMRegressor(hidden_size=32, max_steps=400, random_state=0).fit(ds), ds


def rms(model, ds, start):
    forecast = model.predict(ds, start=start, horizon=10)
    return float(np.sqrt(np.nanmean(forecast.squared_errors(ds))))


# -- the contract -------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
def test_sklearn_checks_pass():
    skips = {"check_array_api_input": "needs SCIPY_ARRAY_API=1 before scipy is imported"}
    results = run_checks(LSTMRegressor(), allowed_skips=skips)
    assert sum(result["status"] == "passed" for result in results) >= 50


@pytest.mark.parametrize("settings", [{}, {"probabilistic": True, "n_layers": 2}])
def test_the_contract_of_dynamics_estimators(settings):
    ran = check_dynamics_estimator(small(**settings), policy=LinearFeedback(bounds=None))
    assert len(ran) >= 30


# -- memory -------------------------------------------------------------------------------


def test_memory_finds_the_velocity_that_no_single_state_shows(hidden_velocity):
    model, ds = hidden_velocity
    test = masses(30, seed=1)
    memoryless = OneStepRegressor(random_state=0).set_params(estimator__max_steps=400).fit(ds)
    assert rms(model, test, 8) < 0.3 * rms(memoryless, test, 8)


def test_warm_up_matters(hidden_velocity):
    model, _ = hidden_velocity
    test = masses(30, seed=1)
    assert rms(model, test, 8) < 0.5 * rms(model, test, 0)
    # the same start with another past is another forecast
    fresh = TrajectoryDataset.from_arrays(
        [e.states[8:] for e in test], actions=[e.actions[8:] for e in test]
    )
    cold, warm = model.predict(fresh), model.predict(test, start=8)
    assert rms(model, test, 8) < 0.5 * rms(model, fresh, 0)
    np.testing.assert_array_equal(cold.initial_states, warm.initial_states)


def test_ragged_starts_are_each_warmed_up_to_their_own(hidden_velocity):
    model, _ = hidden_velocity
    test = masses(BLOCK + 9, seed=2)
    start = np.arange(len(test)) % 7
    ragged = model.predict(test, start=start)
    for k in range(7):
        alone = model.predict(test[start == k], start=k).mean
        np.testing.assert_array_equal(ragged.mean[start == k, : alone.shape[1]], alone)


@pytest.mark.parametrize("target", ["change", "state"])
@pytest.mark.parametrize("n_layers", [1, 2])
def test_a_roll_out_is_nn_lstm_stepped_by_hand(target, n_layers):
    model = small(target=target, n_layers=n_layers, hidden_size=5).fit(linear())
    learner = model.estimator_
    lstm = nn.LSTM(3, 5, n_layers, batch_first=True).double()
    head = nn.Linear(5, 2).double()
    nn.ModuleDict({"lstm": lstm, "head": head}).load_state_dict(
        {name: torch.tensor(weight) for name, weight in learner.weights_.items()}
    )
    episode, start = linear(3, seed=1)[1], 3
    memory, state, found = None, episode.states[0], []
    for t in range(episode.length):
        row = np.concatenate([state, episode.actions[t]])[None]
        with torch.no_grad():
            out, memory = lstm(torch.tensor(model.scaler_.transform(row))[None], memory)
            out = head(out)[0, 0].numpy()
        after = (out * learner.target_scale_ + learner.target_mean_) * model.target_scale_
        after = after + state if target == "change" else after
        state = after if t >= start else episode.states[t + 1]
        if t >= start:
            found.append(after)
    np.testing.assert_allclose(model.predict([episode], start=start).mean[0], found, atol=1e-5)


@pytest.mark.parametrize(
    ("hidden_size", "n_outputs", "n_layers"), [(3, 5, 1), (7, 9, 2), (64, 8, 1)]
)
def test_a_sequence_has_the_same_bits_wherever_it_stands(hidden_size, n_outputs, n_layers):
    rng, m = np.random.default_rng(0), 2 * BLOCK + 11
    network = SequenceNetwork(4, n_outputs, hidden_size, n_layers, seed=0)
    inputs = rng.normal(size=(3, m, 4))

    def outputs(order):
        stepper = Stepper(network.weights(), len(order), torch.device("cpu"))
        return np.stack([stepper.step(x[order]) for x in inputs])

    together = outputs(np.arange(m))
    for size in (1, 2, 17, BLOCK, m):
        order = rng.permutation(m)[:size]
        np.testing.assert_array_equal(outputs(order), together[:, order])


def test_inactive_sequences_keep_their_memory():
    weights = SequenceNetwork(2, 1, 4, 1, seed=0).weights()
    x = np.random.default_rng(0).normal(size=(3, 2, 2))
    stepper, other = (Stepper(weights, 2, torch.device("cpu")) for _ in range(2))
    stepper.step(x[0])
    stepper.step(x[1], np.array([False, True]))
    other.step(x[0])
    last, skipped = stepper.step(x[2]), other.step(x[2])
    assert last[0] == skipped[0]
    assert last[1] != skipped[1]


# -- training -----------------------------------------------------------------------------


def test_padding_changes_neither_outputs_nor_gradients():
    network = SequenceNetwork(3, 2, 6, 1, seed=0).double()
    inputs, targets = torch.randn(15, 3).double(), torch.randn(15, 2).double()
    data = Sequences(inputs, targets, np.array([0, 4, 5, 15]))
    x, y, mask = data.padded(np.array([2, 0, 1]), None, np.random.default_rng(0))
    assert x.shape == (3, 10, 3)
    assert mask.sum(dim=1).tolist() == [10, 4, 1]

    def gradients(loss):
        network.zero_grad()
        loss.backward()
        return [p.grad.clone() for p in network.parameters()]

    padded = gradients(((network(x, mask) - y) ** 2).mean())
    total = torch.zeros((), dtype=torch.float64)
    for begin, end in ((5, 15), (0, 4), (4, 5)):
        out = network.head(network.lstm(inputs[None, begin:end])[0])[0]
        total = total + ((out - targets[begin:end]) ** 2).sum()
    for one, other in zip(padded, gradients(total / 30)):
        torch.testing.assert_close(one, other)


def test_a_window_is_a_stretch_of_its_own_episode():
    rows = torch.arange(30.0)[:, None]
    data = Sequences(rows, rows, np.array([0, 3, 10, 30]))
    x, y, mask = data.padded(np.array([0, 1, 2] * 200), 5, np.random.default_rng(0))
    assert mask.sum(dim=1).tolist() == [3, 5, 5] * 200
    assert (torch.diff(x[..., 0])[:, :2] == 1).all()
    torch.testing.assert_close(x[mask], y)
    first = x[:, 0, 0].reshape(200, 3)
    assert [set(column.tolist()) for column in first.T] == [
        {0.0},
        {3.0, 4.0, 5.0},
        set(np.arange(10.0, 26.0)),
    ]


def test_every_episode_is_seen_once_an_epoch():
    rows = torch.arange(12.0)[:, None]
    batches = Sequences(rows, rows, np.arange(0, 13, 2)).batches(4, None, np.random.default_rng(0))
    epoch = torch.cat([next(batches)[1] for _ in range(2)])
    assert sorted(epoch[:, 0].tolist()) == list(range(12))


def test_training_leaves_torch_as_it_was():
    torch.manual_seed(3)
    expected, threads = torch.rand(2), torch.get_num_threads()
    torch.manual_seed(3)
    small(verbose=0).fit(linear())
    torch.testing.assert_close(torch.rand(2), expected)
    assert torch.get_num_threads() == threads


def test_budgets():
    ds = linear(9)
    steps = {
        name: small(**settings).fit(ds).estimator_.n_steps_
        for name, settings in {
            "steps": {"max_steps": 7},
            "epochs": {"max_epochs": 3, "batch_size": 4},
            "rule": {"max_steps": None},
        }.items()
    }
    n = ds.lengths.sum()
    assert steps == {"steps": 7, "epochs": 9, "rule": int(12 * n**0.55)}


def test_training_that_diverges_says_so():
    X = np.random.default_rng(0).normal(size=(50, 2))
    learner = SequenceLearner(learning_rate=1e4, schedule="constant", max_steps=50)
    with pytest.raises(ValueError, match=r"training diverged.*learning_rate"):
        learner.fit(X, X)


def test_a_relabeler_that_leaves_steps_out_is_refused():
    with pytest.raises(ValueError, match="every step"):
        small().set_params(relabeler__max_rows=10).fit(linear())


# -- uncertainty --------------------------------------------------------------------------


def noisy_walks(n, steps, seed):
    """s' = s + noise, the noise three times as large where the action is 1."""
    rng = np.random.default_rng(seed)
    actions = rng.integers(2, size=(n, steps, 1)).astype(float)
    changes = (0.1 + 0.2 * actions) * rng.normal(size=(n, steps, 1))
    return TrajectoryDataset.from_arrays(
        np.concatenate([np.zeros((n, 1, 1)), np.cumsum(changes, axis=1)], axis=1), actions=actions
    )


def test_a_gaussian_head_learns_where_the_noise_is():
    train, test = noisy_walks(100, 20, 0), noisy_walks(20, 20, 1)
    gaussian = small(probabilistic=True, max_steps=200).fit(train)
    std = gaussian.predict(test, return_std=True, horizon=1, random_state=0).std[:, 0, 0]
    quiet = np.array([e.actions[0, 0] for e in test]) == 0
    assert 0.07 < np.median(std[quiet]) < 0.14
    assert 0.21 < np.median(std[~quiet]) < 0.42
    plain = small(max_steps=200).fit(train)
    residual = plain.estimator_.residual_std_ * plain.target_scale_
    assert 0.19 < residual[0] < 0.25  # sqrt((0.1 ** 2 + 0.3 ** 2) / 2) = 0.224


def test_particles_carry_their_noise_along():
    train = noisy_walks(100, 20, 0)
    # cold states that the walk has not seen pull it back, so look at a few steps only
    model = small(max_steps=200, n_particles=1000).fit(train)
    forecast = model.predict(train[:2], horizon=4, return_std=True, random_state=0)
    sigma = model.estimator_.residual_std_[0] * model.target_scale_[0]
    np.testing.assert_allclose(forecast.std[0, :, 0], sigma * np.sqrt(np.arange(1, 5)), rtol=0.15)
    paths = model.predict(train[:3], n_samples=200, random_state=0).samples
    assert paths.shape == (200, 3, 20, 1)
    steps = np.diff(paths, axis=2)
    assert abs(np.corrcoef(steps[:, 0, 0, 0], steps[:, 0, 1, 0])[0, 1]) < 0.25


def test_each_particle_has_its_own_memory():
    model = small().fit(linear())
    rng = np.random.default_rng(0)
    warm = model.estimator_.stepper(3)
    warm.step(rng.normal(size=(3, 3)))
    copies = warm.repeated(2)
    x = rng.normal(size=(3, 3))
    first = copies.step(np.concatenate([x, -x]))
    again = copies.step(np.concatenate([x, x]))
    np.testing.assert_array_equal(first[:3], warm.step(x))
    np.testing.assert_array_equal(again[:3], warm.step(x))
    assert (again[3:] != again[:3]).all()


# -- inputs -------------------------------------------------------------------------------


def test_theta_that_changes_on_the_way_is_followed():
    ds, test = closed_loop(60, switch=3), closed_loop(4, seed=1, switch=5)
    model = LSTMRegressor(inputs="params", hidden_size=32, max_steps=400, random_state=0).fit(ds)
    forecast = model.predict(test, start=2)
    assert forecast.actions == "none"
    error = np.abs(forecast.mean - truth(test)[:, 2:]).mean()
    change = np.abs(np.diff(truth(test), axis=1)).mean()
    assert error < 0.3 * change


def test_time_steps_context_and_references_are_inputs():
    base = linear(6, shortest=8, longest=8)
    ds = TrajectoryDataset.from_arrays(
        [e.states for e in base],
        actions=[e.actions for e in base],
        references=[e.states for e in base],
        context={"task": ["a", "b"] * 3},
        times=[np.cumsum(np.random.default_rng(i).uniform(0.5, 1, 9)) for i in range(6)],
    )
    with pytest.raises(MixedSamplingError):
        small().fit(ds)
    model = small(inputs=("action", "dt", "context", "references")).fit(ds)
    assert list(model.layout_) == ["state", "action", "dt", "context", "references"]
    assert np.isfinite(model.predict(ds, start=2).mean).all()


def test_a_history_needs_its_actions():
    ds = linear(4)
    bare = TrajectoryDataset.from_arrays([e.states for e in ds], params=ds.params)
    model = small(policy=gain_policy).fit(ds)
    assert model.predict(bare).actions == "policy"
    with pytest.raises(MissingFieldError, match="actions"):
        model.predict(bare, start=1)
    wide = TrajectoryDataset.from_arrays(
        [e.states for e in ds], actions=[np.hstack([e.actions] * 2) for e in ds], params=ds.params
    )
    with pytest.raises(ValueError, match="2 actions, the model was fitted on 1"):
        model.predict(wide, start=1)


def test_a_row_is_a_sequence_of_length_one():
    ds = linear()
    model = small().fit(ds)
    rows, _ = model.relabeler_.fit_resample(ds)
    first = ds.offsets[:-1] - np.arange(len(ds))
    # the first step of an episode has no memory either
    np.testing.assert_array_equal(model.predict(rows[first]), model.predict(ds).mean[:, 0])
    mean, std = model.predict(rows[first], return_std=True)
    np.testing.assert_array_equal(mean, model.predict(rows[first]))
    residual = model.estimator_.residual_std_ * model.target_scale_
    np.testing.assert_allclose(std, np.tile(residual, (len(first), 1)))


@pytest.mark.parametrize("settings", [{}, {"probabilistic": True, "n_layers": 2}])
def test_a_saved_model_comes_back_with_the_same_bits(settings, tmp_path):
    ds = linear()
    model = small(policy=LinearFeedback(bounds=None), **settings).fit(ds)
    model.save(tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors")
    first, second = (m.predict(ds, start=1, n_samples=3, random_state=1) for m in (model, again))
    np.testing.assert_array_equal(first.mean, second.mean)
    np.testing.assert_array_equal(first.samples, second.samples)
    assert np.isfinite(again.fit(ds).score(ds))


def test_there_is_no_other_learner_and_no_weights():
    with pytest.raises(ValueError, match="Invalid parameter 'estimator'"):
        LSTMRegressor().set_params(estimator__max_steps=3)
    assert not any(name.startswith("estimator") for name in LSTMRegressor().get_params())
    with pytest.raises(TypeError, match="sample_weight"):
        LSTMRegressor().fit(linear(), sample_weight=np.ones(8))


# -- every parameter ----------------------------------------------------------------------


def outcome(**settings):
    model = small(probabilistic=settings.pop("probabilistic", False), **settings)
    forecast = model.fit(linear(10)).predict(
        linear(5, seed=1), start=1, return_std=True, random_state=0
    )
    return np.stack([forecast.mean, forecast.std])


@pytest.fixture(scope="module")
def usual():
    return outcome()


@pytest.mark.parametrize(
    "change",
    [
        {"hidden_size": 9},
        {"n_layers": 2},
        {"probabilistic": True},
        {"learning_rate": 1e-3},
        {"schedule": "constant"},
        {"batch_size": 3},
        {"max_steps": 31},
        {"max_epochs": 5},
        {"weight_decay": 0.5},
        {"window": 3},
        {"relabeler": TransitionRelabeler(inputs=("action", "params"))},
        {"scaler": BlockScaler(state="passthrough")},
        {"inputs": "params"},
        {"target": "state"},
        {"policy": gain_policy},
        {"clip_states": 0.2},
        {"n_particles": 20},
        {"random_state": 1},
    ],
    ids=lambda change: "+".join(change),
)
def test_every_parameter_changes_the_forecast(change, usual):
    assert not np.array_equal(outcome(**change), usual, equal_nan=True)


def test_rollout_actions_can_overrule_a_policy(usual):
    both = outcome(policy=gain_policy, rollout_actions="logged")
    np.testing.assert_array_equal(both, usual)


def test_error_score_is_what_a_diverged_episode_counts():
    ds = linear(4)
    far = TrajectoryDataset.from_arrays(
        [e.states * (1e9 if i == 0 else 1) for i, e in enumerate(ds)],
        actions=[e.actions for e in ds],
    )
    scores = []
    for error_score in (-40.0, -400.0):
        with pytest.warns(DivergenceWarning):
            scores.append(small(error_score=error_score).fit(ds).score(far))
    assert np.isclose(scores[0] - scores[1], 90.0)


def test_device_and_verbose(capsys):
    with pytest.raises(ValueError, match="device='abacus'"):
        small(device="abacus").fit(linear())
    small().fit(linear())
    assert "training" not in capsys.readouterr().err
    small(verbose=1).fit(linear())
    assert "training" in capsys.readouterr().err
