"""Relabelers: rows and targets of the right episodes, blocks, protocol, memory."""

import itertools
import time
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_param_validation

from tests.sklearn_checks import run_checks
from trajlearn import (
    EpisodeRelabeler,
    MLPEnsembleRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TransitionRelabeler,
)
from trajlearn.exceptions import MissingFieldError, MixedSamplingError

PAIR = ("state", "horizon")
RELABELERS = [SubtrajectoryRelabeler, TransitionRelabeler, EpisodeRelabeler]


def everything(n=6, *, seed=0, vary=False, irregular=False):
    """Episodes with every field; states and actions tell episode and step."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(3, 9, size=n)
    code = [100.0 * (i + 1) + np.arange(t + 1) for i, t in enumerate(lengths)]
    times = [
        i + np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 0.9, t) if irregular else t * [0.5])])
        for i, t in enumerate(lengths)
    ]
    theta = [
        np.column_stack([np.full(t, i), (np.arange(t) >= t // 2) if vary else np.ones(t)])
        for i, t in enumerate(lengths)
    ]
    return TrajectoryDataset.from_arrays(
        [np.column_stack([c, -c]) for c in code],
        actions=[c[:-1, None] + 0.5 for c in code],
        params=theta,
        references=[10 * c[:, None] for c in code],
        rewards=[c[1:] for c in code],
        times=times,
        time_origin=np.arange(n) - 1.0,
        context={"task": ["push", "pull"] * (n // 2), "motors": [4, 6, 8] * (n // 3)},
        terminated=np.ones(n, dtype=bool),
    )


# -- blocks -------------------------------------------------------------------------------


def test_blocks_of_sub_trajectories_come_in_order():
    ds = everything()
    relabeler = SubtrajectoryRelabeler(max_rows=None)
    rows, targets = relabeler.fit_resample(ds)
    assert list(relabeler.layout_) == [
        "state", "horizon", "params", "context", "references", "phase",
    ]  # fmt: skip
    assert list(relabeler.get_feature_names_out()) == [
        "s0", "s1", "horizon", "theta0", "theta1",
        "task=pull", "task=push", "motors=4", "motors=6", "motors=8",
        "ref0", "ref0+h", "phase", "phase+h",
    ]  # fmt: skip
    assert relabeler.layout_["context"] == slice(5, 10)
    assert rows.shape == ((ds.lengths * (ds.lengths + 1) // 2).sum(), 14)
    begin, end = rows[:, 0], targets[:, 0]
    episode = (begin // 100).astype(int) - 1
    np.testing.assert_array_equal(episode, relabeler.sample_indices_)
    np.testing.assert_array_equal(episode, (end // 100) - 1)  # pairs stay in their episode
    steps = end - begin
    assert (steps >= 1).all()
    np.testing.assert_allclose(rows[:, 2], 0.5 * steps)
    np.testing.assert_array_equal(rows[:, 3], episode)
    np.testing.assert_array_equal(rows[:, 5], episode % 2 == 1)
    np.testing.assert_array_equal(rows[:, 8], episode % 3 == 1)
    np.testing.assert_array_equal(rows[:, 10], 10 * begin)
    np.testing.assert_array_equal(rows[:, 11], 10 * end)
    np.testing.assert_allclose(rows[:, 12], 1.0 + 0.5 * (begin % 100))
    assert len(np.unique(np.column_stack([begin, end]), axis=0)) == len(rows)


def test_blocks_of_transitions_come_in_order():
    ds = everything(irregular=True)
    relabeler = TransitionRelabeler(inputs=("references", "dt", "params", "action", "context"))
    rows, targets = relabeler.fit_resample(ds)
    assert list(relabeler.layout_) == [
        "state", "action", "params", "dt", "context", "references",
    ]  # fmt: skip
    assert relabeler.get_feature_names_out()[2:6].tolist() == ["a0", "theta0", "theta1", "dt"]
    assert len(rows) == ds.lengths.sum()
    now, then = rows[:, 0], targets[:, 0]
    np.testing.assert_array_equal(then, now + 1)
    np.testing.assert_array_equal(rows[:, 2], now + 0.5)  # the action that is applied at s_t
    episode = (now // 100).astype(int) - 1
    np.testing.assert_array_equal(rows[:, 3], episode)
    np.testing.assert_array_equal(relabeler.sample_indices_, episode)
    steps = [ds[i].times[int(t) + 1] - ds[i].times[int(t)] for i, t in zip(episode, now % 100)]
    np.testing.assert_allclose(rows[:, 5], steps, rtol=1e-5)
    np.testing.assert_array_equal(rows[:, 11:], np.column_stack([10 * now, 10 * then]))
    assert relabeler.dt_ is None


@pytest.mark.parametrize(
    ("inputs", "blocks"),
    [
        ("action", ["state", "action", "context"]),
        ("params", ["state", "params", "context", "references"]),
        (("action",), ["state", "action"]),
        (("state", "params"), ["state", "params"]),
        ((), ["state"]),
    ],
)
def test_inputs_choose_the_blocks_of_transitions(inputs, blocks):
    relabeler = TransitionRelabeler(inputs=inputs).fit(everything())
    assert list(relabeler.layout_) == blocks
    assert relabeler.dt_ == 0.5


@pytest.mark.parametrize(
    ("relabeler", "blocks"),
    [
        (SubtrajectoryRelabeler(inputs=("horizon", "state")), ["state", "horizon"]),
        (
            SubtrajectoryRelabeler(inputs=["phase", "state", "horizon"]),
            ["state", "horizon", "phase"],
        ),
        (EpisodeRelabeler(terminal_reward=0.0), ["state", "params", "context"]),
        (EpisodeRelabeler(inputs=("params",), terminal_reward=0.0), ["params"]),
    ],
    ids=str,
)
def test_inputs_choose_the_blocks(relabeler, blocks):
    rows, _ = relabeler.fit_resample(everything())
    assert list(relabeler.layout_) == blocks
    assert rows.shape[1] == relabeler.layout_.width == len(relabeler.get_feature_names_out())


def test_rows_of_episodes_are_their_beginnings():
    ds = everything()
    relabeler = EpisodeRelabeler(terminal_reward=-1.0)
    rows, targets = relabeler.fit_resample(ds)
    np.testing.assert_array_equal(rows[:, :2], ds.states[ds.offsets[:-1]])
    np.testing.assert_array_equal(rows[:, 2:4], ds.params)
    longest = ds.lengths.max()
    expected = [(e.rewards.sum() - (longest - e.length)) / longest for e in ds]
    np.testing.assert_allclose(targets, expected)
    np.testing.assert_array_equal(relabeler.sample_indices_, np.arange(len(ds)))


def test_absent_fields_have_no_block():
    bare = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)))
    assert list(SubtrajectoryRelabeler().fit(bare).layout_) == ["state", "horizon"]
    assert list(EpisodeRelabeler().fit(bare).layout_) == ["state"]
    partly = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)), time_origin=[0.0, np.nan])
    with pytest.warns(UserWarning, match="1 of 2 episodes have no time_origin"):
        assert "phase" not in SubtrajectoryRelabeler().fit(partly).layout_


@pytest.mark.parametrize(
    ("relabeler", "error", "message"),
    [
        (
            SubtrajectoryRelabeler(inputs=("state", "horizon", "params")),
            MissingFieldError,
            "params",
        ),
        (SubtrajectoryRelabeler(inputs=("state", "horizon", "phase")), MissingFieldError, "phase"),
        (SubtrajectoryRelabeler(inputs=("state",)), ValueError, r"missing blocks \['horizon'\]"),
        (SubtrajectoryRelabeler(inputs=(*PAIR, "action")), ValueError, "unknown"),
        (TransitionRelabeler(), MissingFieldError, "'action'"),
        (TransitionRelabeler(inputs="params"), MissingFieldError, "'params'"),
        (TransitionRelabeler(inputs=("horizon",)), ValueError, "unknown blocks"),
        (EpisodeRelabeler(inputs=("action",)), ValueError, "unknown blocks"),
        (EpisodeRelabeler(), MissingFieldError, "rewards"),
    ],
    ids=str,
)
def test_what_the_episodes_lack_is_named(relabeler, error, message):
    bare = TrajectoryDataset.from_arrays(np.zeros((2, 4, 1)))
    with pytest.raises(error, match=message):
        relabeler.fit_resample(bare)


def test_mixed_sampling_needs_the_time_step():
    with pytest.raises(MixedSamplingError, match=r'"dt".*resample.*TrajectoryRegressor'):
        TransitionRelabeler().fit(everything(irregular=True))
    two_rates = TrajectoryDataset.from_arrays(
        np.zeros((2, 3, 1)), actions=np.zeros((2, 2, 1)), times=[[0, 1, 2], [0, 0.5, 1]]
    )
    with pytest.raises(MixedSamplingError, match=r"from 0\.5 to 1"):
        TransitionRelabeler().fit(two_rates)
    jitter = TrajectoryDataset.from_arrays(
        np.zeros((1, 3, 1)), actions=np.zeros((1, 2, 1)), times=[[0, 0.02, 0.0400001]]
    )
    assert np.isclose(TransitionRelabeler().fit(jitter).dt_, 0.02)


def test_an_unseen_category_is_named():
    relabeler = SubtrajectoryRelabeler().fit(everything())
    other = TrajectoryDataset.from_arrays(
        np.zeros((1, 3, 2)), context={"task": ["lift"], "motors": [4]}
    )
    with pytest.raises(ValueError, match=r"'task' is 'lift', which fit did not see.*'pull'"):
        relabeler.context_rows(other)
    fewer = TrajectoryDataset.from_arrays(np.zeros((1, 3, 2)), context={"task": ["push"]})
    with pytest.raises(MissingFieldError, match="no context 'motors'"):
        relabeler.context_rows(fewer)
    more = TrajectoryDataset.from_arrays(
        np.zeros((1, 3, 2)), context={"motors": [6], "task": ["push"], "wind": [True]}
    )
    np.testing.assert_array_equal(relabeler.context_rows(more), [[0, 1, 0, 1, 0]])


# -- constant theta -----------------------------------------------------------------------


@given(seed=st.integers(0, 10**6), starts=st.sampled_from(["uniform", "early", "first"]))
def test_rows_come_from_one_stretch_of_constant_theta(seed, starts):
    ds = everything(seed=seed, vary=True)
    for max_rows in (None, 40):
        relabeler = SubtrajectoryRelabeler(
            max_rows=max_rows, starts=starts, horizons="mixture", random_state=seed
        )
        rows, targets = relabeler.fit_resample(ds)
        episode = relabeler.sample_indices_
        begin, end = (rows[:, 0] % 100).astype(int), (targets[:, 0] % 100).astype(int)
        np.testing.assert_array_equal(rows[:, 0] // 100, episode + 1)
        np.testing.assert_array_equal(targets[:, 0] // 100, episode + 1)
        switch = ds.lengths[episode] // 2
        # theta[t] is in force from s_t to s_{t+1}: a pair may end at the switch, not cross it
        assert ((end <= switch) | (begin >= switch)).all()
        np.testing.assert_array_equal(rows[:, 4], begin >= switch)
        np.testing.assert_array_equal(rows[:, 3], episode)


def test_transitions_take_the_theta_of_their_step():
    ds = everything(vary=True)
    rows, _ = TransitionRelabeler(inputs=("params",)).fit_resample(ds)
    np.testing.assert_array_equal(rows[:, 2:], ds.step_params)


def test_rows_at_the_last_state_have_the_theta_that_led_there():
    ds = everything(vary=True)
    relabeler = SubtrajectoryRelabeler().fit(ds)
    episode, last = np.arange(len(ds)), ds.offsets[1:] - 1
    rows = relabeler.rows(ds, episode, last, last)
    np.testing.assert_array_equal(rows[:, 3:5], [e.params[-1] for e in ds])


# -- how many, how fast -------------------------------------------------------------------


def long_episodes(n=100, steps=2000):
    rng = np.random.default_rng(0)
    return TrajectoryDataset.from_arrays(
        rng.normal(size=(n, steps + 1, 4)), params=rng.normal(size=(n, 4)), dt=0.02
    )


@pytest.mark.parametrize(("starts", "horizons"), [("uniform", "uniform"), ("early", "mixture")])
def test_rows_are_drawn_without_listing_the_pairs(starts, horizons):
    ds = long_episodes()
    relabeler = SubtrajectoryRelabeler(
        max_rows=100_000, starts=starts, horizons=horizons, random_state=0
    )
    n_pairs = relabeler.n_pairs(ds)
    assert n_pairs == 100 * 2000 * 2001 // 2
    tracemalloc.start()
    rows, targets = relabeler.fit_resample(ds)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert rows.shape == (100_000, 9)
    assert peak < 10 * (rows.nbytes + targets.nbytes)
    assert peak < 0.1 * 8 * n_pairs
    started = time.process_time()
    relabeler.fit_resample(ds)
    assert time.process_time() - started < 1.0  # 0.03 s when measured


def test_max_rows_is_a_cap_and_the_draw_has_no_repeats():
    ds = everything()
    total = SubtrajectoryRelabeler().n_pairs(ds)
    for max_rows, n_rows in ((1, 1), (30, 30), (total, total), (10**6, total), (None, total)):
        rows, targets = SubtrajectoryRelabeler(max_rows=max_rows, random_state=0).fit_resample(ds)
        assert len(rows) == n_rows
        assert len(np.unique(np.hstack([rows, targets]), axis=0)) == n_rows
    few = SubtrajectoryRelabeler(max_rows=10**6, starts="early", horizons="mixture")
    assert len(few.fit_resample(ds)[0]) == total


def test_max_rows_of_transitions():
    ds = everything()
    relabeler = TransitionRelabeler(max_rows=10, random_state=0)
    rows, targets = relabeler.fit_resample(ds)
    assert len(rows) == 10
    np.testing.assert_array_equal(targets[:, 0], rows[:, 0] + 1)
    assert len(np.unique(rows[:, 0])) == 10
    everything_again, _ = TransitionRelabeler(max_rows=10**6).fit_resample(ds)
    assert len(everything_again) == ds.lengths.sum()


def test_max_horizon_is_in_steps():
    rows, _ = SubtrajectoryRelabeler(max_rows=None, max_horizon=3).fit_resample(everything())
    assert np.unique(rows[:, 2]).tolist() == [0.5, 1.0, 1.5]


@pytest.mark.parametrize(
    "relabeler",
    [SubtrajectoryRelabeler(max_rows=20), TransitionRelabeler(max_rows=9)],
    ids=lambda r: type(r).__name__,
)
def test_the_seed_decides_the_draw(relabeler):
    ds = everything()

    def draw(seed):
        return clone(relabeler).set_params(random_state=seed).fit_resample(ds)[0]

    np.testing.assert_array_equal(draw(0), draw(0))
    assert not np.array_equal(draw(0), draw(1))
    np.testing.assert_array_equal(draw(np.random.RandomState(3)), draw(np.random.RandomState(3)))
    generator = np.random.default_rng(3)
    assert not np.array_equal(draw(generator), draw(generator))  # it goes on
    assert len(draw(None)) == relabeler.max_rows


def test_a_stream_brings_fresh_batches():
    ds = everything()
    relabeler = SubtrajectoryRelabeler(random_state=0, starts="early", horizons="mixture")
    first, second = itertools.islice(relabeler.stream(ds, 16), 2)
    rows, targets, episode = first
    assert rows.shape == (16, 14)
    np.testing.assert_array_equal(rows[:, 0] // 100 - 1, episode)
    np.testing.assert_array_equal(targets[:, 0] // 100 - 1, episode)
    assert not np.array_equal(first[0], second[0])
    again = next(relabeler.stream(ds, 16))
    np.testing.assert_array_equal(first[0], again[0])
    other = next(relabeler.stream(ds, 16, random_state=1))
    assert not np.array_equal(first[0], other[0])


def test_a_horizon_is_free_of_round_off():
    times = 1e5 + 0.1 * np.arange(200)
    ds = TrajectoryDataset.from_arrays(np.zeros((1, 200, 1)), times=[times])
    assert len(np.unique(np.diff(times))) > 1
    rows, _ = SubtrajectoryRelabeler(max_rows=None).fit_resample(ds)
    np.testing.assert_array_equal(np.unique(rows[:, 1]), np.round(0.1 * np.arange(1, 200), 7))


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e6, 1e12])
def test_times_of_any_unit(unit):
    times = unit * np.cumsum([0, 1, 2, 1.5, 3])
    ds = TrajectoryDataset.from_arrays(np.zeros((1, 5, 1)), times=[times])
    rows, _ = SubtrajectoryRelabeler(max_rows=None).fit_resample(ds)
    expected = [b - a for a, b in itertools.combinations(times, 2)]
    np.testing.assert_allclose(rows[:, 1], expected, rtol=1e-6)


def test_an_episode_is_rounded_alone_as_among_others():
    fine = TrajectoryDataset.from_arrays(np.zeros((1, 4, 1)), times=[[0, 1e-4, 2e-4, 3e-4]])
    coarse = TrajectoryDataset.from_arrays(np.zeros((1, 4, 1)), times=[np.arange(4) / 3])
    both = TrajectoryDataset([*coarse, *fine])
    every = SubtrajectoryRelabeler(max_rows=None)
    alone, among = every.fit_resample(coarse)[0], every.fit_resample(both)[0]
    np.testing.assert_array_equal(alone, among[: len(alone)])


# -- protocols ----------------------------------------------------------------------------


def test_an_imbalanced_learn_pipeline_fits_episodes_and_predicts_rows():
    pipeline = pytest.importorskip("imblearn.pipeline")
    rng = np.random.default_rng(0)
    first, rate = rng.uniform(0.5, 1.0, size=20), rng.uniform(0.5, 1.5, size=20)
    t = 0.1 * np.arange(21)
    states = (first[:, None] * np.exp(-rate[:, None] * t))[:, :, None]
    ds = TrajectoryDataset.from_arrays(states, params=rate[:, None], dt=0.1)
    pipe = pipeline.make_pipeline(
        SubtrajectoryRelabeler(max_rows=2000, random_state=0),
        StandardScaler(),
        MLPEnsembleRegressor(hidden_layer_sizes=(16,), max_steps=600, random_state=0),
    ).fit(ds)
    found = pipe.predict([[0.8, 1.0, 1.2], [0.6, 0.3, 0.7]])
    expected = [0.8 * np.exp(-1.2), 0.6 * np.exp(-0.21)]
    np.testing.assert_allclose(np.ravel(found), expected, atol=0.05)


@pytest.mark.parametrize("Relabeler", RELABELERS)
def test_the_protocol_of_fit_resample(Relabeler):
    ds = everything()
    relabeler = Relabeler()
    if Relabeler is EpisodeRelabeler:
        relabeler.set_params(terminal_reward=0.0)
    before = repr(relabeler)
    rows, targets = relabeler.fit_resample(ds)
    assert len(rows) == len(targets) == len(relabeler.sample_indices_)
    assert repr(relabeler) == before
    from_list, _ = clone(relabeler).fit_resample(list(ds))
    assert from_list.shape == rows.shape
    with pytest.raises(ValueError, match="y must be omitted"):
        relabeler.fit_resample(ds, np.zeros(len(ds)))
    with pytest.raises(TypeError, match="expected a TrajectoryDataset"):
        relabeler.fit_resample(np.zeros((4, 2)))
    assert relabeler.fit(ds) is relabeler
    with pytest.raises(NotFittedError):
        Relabeler().get_feature_names_out()


@pytest.mark.filterwarnings("ignore:Can't test estimator")
@pytest.mark.parametrize("Relabeler", RELABELERS)
def test_sklearn_checks_pass(Relabeler):
    # rows are no input of a relabeler, so few checks apply; parameters are checked besides
    run_checks(Relabeler(), allowed_skips={})
    check_param_validation(Relabeler.__name__, Relabeler())


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_rows": 0},
        {"starts": "late"},
        {"horizons": "log"},
        {"max_horizon": 0},
        {"inputs": "state"},
        {"random_state": "zero"},
    ],
    ids=str,
)
def test_wrong_parameters_are_refused(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=name):
        SubtrajectoryRelabeler(**wrong).fit(everything())


def test_rewards_of_another_set_are_held_to_the_horizon_of_the_training_episodes():
    def crashes(*lengths):
        return TrajectoryDataset.from_arrays(
            [np.ones((length + 1, 1)) for length in lengths],
            rewards=[np.ones(length) for length in lengths],
            terminated=[length < 10 for length in lengths],
        )

    relabeler = EpisodeRelabeler(terminal_reward=0.0)
    relabeler.fit_resample(crashes(10, 10, 5))
    assert relabeler.horizon_ == 10
    # 4 of 10 steps earn 1; over its own 4 steps it would be 1
    np.testing.assert_allclose(relabeler.targets(crashes(4)), [0.4])
