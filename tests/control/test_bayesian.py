"""Bayesian optimisation of the return: sample-efficient, reproducible, leaves torch alone."""

import sys

import numpy as np
import pytest
import torch

from trajlearn import Trajectory
from trajlearn.control._return_gp import fit_return_gp
from trajlearn.control.bayesian import BayesianSearch
from trajlearn.control.random_search import RandomSearch

BOUNDS = np.array([[-2.0, 2.0], [10.0, 30.0]])
BEST = np.array([0.5, 24.0])


@pytest.fixture(autouse=True)
def _fewer_starts(monkeypatch):
    """A short optimisation of the acquisition."""
    monkeypatch.setattr("trajlearn.control._return_gp._RESTARTS", 3)
    monkeypatch.setattr("trajlearn.control._return_gp._RAW_SAMPLES", 64)


def shape(params):
    """A smooth function on the box (..., 2), 0 at its greatest."""
    scaled = (params - BEST) / (BOUNDS[:, 1] - BOUNDS[:, 0])
    return -10 * (scaled**2).sum(axis=-1) - 2 * scaled.prod(axis=-1)


def trial(params, noise=0.0, offset=0.0):
    """One step of a system whose reward is its state."""
    return Trajectory([[0.0], [shape(params) + noise + offset]], params=params)


def state_reward(states):
    return states[..., 0]


def search_of(kind=BayesianSearch, **settings):
    return kind(**{"bounds": BOUNDS, "reward": state_reward, "horizon": 1} | settings)


def run(search, n_trials, **kw):
    asked = []
    for _ in range(n_trials):
        asked.append(search.ask())
        search.tell(trial(asked[-1], **kw))
    return np.array(asked)


def test_it_finds_the_optimum_of_a_smooth_function_and_beats_random_search():
    gaps = {BayesianSearch: [], RandomSearch: []}
    for seed in range(2):
        for kind, settings in ((BayesianSearch, {"noisy": False}), (RandomSearch, {})):
            search = search_of(kind, random_state=seed, **settings)
            run(search, 10)
            gaps[kind].append(-search.best_reward_)
    assert max(gaps[BayesianSearch]) < 1e-2
    assert max(gaps[BayesianSearch]) < 0.2 * min(gaps[RandomSearch])


def test_it_finds_an_optimum_at_the_bounds():
    search = search_of(bounds=[[1.0, 2.0], [10.0, 20.0]], noisy=False, random_state=0)
    run(search, 8)
    np.testing.assert_allclose(search.best_params_, [1.0, 20.0], atol=1e-6)


def test_its_first_trials_are_those_of_random_search():
    first = run(search_of(random_state=3, n_initial=2), 3)
    sobol = run(search_of(RandomSearch, random_state=3), 3)
    np.testing.assert_array_equal(first[:2], sobol[:2])
    assert (first[2] != sobol[2]).all()


def test_the_same_seed_gives_the_same_bits_also_after_resuming(tmp_path):
    whole = run(search_of(random_state=1), 4)
    search = search_of(random_state=1)
    run(search, 2)
    search.ask()
    search.save(tmp_path / "search.npz")
    torch.manual_seed(99)
    resumed = search_of().resume(tmp_path / "search.npz")
    np.testing.assert_array_equal(run(resumed, 2), whole[2:])
    assert (run(search_of(random_state=2), 2)[1] != whole[1]).any()


def test_other_seeds_agree_on_the_same_trials():
    """The greatest acquisition is a matter of the trials; only its optimiser has a seed."""
    rng = np.random.default_rng(0)
    tried = BOUNDS[:, 0] + rng.random((6, 2)) * (BOUNDS[:, 1] - BOUNDS[:, 0])
    asked = [
        search_of(random_state=seed).tell([trial(params) for params in tried]).ask()
        for seed in (0, 1)
    ]
    np.testing.assert_allclose(asked[0], asked[1], rtol=1e-3)


def test_torch_is_left_as_it_was():
    search = search_of(random_state=0)
    run(search, 2)
    torch.manual_seed(7)
    before = torch.get_rng_state()
    torch.set_num_threads(2)
    try:
        search.ask()
        search.predict_return([BEST])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("offset", [0.0, -1e6])
def test_one_trial_is_enough_to_propose_and_says_little(offset):
    search = search_of(random_state=0)
    run(search, 1, offset=offset)
    tried, proposed = search.best_params_, search.ask()
    # knowing nothing but one point, it goes away from it
    assert np.abs((proposed - tried) / [4.0, 20.0]).max() > 0.4
    found = search.predict_return([tried, proposed])
    np.testing.assert_allclose(found.reward, search.returns_[0], rtol=0.1)
    assert found.std[1] > 1.5 * found.std[0] > 0


def test_trials_that_are_all_the_same_are_no_error():
    search = search_of(random_state=0)
    for _ in range(3):
        search.tell(Trajectory([[0.0], [5.0]], params=search.ask()))
    assert np.isfinite(search.ask()).all()
    np.testing.assert_allclose(search.predict_return([BEST]).reward, 5.0, rtol=1e-3)


def test_the_predicted_return_is_that_of_a_trial():
    rng = np.random.default_rng(0)
    tried = BOUNDS[:, 0] + rng.random((40, 2)) * (BOUNDS[:, 1] - BOUNDS[:, 0])
    noise = 0.2 * rng.normal(size=40)
    search = search_of(random_state=0)
    for params, off in zip(tried, noise):
        search.tell(trial(params, noise=off))
    new = BOUNDS[:, 0] + rng.random((100, 2)) * (BOUNDS[:, 1] - BOUNDS[:, 0])
    found = search.predict_return(new)
    observed = shape(new) + 0.2 * rng.normal(size=100)
    assert found.value is found.reward is found.expected
    assert np.sqrt(np.mean((found.reward - shape(new)) ** 2)) < 0.2
    # the std is of what one trial returns, noise included
    assert 0.7 < np.std((observed - found.reward) / found.std) < 1.3
    assert found.std.min() > 0.1
    # what was predicted of a proposal stands in the history
    proposed = search.ask()
    expected = search.predict_return([proposed])
    search.tell(trial(proposed))
    last = search.history().iloc[-1]
    np.testing.assert_allclose(last["predicted"], expected.reward[0])
    np.testing.assert_allclose(last["predicted_std"], expected.std[0])


def test_the_incumbent_of_noisy_trials_is_the_best_mean_and_not_the_luckiest():
    """Many equal trials, one of which was lucky: only without noise is that worth improving on."""
    points = np.repeat([[0.2], [0.8]], 10, axis=0)
    returns = np.repeat([0.0, 0.5], 10) + 0.1 * np.random.default_rng(0).normal(size=20)
    returns[3] = 1.5
    best = {}
    for noisy in (True, False):
        gp = fit_return_gp(points, returns, noisy=noisy)
        best[noisy] = gp.centre + gp.unit * gp.incumbent
    assert abs(best[True] - 0.5) < 0.15
    assert abs(best[False] - 1.5) < 1e-9


def test_the_acquisition_and_the_noise_change_the_proposal():
    asked = [
        run(search_of(random_state=0, n_initial=4, **settings), 5)[-1]
        for settings in ({}, {"acquisition": "ucb"}, {"noisy": False})
    ]
    assert (asked[0] != asked[1]).any()
    assert (asked[0] != asked[2]).any()


def test_a_trial_that_ended_early_is_data():
    search = search_of(horizon=3, terminal_reward=-9.0, random_state=0)
    search.tell(Trajectory([[0.0], [1.0]], params=search.ask(), terminated=True))
    assert search.best_reward_ == -17.0
    assert np.isfinite(search.ask()).all()


def test_without_botorch_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "botorch", None)
    search = search_of(random_state=0)
    # at once, before any trial was run
    with pytest.raises(ImportError, match=r'BayesianSearch needs botorch.*trajlearn\[search\]"'):
        search.ask()


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="acquisition"):
        search_of(acquisition="luck").ask()
    search = search_of(random_state=0)
    with pytest.raises(AttributeError, match="no trial"):
        search.predict_return([BEST])
    run(search, 1)
    with pytest.raises(ValueError, match=r"params has shape \(1, 3\); expected \(m, 2\)"):
        search.predict_return([[0.0, 1.0, 2.0]])
