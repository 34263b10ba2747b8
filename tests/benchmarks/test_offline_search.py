"""Choosing among flown gains: splits, what a model may know, regret, trials, the command."""

import json

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _flights_data, _flights_kernel, _flights_models
from benchmarks.paper import _offline_search_page as page
from benchmarks.paper import _offline_search_ranking as ranking
from benchmarks.paper import _offline_search_rows as rows
from benchmarks.paper import _offline_search_trials as trials
from benchmarks.paper._flights_tables import MAIN, STATES
from benchmarks.paper._offline_search_data import (
    FIFTH,
    LATE,
    RANDOM,
    SPLITS,
    distinct_gains,
    held_out,
    noise,
    planned,
    pool,
    predicted_before,
)
from benchmarks.paper._offline_search_rows import from_all, from_the_best
from benchmarks.paper.offline_search import BENCHMARK
from trajlearn import MeanEpisodeForecaster, TrajectoryDataset

DT = 0.02
STEPS = 245
SIDE = "line_x, upgraded motors"
TABLES = {"pool", "choices", "scores", "gains", "progress", "hits"}


def made_up(changed=()):
    """Flights whose distance from the set-point is set by their first gain, and nothing else.

    Those of the experiments `changed` are flown otherwise.
    """
    gains = [9, 2, 5, 7, 3, 8, 11, 4, 6, 12, 10, 2.5]
    plan = [("line_y", e, gain) for e, gain in enumerate(gains) for _ in range(1 + (e == 2))]
    plan += [("line_x", 20 + e, gain) for e, gain in enumerate([3, 5, 6, 9, 12, 4, 7, 8])]
    t = DT * np.arange(STEPS + 1)
    states, references = [], []
    for kind, experiment, gain in plan:
        path, driven = np.zeros((len(t), 6)), 1 if kind == "line_y" else 0
        path[:, driven], path[:, 3 + driven] = np.sin(t), np.cos(t)
        flown = np.concatenate([path, np.zeros((len(t), 6))], axis=1)
        flown[:, driven] += np.cos(3 * t) / gain
        flown[:, 2:] += 0.01 * np.cos(np.arange(2, 12) * t[:, None]) / gain
        flown += 7.0 * (experiment in changed)
        states.append(flown)
        references.append(path)
    n = len(plan)
    params = np.ones((n, 4))
    params[:, 0] = params[:, 1] = [gain for *_, gain in plan]
    params[:, 2] = [gain % 3 for *_, gain in plan]
    ds = TrajectoryDataset.from_arrays(
        states,
        references=references,
        actions=[np.ones((STEPS, 4))] * n,
        params=params,
        dt=DT,
        time_origin=np.zeros(n),
        context={"kind": [kind for kind, *_ in plan], "motors": ["upgraded"] * n},
        group=[experiment for _, experiment, _ in plan],
        ids=[f"log{i}" for i in range(n)],
        state_names=STATES,
        param_names=["P", "same as P", "I", "mass"],
    )
    logged = np.arange(n) != 5
    return ds, pd.DataFrame({"start_logged": logged, "violent": False}, index=ds.ids)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(_flights_data, "load", made_up)
    monkeypatch.setattr(_flights_kernel, "LENGTHS", (2.0, 8.0))
    monkeypatch.setattr(_flights_kernel, "RIDGES", (0.01, 1.0))


# -- what is held out, and what may be known ------------------------------------------------------


def test_the_pool_has_a_line_an_experiment():
    candidates = pool()
    gains = candidates.every.ds.params[:, 0]
    assert len(candidates.table) == 20
    # both flights of the third experiment count
    assert candidates.table["n_flights"].tolist() == [1, 1, 2] + 17 * [1]
    main = candidates.of_group(MAIN)
    size = candidates.flown[main] * candidates.gains(main)[:, 0]
    assert size == pytest.approx(size[0])
    assert len(candidates.flights_of(np.array([2]))) == 2
    assert gains[candidates.flights_of(np.array([2]))].tolist() == [5.0, 5.0]
    std, free, guess = noise(candidates, MAIN)
    assert (std, free) == (0.0, 1)
    assert np.isfinite(guess).sum() == 2
    assert np.isnan(noise(candidates, SIDE)[0])


@pytest.mark.parametrize("split", SPLITS)
def test_every_group_is_parted_and_no_experiment_is_on_both_sides(split):
    candidates = pool()
    train, test = held_out(candidates, split, 1 if split in (RANDOM, FIFTH) else 0)
    assert sorted([*train, *test]) == list(range(20))
    for group in (MAIN, SIDE):
        every = candidates.of_group(group)
        assert np.isin(every, train).any()
        assert np.isin(every, test).any()


def test_the_late_half_comes_after_what_models_know():
    candidates = pool()
    train, test = held_out(candidates, LATE, 0)
    for group in (MAIN, SIDE):
        every = candidates.of_group(group)
        assert np.intersect1d(train, every).max() < np.intersect1d(test, every).min()
        assert abs(np.isin(every, test).sum() - len(every) / 2) <= 0.5


def test_random_halves_differ_from_seed_to_seed():
    candidates = pool()
    halves = [held_out(candidates, RANDOM, fold)[1].tolist() for fold in (0, 0, 1)]
    assert halves[0] == halves[1] != halves[2]


def test_no_score_depends_on_how_the_held_out_experiments_were_flown(monkeypatch):
    monkeypatch.setitem(_flights_models.STEPS, "quick", {"T": 5, "C": 5, "T, long": 5})
    candidates = pool()
    test = held_out(candidates, RANDOM, 0)[1]
    names = candidates.table["experiment"].to_numpy()[test]
    names_of_rows = [*ranking.CELLS[0], rows.T]
    asked = {"rows": names_of_rows, "split": RANDOM, "fold": 0, "mode": "quick", "seed": 0}
    before = ranking.cell(**asked)["rows"]
    monkeypatch.setattr(_flights_data, "load", lambda: made_up(set(names)))
    after = ranking.cell(**asked)["rows"]
    for row in names_of_rows:
        assert np.array_equal(before[row][ranking.USUAL], after[row][ranking.USUAL])
    # from its own start a model has seen something of the flight
    own = [scores[rows.T][ranking.OWN] for scores in (before, after)]
    assert not np.allclose(*own)


def test_a_planned_flight_has_the_usual_start():
    candidates = pool()
    main = candidates.of_group(MAIN)
    ds = candidates.every.ds
    known = np.array([0, 1, 2])
    plan = planned(candidates, known, main[3:])
    assert plan.params[:, 0].tolist() == candidates.gains(main[3:])[:, 0].tolist()
    assert plan.states[0] == pytest.approx(np.median(ds.states[ds.offsets[known]], axis=0))
    # flights of that kind whose beginning is not logged tell nothing: hovering at the set-point
    hovering = planned(candidates, np.array([5]), main[3:])
    assert hovering.states[0].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0, 0.0] + 6 * [0.0]


def test_a_model_without_gains_cannot_tell_experiments_apart_before_the_flight():
    candidates = pool()
    train, test = held_out(candidates, RANDOM, 0)
    known = candidates.flights_of(train)
    model = MeanEpisodeForecaster().fit(candidates.every.ds[known])
    predicted = predicted_before(model, candidates, known, test)
    for group in (MAIN, SIDE):
        mine = np.isin(test, candidates.of_group(group))
        assert np.ptp(predicted[mine]) == 0
    assert np.isfinite(predicted).all()


# -- gains ----------------------------------------------------------------------------------------


def test_near_the_best_gains_is_a_distance_from_the_best_known_experiment():
    candidates = pool()
    main, gains = candidates.of_group(MAIN), candidates.gains(candidates.of_group(MAIN))[:, 0]
    known, asked = main[gains < 9], main[gains >= 9]
    found = from_the_best(candidates, known, asked)
    best = known[candidates.flown[known].argmin()]
    assert candidates.gains(np.array([best]))[0, 0] == 8
    near = dict(zip(gains[gains >= 9], found, strict=True))
    # the other gains of 9 and 12 are the same
    assert 0 < near[9] < near[12]
    assert from_the_best(candidates, known, np.array([best])).tolist() == [0.0]
    assert np.isinf(from_the_best(candidates, candidates.of_group(SIDE), asked)).all()


def test_the_farthest_gains_are_far_from_all_that_were_tried():
    candidates = pool()
    main, gains = candidates.of_group(MAIN), candidates.gains(candidates.of_group(MAIN))
    known = main[gains[:, 0] > 2.5]
    # of all, those that were not tried are the farthest
    order = np.argsort(from_all(candidates, known, main))
    assert set(gains[order[:2], 0]) == {2.0, 2.5}
    assert from_all(candidates, main, main) == pytest.approx(0.0)


def test_gains_that_vary_together_are_one():
    assert list(distinct_gains(pool(), MAIN)) == ["P = same as P", "I"]


# -- what a choice is worth -----------------------------------------------------------------------


def test_regret_is_against_the_best_and_ties_are_drawn_at_random():
    flown = np.array([5.0, 1.0, 3.0, 9.0])
    found = ranking.choice(np.array([1.0, 2.0, 3.0, 4.0]), flown)
    assert (found["chosen"], found["best"], found["random"]) == (5.0, 1.0, 4.5)
    assert (found["top"], found["best_top"], found["median"]) == (3.0, 3.0, 4.0)
    assert found["rho"] == pytest.approx(0.4)
    tied = ranking.choice(np.array([0.0, 0.0, 1.0, 2.0]), flown)
    assert (tied["chosen"], tied["top"]) == (3.0, 3.0)
    nothing = ranking.choice(np.zeros(4), flown)
    assert nothing["chosen"] == nothing["top"] == nothing["random"]
    assert np.isnan(nothing["rho"])
    diverged = ranking.choice(np.array([np.inf, 1.0, 2.0, np.inf]), flown)
    assert (diverged["chosen"], diverged["top"]) == (1.0, (1 + 3 + 7) / 3)


def test_models_of_gains_choose_well_where_gains_are_all_that_matters():
    asked = {"rows": ranking.CELLS[0], "split": RANDOM, "fold": 0, "mode": "quick", "seed": 0}
    candidates = pool()
    table = ranking.choice_table(candidates, [(asked, ranking.cell(**asked))])
    main = table[table["group"] == MAIN].set_index("row")
    assert (main.loc[["kernel ridge", "direct GP"], "rho"] > 0.7).all()
    regret = main["chosen"] - main["best"]
    assert regret["mean flight"] == pytest.approx(
        main.loc["mean flight", "random"] - main["best"].iloc[0]
    )
    assert regret["direct GP"] < 0.3 * regret["mean flight"]


def test_a_full_run_takes_every_split_and_as_many_halves_as_seeds():
    asked = pd.DataFrame(ranking.cells("full", list(range(10))))
    asked["first"] = asked["rows"].map(lambda rows: rows[0])
    counts = asked.groupby(["split", "first"]).size()
    assert counts[RANDOM, rows.T] == 10
    assert counts[LATE, rows.T] == 3
    assert counts[FIFTH, rows.T] == 5
    assert counts[RANDOM, rows.NO_GAINS] == 3
    assert set(asked["split"]) == set(SPLITS)


# -- trials ---------------------------------------------------------------------------------------


def test_all_rows_begin_with_the_same_experiments_and_end_with_the_best():
    candidates = pool()
    every, first = candidates.of_group(MAIN), {}
    for row in (rows.GP, rows.LCB, rows.BEST_GAINS, rows.FAR, rows.CHANCE):
        found = trials.cell(row, MAIN, [0, 1], 0)["orders"]
        assert len(found) == 2 * (trials.N_CHANCE if row == rows.CHANCE else 1)
        for i, order in enumerate(found):
            repeat = i // trials.N_CHANCE if row == rows.CHANCE else i
            assert len(set(order)) == len(order)
            first.setdefault(repeat, order[: trials.N_INITIAL])
            assert order[: trials.N_INITIAL] == first[repeat]
            best = candidates.flown[every].min()
            assert candidates.flown[order].min() == best
            if len(order) > trials.N_INITIAL:
                assert candidates.flown[order[-1]] == best
    assert first[0] != first[1]


def repeats_without_the_best(candidates):
    """Those whose first trials, at random, leave something to find."""
    best = candidates.flown[candidates.of_group(MAIN)].argmin()
    orders = trials.cell(rows.CHANCE, MAIN, list(range(8)), 0)["orders"][:: trials.N_CHANCE]
    return [i for i, order in enumerate(orders) if best not in order[: trials.N_INITIAL]]


@pytest.mark.parametrize("row", [rows.RIDGE, rows.GP, rows.T])
def test_a_model_finds_the_best_gains_sooner_than_chance(row):
    candidates = pool()
    undecided = repeats_without_the_best(candidates)[:3]
    done = [
        ({"row": name, "group": MAIN}, trials.cell(name, MAIN, undecided, 60))
        for name in (row, rows.CHANCE)
    ]
    hits = trials.tables(candidates, done)[1].groupby("row")["best"].mean()
    assert hits[row] < hits[rows.CHANCE] - 1


@pytest.mark.parametrize(
    ("row", "module", "function"),
    [(rows.GP, rows, "direct_gp"), (rows.RIDGE, trials, "predicted_before")],
    ids=["without a forecast", "with one"],
)
def test_a_search_knows_only_what_it_has_tried(monkeypatch, row, module, function):
    candidates, asked = pool(), []
    real = getattr(module, function)

    def spy(*arguments):
        first = next(i for i, some in enumerate(arguments) if isinstance(some, np.ndarray))
        asked.append(set(candidates.of_flight[arguments[first]]))
        return real(*arguments)

    monkeypatch.setattr(module, function, spy)
    (order,) = trials.cell(row, MAIN, repeats_without_the_best(candidates)[:1], 0)["orders"]
    assert len(asked) == len(order) - trials.N_INITIAL > 0
    for i, known in enumerate(asked):
        assert known == set(order[: trials.N_INITIAL + i])


def test_progress_is_the_least_error_so_far():
    candidates = pool()
    main = candidates.of_group(SIDE)
    flown = 1e3 * candidates.flown[main]
    order = np.argsort(flown)[[3, 5, 1, 0]]
    done = [({"row": rows.GP, "group": SIDE}, {"orders": [main[order].tolist()]})]
    progress, hits = trials.tables(candidates, done)
    own = progress[progress["row"] == rows.GP]
    want = np.sort(flown)[[3, 3, 1, 0, 0, 0, 0, 0]]
    assert own["median"].to_numpy() == pytest.approx(want)
    assert (own["q95"] == own["median"]).all()
    assert hits[hits["row"] == rows.GP][["within", "best"]].to_numpy().tolist() == [[4, 4]]
    # in the order of flying: the best of these is the fifth
    assert hits[hits["row"] == trials.TUNER]["best"].tolist() == [5]


def test_groups_of_many_good_experiments_are_no_search(monkeypatch):
    assert set(trials.searched(pool())) == {MAIN, SIDE}
    monkeypatch.setattr(trials, "WITHIN", 1.4)
    # four in twelve are within 40 %, and two in eight
    monkeypatch.setattr(trials, "MOST", 0.3)
    assert trials.searched(pool()) == [SIDE]


# -- text ------------------------------------------------------------------------------------------


def test_correlations_that_cancel_are_zero():
    assert page._over(pd.Series([0.1, 0.2, -0.3])) == "0 (-0.3 to 0.2)"
    assert page._over(pd.Series([1e-3, 1e-3])) == "0.001"


# -- the command ----------------------------------------------------------------------------------


def test_the_whole_search_comes_out_of_made_up_flights(monkeypatch, tmp_path, capsys):
    tiny = {"T": 20, "T, long": 20, "C": 20}
    monkeypatch.setitem(_flights_models.STEPS, "quick", tiny)
    monkeypatch.setitem(trials.STEPS, "quick", 5)
    monkeypatch.setitem(trials.N_REPEATS, "quick", 1)
    monkeypatch.setattr(trials, "N_CHANCE", 2)
    BENCHMARK.main(["--quick", "--n-jobs", "1", "--out", str(tmp_path)])
    assert "quick mode" in capsys.readouterr().out
    folder = tmp_path / "offline-search"
    assert set(json.loads((folder / "offline-search.json").read_text())["tables"]) == TABLES
    choices = pd.read_csv(folder / "choices.csv")
    assert set(choices["row"]) == {row for rows in ranking.CELLS for row in rows}
    assert set(choices["split"]) == {RANDOM, LATE}
    hits = pd.read_csv(folder / "hits.csv")
    assert set(hits["row"]) == {*trials.ROWS, trials.TUNER}
    text = (folder / "offline-search.md").read_text()
    for part in ("at random", "Least mean regret", "### Which gains", "fewest trials", " mm"):
        assert part in text
    assert "nan" not in text
    assert {path.stem for path in folder.glob("*.png")} == {
        f"offline-search-{name}" for name in ("trials", "regret", "scatter")
    }


@pytest.mark.data
def test_of_real_flights_the_late_half_has_gains_that_were_never_varied_before(
    data_folder, monkeypatch
):
    monkeypatch.undo()
    monkeypatch.setenv("TRAJLEARN_FLIGHTS", str(data_folder(_flights_data.FOLDER).parent))
    candidates = pool()
    train, test = held_out(candidates, LATE, 0)
    main = candidates.of_group(MAIN)
    integrator = distinct_gains(candidates, MAIN)["Kpos_Ix = Kpos_Iy"]
    assert len(np.unique(integrator[np.isin(main, train)])) == 1
    assert len(np.unique(integrator[np.isin(main, test)])) > 5
    # no experiment of a group is known from another one
    assert candidates.table.groupby("experiment")["group"].nunique().max() == 1
    spread = candidates.flown[main].max() - candidates.flown[main].min()
    assert 0 < noise(candidates, MAIN)[0] < 0.1 * spread
