"""The regimes benchmark: its episodes, scores, ratios, peers, and the whole command in small."""

import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from benchmarks.regimes import _floor, _members, _peers, _pictures, regimes
from benchmarks.regimes._episodes import episodes, scale
from benchmarks.regimes._members import RULES, HeldOut, folds_of, recorded
from benchmarks.regimes._page import goals
from benchmarks.regimes._peers import ROOT, Remote, Rows, candidates, limits_of, roll_out
from benchmarks.regimes._regimes import POLICIES, REGIMES, SYSTEMS, Regime
from benchmarks.regimes._scores import BLOCK_ENDS, block_of, errors_of, scores, shown_horizons
from benchmarks.regimes._tables import BLOCKS, EXACT, ratios, typical
from benchmarks.regimes.regimes import BENCHMARK, MBRL, SEEDS, cells
from trajlearn import Cartpole, OneStepRegressor, default_members
from trajlearn.dynamics._selection.joint_folds import FoldFits
from trajlearn.dynamics.selector import HorizonSelector
from trajlearn.regressors import polynomial
from trajlearn.regressors.control_law import ControlLawRegressor

SMALL = {"n_train": 6, "length": 40}


# -- episodes -----------------------------------------------------------------------------


def test_clean_episodes_are_those_of_the_plant():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    assert (len(data.train), len(data.test)) == (6, 20)
    env = Cartpole()
    for episode in data.train:
        np.testing.assert_array_equal(
            episode.states[1:], env.step(episode.states[:-1], episode.actions)
        )
        assert not env.is_terminal(episode.states[1:]).any()
    assert data.test.states is not data.train.states
    assert not np.isin(data.train.params, data.test.params).any()
    np.testing.assert_array_equal(data.test.states, data.truth.states)


def test_noise_is_a_fraction_of_the_spread_of_each_state():
    data = episodes(Regime("some", noise=0.1, n_train=6, length=200), 3, "quick")
    missed = (data.test.states - data.truth.states).std(axis=0)
    np.testing.assert_allclose(missed, 0.1 * scale("stable", 200), rtol=0.06)
    np.testing.assert_allclose(data.noise, 0.1 * scale("stable", 200))
    # the scale of errors is the same with and without noise
    clean = episodes(Regime("some", n_train=6, length=200), 3, "quick")
    np.testing.assert_array_equal(data.span, clean.span)
    np.testing.assert_array_equal(data.truth.states, clean.truth.states)


def test_the_controller_acts_on_what_it_sees():
    for seen in (False, True):
        data = episodes(Regime("some", noise=0.1, acts_on_noise=seen, **SMALL), 3, "quick")
        logged, true = data.test[0], data.truth[0]
        states = (logged if seen else true).states[:-1]
        theta = np.tile(logged.params, (len(states), 1))
        wanted = data.policy(states, theta, np.zeros(len(states)))
        np.testing.assert_allclose(logged.actions, wanted)


def test_process_noise_stays_in_the_truth():
    data = episodes(Regime("some", process=0.05, n_train=6, length=200), 3, "quick")
    after = np.concatenate([Cartpole().step(e.states[:-1], e.actions) for e in data.truth])
    drawn = np.concatenate([e.states[1:] for e in data.truth]) - after
    np.testing.assert_allclose(drawn.std(axis=0), 0.05 * scale("stable", 200), rtol=0.06)


def test_part_of_the_states_and_part_of_the_steps():
    data = episodes(Regime("some", states=("x", "theta"), every=5, **SMALL), 3, "quick")
    assert data.train.state_names == ("x", "theta")
    assert set(data.train.lengths) == {8}
    assert data.policy is None
    whole = episodes(Regime("some", **SMALL), 3, "quick")
    np.testing.assert_array_equal(data.test[0].states, whole.test[0].states[::5][:, [0, 2]])
    np.testing.assert_allclose(data.reward(data.test.states), -(data.test.states**2).sum(axis=1))


def test_every_regime_is_named_once_and_has_a_policy():
    assert {system for system, _ in REGIMES} == set(SYSTEMS)
    for regime in REGIMES.values():
        assert set(regime.policies) <= set(POLICIES)
        assert regime.policies


# -- scores and ratios --------------------------------------------------------------------


def test_errors_are_in_ranges_and_infinite_from_a_divergence_on():
    truth = episodes(Regime("some", **SMALL), 3, "quick").truth[:2]
    span = np.array([1.0, 2.0, 4.0, 8.0])
    mean = np.stack([e.states[1:] for e in truth]) + span / 10
    mean[1, 5:] = np.nan
    errors = errors_of(mean, truth, span)
    np.testing.assert_allclose(errors[0], 0.01)
    np.testing.assert_allclose(errors[1, :5], 0.01)
    assert np.isinf(errors[1, 5:]).all()


def test_scores_are_over_all_and_over_halves_of_the_episodes():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    mean = np.stack([e.states[1:] for e in data.truth])
    mean[1::2] += 0.1 * data.span
    found = scores(mean, data)
    assert found["cum"] == pytest.approx(0.005)
    curve = found["curve"]
    assert curve["horizon"] == shown_horizons(40)
    assert set(curve["mean_0"]) == {0.0}
    np.testing.assert_allclose(curve["mean_1"], 0.01)
    np.testing.assert_allclose(curve["median"], 0.005)
    assert found["n_diverged"] == 0
    assert scores(np.stack([e.states[1:] for e in data.truth]), data)["reward"] == 0
    mean[3, 20:] = np.inf
    found = scores(mean, data)
    assert (found["cum"], found["reward"], found["n_diverged"]) == (np.inf, np.inf, 1)


@pytest.mark.parametrize("length", [20, 30, 200, 500])
def test_blocks_part_the_horizons(length):
    blocks = [block_of(h, length) for h in range(1, length + 1)]
    assert blocks == sorted(blocks)
    assert set(blocks) == set(range(len(BLOCK_ENDS)))
    assert shown_horizons(length)[-1] == length


@pytest.mark.parametrize("length", [20, 30, 200])
def test_the_typical_error_is_the_average_over_horizons(length):
    data = episodes(Regime("some", n_train=6, length=length), 3, "quick")
    truth = np.stack([e.states[1:] for e in data.truth])
    off = np.random.default_rng(0).gamma(1.0, size=(len(truth), length, 1)) * data.span
    found = scores(truth + off, data)
    medians = np.median(errors_of(truth + off, data.truth, data.span), axis=0)
    assert typical(found) == pytest.approx(medians.mean())


def curve(half_0, half_1):
    names = ("median_0", "median_1", "mean_0", "mean_1")
    return {"curve": dict(zip(names, (half_0, half_1) * 2, strict=True))}


def test_the_best_single_is_found_on_other_episodes_than_the_judged_ones():
    models = {
        # A looks best on the even episodes, B on the odd ones
        "A": curve([1e-4], [4e-4]),
        "B": curve([2e-4], [2e-4]),
        "pick": curve([1e-4], [2e-4]),
    }
    line = ratios(models)[0]
    # even judged by B (chosen on odd): 1 / 2; odd judged by A: 2 / 4
    assert line["rule"] == "pick"
    assert line["worst"] == pytest.approx(0.5)


def test_ratios_of_exact_forecasts_are_one_and_of_lost_ones_infinite():
    exact, lost = curve([EXACT / 100], [EXACT / 50]), curve([np.inf], [np.inf])
    assert ratios({"A": exact, "pick": curve([EXACT / 2], [EXACT / 9])})[0]["worst"] == 1
    assert ratios({"A": lost, "pick": lost})[0]["worst"] == 1
    assert ratios({"A": exact, "pick": lost})[0]["worst"] == np.inf


def test_a_model_that_was_run_on_an_easy_seed_alone_wins_nothing():
    lines = [("A", 1, 1e-6), ("B", 1, 2e-6), ("peer", 1, 1.5e-6), ("A", 2, 1e-2), ("B", 2, 2e-2)]
    lines += [(rule, seed, error) for rule in RULES for _, seed, error in (lines[0], lines[3])]
    table = pd.DataFrame(lines, columns=["model", "seed", "typical"])
    table = table.assign(regime="clean", policy="known", cum=table["typical"], reward=1.0)
    table = table.assign(**dict.fromkeys(BLOCKS, table["typical"]))
    names = {"A": "T", "B": "C", "peer": "PySINDy"}
    table["model"] = table["model"].replace(names)
    ratio = _pictures._ratios({"cartpole": table}, "known", "typical").loc["clean"]
    assert ratio[["T", "C", "PySINDy", "pick"]].tolist() == pytest.approx([1, 2, 1.5, 1])
    best = _pictures._winners({"cartpole": table}, "known")["cartpole", "clean"]
    assert {model for model, _ in best.values()} == {"T"}
    assert goals(table, None)["best single"].item().startswith("T: ")


# -- members ------------------------------------------------------------------------------


def test_one_fit_serves_a_known_and_a_cloned_policy_and_the_selector_chooses_as_alone():
    data = episodes(Regime("some", n_train=8, length=60), 3, "quick")
    folds = folds_of(data.train, 0)
    members = [(f"poly{k}", OneStepRegressor(polynomial(degree=k), policy="clone", clip_states=1.2))
               for k in (1, 2)]  # fmt: skip
    plain = [(n, m.__sklearn_clone__().set_params(policy=data.policy)) for n, m in members]
    alone = HorizonSelector(plain, cv=folds, random_state=0).fit(data.train)
    fitted = {}
    for name, member in members:
        fits = FoldFits(member, data.train, folds, rng=np.random.default_rng(0))
        fitted[name] = fits.fit(range(len(folds)), whole=True), fits.model
    found = _members.judged(fitted, folds, data, data.policy)
    assert found["best"] == alone.best_
    assert [list(line) for line in found["choice"]] == _members._stretches(alone.choice_)
    own = scores(alone.predict(data.test).mean, data)
    assert found["models"]["pick"]["cum"] == pytest.approx(own["cum"], rel=1e-6)
    cloned = _members.judged(fitted, folds, data, None)
    assert cloned["models"]["poly1"]["cum"] != found["models"]["poly1"]["cum"]


def test_a_held_out_episode_is_forecast_by_the_model_that_has_not_seen_it():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    folds = folds_of(data.train, 0)
    models = [OneStepRegressor(polynomial(degree=1)).fit(data.train[some]) for some, _ in folds]
    whole = OneStepRegressor(polynomial(degree=1)).fit(data.train)
    member = HeldOut(whole, recorded(models, whole, folds, data.train, data.policy), data.policy)
    for model, (_, test) in zip(models, folds, strict=True):
        own = model.predict(data.train[test], policy=data.policy)
        np.testing.assert_array_equal(member.predict(data.train[test]).mean, own.mean)
    other = whole.predict(data.test, policy=data.policy)
    np.testing.assert_array_equal(member.predict(data.test).mean, other.mean)


def test_members_share_the_law_that_was_learned_from_the_same_rows():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    members = dict(_members.members_of(REGIMES["cartpole", "clean"], data.train, None, "full"))
    one, other = members["poly1"].fit(data.train), members["poly2"].fit(data.train)
    laws = one.policy_estimator.laws
    assert laws is other.policy_estimator.laws
    assert len(laws) == 1
    other.fit(data.train[:4])
    assert len(laws) == 2
    law = ControlLawRegressor(random_state=0)
    plain = OneStepRegressor(polynomial(degree=1), policy="clone", policy_estimator=law)
    plain.fit(data.train)
    asked = data.test[0].states[:1], data.test.params[:1], np.zeros(1)
    own, alone = one.policy_(*asked), plain.policy_(*asked)
    np.testing.assert_array_equal(own, alone)


def test_a_known_policy_is_cloned_only_where_it_is_also_judged_unknown():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    for policies, wanted in ((("known",), data.policy), (POLICIES, "clone")):
        regime = Regime("some", policies=policies, acts_on_noise=True, **SMALL)
        members = dict(_members.members_of(regime, data.train, data.policy, "full"))
        assert members["poly1"].policy == members["poly1_em_sees"].policy == wanted


def test_where_velocities_are_missing_members_make_up_for_them():
    data = episodes(Regime("some", states=("x", "theta"), **SMALL), 3, "quick")
    for regime, wanted in (("positions only", True), ("clean", False)):
        members = dict(_members.members_of(REGIMES["cartpole", regime], data.train, None, "full"))
        assert ("poly1_latent" in members) == ("poly1_window" in members) == wanted


def test_five_episodes_are_left_out_one_by_one():
    assert len(folds_of(episodes(Regime("s", n_train=5, length=5), 3, "quick").train, 0)) == 5
    assert len(folds_of(episodes(Regime("s", n_train=9, length=5), 3, "quick").train, 0)) == 4


# -- peers --------------------------------------------------------------------------------


class Exact:
    """The plant itself."""

    def step(self, states, inputs):
        return Cartpole().step(states, inputs)


class Runaway:
    def step(self, states, inputs):
        return np.full_like(states, np.nan)


def test_the_exact_plant_rolled_out_is_without_error():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    wide = np.array([[-1e9] * 4, [1e9] * 4])
    predicted = roll_out(Exact(), data.test, wide, data.policy)
    assert scores(predicted, data)["cum"] < 1e-20


def test_states_of_a_peer_stay_in_a_multiple_of_the_training_range():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    limits = limits_of(data.train)
    width = np.ptp(data.train.states, axis=0)
    member = dict(default_members(data.train))["poly1"]
    np.testing.assert_allclose(np.ptp(limits, axis=0), member.clip_states * width)
    predicted = roll_out(Runaway(), data.test, limits, data.policy)
    assert (predicted == limits[1]).all()


def test_rows_are_aligned_and_without_a_policy_hold_theta():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    rows = Rows(data.train, data.policy)
    np.testing.assert_array_equal(rows.after, Cartpole().step(rows.states, rows.inputs))
    np.testing.assert_array_equal(Rows(data.train, None).inputs[45], data.train[1].params)


WORKER = """
import numpy as np
from benchmarks.regimes import _peer_worker
class Linear:
    def __init__(self, scale):
        self.scale = scale
    def fit(self, arrays):
        print("noise on standard output")
        x = np.hstack([arrays["states"], arrays["inputs"]])
        self.w = np.linalg.lstsq(x, arrays["after"])[0]
    def step(self, states, inputs):
        return self.scale * np.hstack([states, inputs]) @ self.w
_peer_worker.PEERS["linear"] = Linear
_peer_worker.main()
"""


def test_a_worker_learns_and_answers_through_the_pipe_and_says_what_went_wrong():
    data = episodes(Regime("some", **SMALL), 3, "quick")
    rows = Rows(data.train, data.policy)
    process = subprocess.Popen(
        [sys.executable, "-c", WORKER, "linear"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        peer = Remote(process, {"scale": 1.0})
        peer.fit(rows)
        x = np.hstack([rows.states, rows.inputs])
        own = x @ np.linalg.lstsq(x, rows.after)[0]
        np.testing.assert_allclose(peer.step(rows.states, rows.inputs), own)
        with pytest.raises(RuntimeError, match="TypeError"):
            Remote(process, {"unknown": 1}).fit(rows)
        with pytest.raises(RuntimeError, match="ValueError"):
            peer.step(rows.states, rows.inputs[:3])
    finally:
        process.stdin.close()
        process.wait(timeout=10)
    with pytest.raises((RuntimeError, ValueError)):
        peer.step(rows.states, rows.inputs)


def test_candidates_have_no_more_terms_than_our_polynomials():
    assert {c["degree"] for c in candidates("PySINDy", 5, 0, "full")} == {1, 2, 3}
    assert {c["degree"] for c in candidates("pykoop", 20, 0, "full")} == {1, 2}


def test_the_gp_is_exact_on_what_is_linear(monkeypatch):
    monkeypatch.setattr(_peers, "GP_ROWS", 60)
    data = episodes(Regime("some", **SMALL), 3, "quick")
    rows = Rows(data.train, data.policy)
    rows.after = rows.states + 0.1 * rows.states[:, ::-1]
    gp = _peers.GaussianProcess(0)
    gp.fit(rows)
    np.testing.assert_allclose(gp.step(rows.states, rows.inputs), rows.after, atol=2e-3)


# -- the plant itself ---------------------------------------------------------------------


def test_the_plant_starts_from_what_the_measurement_leaves_possible():
    data = episodes(Regime("some", noise=0.3, **SMALL), 3, "quick")
    first = data.test.offsets[:-1]
    true, measured = (ds.states[first] for ds in (data.truth, data.test))
    likely = _floor.likely_starts(data, Cartpole()).states[first]
    off = [((some - true) ** 2).mean(axis=0) for some in (likely, measured)]
    assert (off[0] < off[1]).all()
    exact = episodes(Regime("some", **SMALL), 3, "quick")
    same = _floor.likely_starts(exact, Cartpole())
    np.testing.assert_allclose(same.states, exact.test.states, atol=1e-9)


def test_the_plant_is_better_than_the_plant_from_the_measured_start():
    what = REGIMES["cartpole", "noise 10 %"]
    found = _floor.cell("cartpole", what.name, "plant", "quick", 3)
    data = episodes(what, 3, "quick")
    wide = np.array([[-1e9] * 4, [1e9] * 4])
    naive = scores(roll_out(Exact(), data.test, wide, data.policy), data)
    assert 0 < found["scores"]["cum"] < naive["cum"]


# -- the command --------------------------------------------------------------------------


def test_cells_of_a_seed():
    ours, others, floors = cells("cartpole", "full", 10, ["PySINDy", "mbrl-lib"])
    assert {"noise 3 %", "process .02"} <= {cell["regime"] for cell in floors}
    assert not {"clean", "positions only", "logged every 5"} & {cell["regime"] for cell in floors}
    assert {cell["seed"] for cell in ours + others} == {10}
    assert len(ours) == sum(system == "cartpole" for system, _ in REGIMES)
    slow = [cell for cell in others if cell["peer"] == "mbrl-lib"]
    assert {cell["regime"] for cell in slow} == set(MBRL)
    assert {cell["policy"] for cell in slow} == {"known"}
    assert all(json.dumps(cell) for cell in ours + others)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(regimes, "QUICK", ("5 episodes",))
    monkeypatch.setattr(_members, "QUICK", ("poly1", "poly2", "poly1_em"))
    monkeypatch.setattr(_peers, "GP_ROWS", 40)


def test_the_whole_command_in_small(small, tmp_path, capsys):
    options = ["--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    BENCHMARK.main(["--peers", "sklearn-GP", *options])
    printed = capsys.readouterr().out
    assert "### Policy unknown: cumulated error" in printed
    folder = tmp_path / "regimes"
    table = pd.read_csv(folder / "cartpole-scores.csv")
    assert set(table["model"]) == {"poly1", "poly2", "poly1_em", "pick", "blend", "sklearn-GP"}
    assert set(table["policy"]) == set(POLICIES)
    assert json.loads((folder / "cartpole.json").read_text())["seeds"] == [10]
    assert (folder / "regimes.png").is_file()
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    BENCHMARK.main([*options, "--redraw"])
    assert {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before
    # of the finished cells alone: those of no peer are left out
    BENCHMARK.main([*options, "--finished"])
    assert "sklearn-GP" not in set(pd.read_csv(folder / "cartpole-scores.csv")["model"])


def test_nothing_is_computed_where_only_finished_cells_are_wanted(small, tmp_path):
    with pytest.raises(SystemExit, match="no finished cells"):
        BENCHMARK.main(["--quick", "--finished", "--out", str(tmp_path)])


def test_a_quick_run_never_overwrites_the_results(capsys):
    with pytest.raises(SystemExit):
        BENCHMARK.main(["--quick", "--out", str(regimes.RESULTS)])
    assert "never overwrites" in capsys.readouterr().err


def test_fresh_seeds_come_first():
    assert SEEDS == (33, 34, 35, 10)
