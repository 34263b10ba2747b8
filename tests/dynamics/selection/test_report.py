"""What a selection tells of its members and of the data."""

import re

import numpy as np
import pandas as pd
import pytest
from sklearn.ensemble import RandomForestRegressor
from sklearn.frozen import FrozenEstimator

from tests.dynamics.crossing import Off, decays
from tests.dynamics.systems import gain_policy, linear
from trajlearn import (
    LSTMRegressor,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
    TransitionRelabeler,
)
from trajlearn.dynamics import selector as module
from trajlearn.dynamics._selection import diagnosis
from trajlearn.dynamics._selection.default_members import default_members
from trajlearn.dynamics.selector import HorizonSelector
from trajlearn.regressors import polynomial

STARTS = SubtrajectoryRelabeler(starts="first", max_rows=1000)


def selector(*members, **settings):
    names = [f"m{i}" for i in range(len(members))]
    # all members are judged by all episodes; the race has tests of its own
    settings = {"random_state": 0, "race": False, **settings}
    return HorizonSelector(list(zip(names, members)), **settings)


def sentence(model, begin):
    (found,) = [line for line in model.diagnosis().split("\n") if line.startswith(begin)]
    return found


# -- tables -------------------------------------------------------------------------------


def test_blocks_tell_the_winner_the_second_and_the_ratio_of_their_errors():
    ds = decays(noise=0.0)
    model = selector(Off(0.1, 0.4), Off(0.2, 0.2), Off(0.5, 0.3), bandwidth=0.0).fit(ds)
    report = model.report()
    width = np.ptp(ds.states)
    assert report["from"].tolist() == [1, 11]
    assert report["to"].tolist() == [10, 40]
    assert report["winner"].tolist() == ["m0", "m1"]
    assert report["second"].tolist() == ["m1", "m2"]
    np.testing.assert_allclose(report["error"], (np.array([0.1, 0.2]) / width) ** 2)
    np.testing.assert_allclose(report["ratio"], [4, 9 / 4])
    # without noise the same in all episodes
    assert (report["standard_errors"] > 1e6).all()


def test_standard_errors_tell_how_sure_a_win_is():
    errors = []
    for n in (30, 270):
        ds = decays(n, noise=0.1, seed=3)
        model = selector(Off(0.1, 0.1), Off(0.12, 0.12), margin=99.0).fit(ds)
        (sure,) = model.report()["standard_errors"]
        errors.append(sure)
    # three times as sure with nine times as many
    assert 2 < errors[1] / errors[0] < 4.5


def test_members_tell_their_costs_and_what_they_win():
    model = selector(Off(0.0, 0.2), Off(0.2, 0.0), Off(diverges=0.5), bandwidth=0.0)
    table = model.fit(decays(noise=0.001)).report(by="member")
    assert table["steps"].sum() == 40
    assert table.loc["m2", "n_diverged"] == 12
    assert (table[["fit_seconds", "predict_seconds"]] > 0).all(axis=None)
    assert table["fit_seconds"].to_dict() == model.fit_seconds_
    assert table["loss"].is_monotonic_increasing
    assert table["measurement_noise"].isna().all()


def test_errors_of_steps_that_a_member_does_not_reach_are_absent():
    model = selector(Off(0.1, 0.1), Off(goes=15)).fit(decays())
    table = model.cv_errors_.set_index(["member", "horizon"])
    assert table.loc[("m1", 15), "n_episodes"] == 24
    assert table.loc[("m1", 16), "n_episodes"] == 0
    assert np.isnan(table.loc[("m1", 16), "median"])
    assert np.isfinite(table.loc["m0", "median"]).all()


# -- diagnosis ----------------------------------------------------------------------------


def test_measurement_noise_is_told_with_its_size():
    ds = linear(30, seed=1, shortest=30, longest=30).add_noise(0.1, of="std", random_state=0)
    raw = OneStepRegressor(polynomial(1), policy=gain_policy)
    em = OneStepRegressor(polynomial(1), denoise="em", policy=gain_policy)
    model = selector(raw, em).fit(ds)
    text = sentence(model, "Noise:")
    assert "m1 found measurement noise, in percent of the training range: s0" in text
    share = model.report(by="member").loc["m1", "measurement_noise"]
    true = 100 * np.mean(0.1 * ds.states.std(axis=0) / np.ptp(ds.states, axis=0))
    assert share == pytest.approx(true, rel=0.35)
    assert "m0 has" in text


def test_no_noise_is_told_as_well():
    ds = linear(30, seed=1, shortest=30, longest=30)
    em = OneStepRegressor(polynomial(1), denoise="em", policy=gain_policy)
    assert "found no measurement noise" in sentence(selector(em).fit(ds), "Noise:")
    assert "no member looked" in sentence(selector(Off()).fit(decays()), "Noise:")


def oscillations(names):
    """s'' = -s from rest, with action -s, of which the position alone is logged or all."""
    start = np.random.default_rng(0).uniform(-1.5, 1.5, size=(40, 1))
    times = 0.2 * np.arange(31)
    states = np.stack([start * np.cos(times), -start * np.sin(times)], axis=2)
    actions = -states[:, :-1, :1]
    ds = TrajectoryDataset.from_arrays(states, actions=actions, dt=0.2, state_names=["x", "v"])
    return ds.select_states(names)


def test_members_that_see_more_than_a_state_point_to_partial_ones():
    direct = TrajectoryRegressor(RandomForestRegressor(20), relabeler=STARTS)
    model = selector(OneStepRegressor(polynomial(1)), direct, policy=lambda s, p, t: -s[:, :1])
    whole = sentence(model.fit(oscillations(["x", "v"])), "Partial states:")
    assert "no sign. m0, which sees one state at a time" in whole
    partial = sentence(model.fit(oscillations(["x"])), "Partial states:")
    assert "perhaps" in partial
    assert "m0 has" in partial
    assert "partial=True" in partial


def test_of_two_members_it_is_told_whether_the_other_is_behind_or_ahead():
    members = Off(0.1, 0.1), Off(0.2, 0.2, by_param=True), Off(0.1, 0.1), Off(0.3, 0.3)
    evidence = selector(*members).fit(decays(noise=0.0))._evidence()
    near, far, equal, surely = (
        diagnosis._compared(evidence, *pair) for pair in ((0, 1), (1, 0), (0, 2), (0, 3))
    )
    assert re.fullmatch(r"m1 has .* the error of m0 \(its loss is less by \d.*\)\.", near)
    assert re.fullmatch(r"m0 has .* the error of m1 \(its loss is greater by \d.*\)\.", far)
    assert equal == "m2 has 1 times the error of m0 (its loss is the same)."
    assert surely.startswith("m3 has 9 times the error of m0 (its loss is greater")


def test_without_both_kinds_nothing_is_said_of_partial_states():
    assert "no comparison" in sentence(selector(Off()).fit(decays()), "Partial states:")


def test_noise_that_latent_members_found_is_told():
    ds = oscillations(["x"]).add_noise(0.05, random_state=0)
    latent = OneStepRegressor(polynomial(1), latent_velocities=True)
    model = selector(latent, OneStepRegressor(polynomial(1))).fit(ds)
    assert "m0 found measurement noise" in sentence(model, "Noise:")
    noise = model.report(by="member")["measurement_noise"]
    found = model.estimators_[0].measurement_noise_
    assert noise["m0"] == pytest.approx(100 * found[0] / np.ptp(ds.states))
    assert noise["m0"] > 0.1
    assert np.isnan(noise["m1"])


@pytest.mark.parametrize(
    "member",
    [
        LSTMRegressor(hidden_size=4, max_steps=5),
        OneStepRegressor(polynomial(1), history=3),
        OneStepRegressor(polynomial(1), relabeler=TransitionRelabeler(history=3)),
    ],
    ids=["LSTM", "history", "relabeler"],
)
@pytest.mark.filterwarnings("ignore")
def test_members_that_remember_see_more_than_a_state(member):
    ds = linear(8)
    evidence = selector(member, OneStepRegressor(polynomial(1))).fit(ds)._evidence()
    assert [diagnosis._sees(evidence, i) for i in (0, 1)] == ["more", "state"]


def test_what_is_told_is_what_was_fitted():
    model = selector(Off(0.1, 0.4), Off(0.2, 0.2), bandwidth=0.3).fit(decays(noise=0.1))
    report = model.report()
    pd.testing.assert_frame_equal(model.set_params(bandwidth=0.0).report(), report)


def test_reach_is_how_far_the_median_is_off_by_less_than_a_tenth():
    ds = decays(noise=0.0)
    width = np.ptp(ds.states)
    model = selector(Off(0.09 * width, 0.11 * width)).fit(ds)
    assert "from step 11 of 40" in sentence(model, "Reach:")
    model = selector(Off(0.09 * width, 0.09 * width)).fit(ds)
    assert "to the last step, 40" in sentence(model, "Reach:")


def test_divergence_is_counted():
    assert "none" in sentence(selector(Off()).fit(decays()), "Divergence:")
    model = selector(Off(0.5, 0.5), Off(diverges=0.5)).fit(decays())
    assert "diverged: m1 12 of 24" in sentence(model, "Divergence:")


def test_divergence_is_counted_among_what_a_member_was_judged_by():
    model = selector(Off(0.1, 0.1), Off(0.5, 0.5, diverges=-1.0), race=True).fit(decays())
    assert model.report(by="member").loc["m1", "n_episodes"] == 6
    assert "m1 6 of 6" in sentence(model, "Divergence:")


def test_frozen_members_are_looked_into():
    ds = linear(20, seed=1, shortest=30, longest=30).add_noise(0.1, of="std", random_state=0)
    em = OneStepRegressor(polynomial(1), denoise="em", policy=gain_policy).fit(ds)
    raw = OneStepRegressor(polynomial(1), policy=gain_policy).fit(ds)
    direct = TrajectoryRegressor(RandomForestRegressor(3), relabeler=STARTS)
    model = selector(FrozenEstimator(em), FrozenEstimator(raw), direct).fit(ds)
    assert "m0 found measurement noise" in sentence(model, "Noise:")
    assert "one state at a time" in sentence(model, "Partial states:")


# -- default members ----------------------------------------------------------------------


def names(members):
    return [name for name, _ in members]


ONE_STEP = ["poly1", "poly2", "poly3", "network"]
DENOISED = [f"{name}_em" for name in ONE_STEP]


def test_default_members_suit_what_was_logged():
    ds = linear(12, shortest=20, longest=20)
    assert names(default_members(ds)) == [*ONE_STEP, *DENOISED, "gp", "C", "T"]
    without = TrajectoryDataset.from_arrays([e.states for e in ds], params=ds.params)
    assert names(default_members(without)) == ["C", "T"]
    # who knows neither actions nor theta takes the controller for constant
    bare = TrajectoryDataset.from_arrays([e.states for e in ds])
    assert names(default_members(bare)) == ["C", "T"]
    times = [np.cumsum(np.r_[0, np.random.default_rng(0).uniform(0.5, 1, 20)]) for _ in ds]
    irregular = default_members(ds.assign(times=times))
    assert names(irregular) == [*ONE_STEP, "gp", "C", "T"]
    assert all("dt" in m.inputs for name, m in irregular if name != "T")
    assert names(default_members(list(ds))) == names(default_members(ds))


def test_default_members_roll_out_by_the_policy_given_or_cloned_or_by_the_log():
    ds = linear(12, shortest=20, longest=20)
    policies = {name: m.policy for name, m in default_members(ds, policy=gain_policy)[:9]}
    assert set(policies.values()) == {gain_policy}
    assert {m.policy for _, m in default_members(ds)[:9]} == {"clone"}
    logged = default_members(ds, rollout_actions="logged")[:9]
    assert {(m.policy, m.rollout_actions) for _, m in logged} == {(None, "logged")}


def test_wide_states_have_no_polynomials_of_high_degree():
    states = np.random.default_rng(0).normal(size=(4, 30, 12))
    ds = TrajectoryDataset.from_arrays(states, actions=states[:, 1:, :2])
    # 120 terms of degree two are more than half of 116 steps
    assert names(default_members(ds))[:2] == ["poly1", "network"]


def test_members_for_partial_states_are_asked_for():
    ds = linear(12, shortest=20, longest=20)
    more = dict(default_members(ds, policy=gain_policy, partial=True)[9:-2])
    latent = ["poly1_latent", "poly2_latent", "poly3_latent"]
    assert list(more) == [*latent, "poly1_window", "network_window"]
    assert {more["poly1_window"].history, more["network_window"].history} == {5}
    assert more["poly1_window"].policy is gain_policy
    assert more["poly1_latent"].latent_velocities
    # a policy of the logged states does not know estimated ones
    assert more["poly1_latent"].policy == "clone"


def test_the_recurrent_member_is_asked_for():
    ds = linear(4, shortest=20, longest=20)
    assert "lstm" in names(default_members(ds, lstm=True))
    for source in ("policy", "logged"):
        members = dict(default_members(ds, policy=gain_policy, lstm=True, rollout_actions=source))
        assert {members[name].rollout_actions for name in ("lstm", "poly1")} == {source}


@pytest.mark.filterwarnings("ignore")
def test_the_default_members_fit_and_forecast(monkeypatch):
    asked = {}

    def quick(ds, **settings):
        asked.update(settings)
        kept = ("poly1", "poly2_em", "C")
        members = [pair for pair in default_members(ds, **settings) if pair[0] in kept]
        members[-1][1].set_params(estimator=polynomial(2))
        return members

    monkeypatch.setattr(module, "default_members", quick)
    ds = linear(10, seed=1, shortest=20, longest=20)
    model = HorizonSelector(policy=gain_policy, random_state=0).fit(ds)
    assert asked == {"policy": gain_policy}
    assert model.names_ == ("poly1", "poly2_em", "C")
    assert model.predict(ds).actions == "policy"
    assert "poly" in model.best_
