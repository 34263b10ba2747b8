"""The study of real flights, on made-up flights, and on a few real ones where they are."""

import json

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import (
    _flights_data,
    _flights_kernel,
    _flights_models,
    _flights_ranking,
    real_flights,
)
from benchmarks.paper._flights_data import (
    COMMON_FROM,
    HORIZONS,
    MOTION_UNTIL,
    SPLITS,
    Flights,
    flights,
    folds,
    squared_errors,
    starts,
    tracking_errors,
    truth_at,
)
from benchmarks.paper._flights_kernel import GainsCurveForecaster, linear_forecast, out_of_fold
from benchmarks.paper._flights_models import CELLS, blend, forecast_at
from benchmarks.paper._flights_ranking import nearest, rankings, repeats
from benchmarks.paper._flights_tables import ALL, MAIN, STATES, Errors, driven, gains_table
from benchmarks.paper.real_flights import BENCHMARK
from trajlearn import MeanEpisodeForecaster, TrajectoryDataset
from trajlearn.datasets import load_crazyflie_gains

DT = 0.02
STEPS = 275
TABLES = {"errors", "skill", "gains", "floor", "ranking", "scores", "example"}


def made_up():
    """Flights whose distance from the set-point is set by one gain, and nothing else."""
    plan = [("line_y", e, gain) for e, gain in enumerate([2, 4, 5, 7, 8, 10, 11]) for _ in range(2)]
    plan += [("figure8", 10 + e, gain) for e, gain in enumerate([3, 5, 6, 9, 12])]
    states, references = [], []
    for kind, _, gain in plan:
        t = DT * np.arange(STEPS + 1)
        path = np.zeros((len(t), 6))
        path[:, 1] = np.sin(t)
        path[:, 4] = np.cos(t)
        if kind == "figure8":
            path[:, 0], path[:, 3] = np.cos(t), -np.sin(t)
        flown = np.concatenate([path, np.zeros((len(t), 6))], axis=1)
        flown[:, 1] += np.cos(3 * t) / gain
        flown[:, 2:] += 0.01 * np.cos(np.arange(2, 12) * t[:, None]) / gain
        states.append(flown)
        references.append(path)
    params = np.ones((len(plan), 19))
    params[:, 0] = [gain for *_, gain in plan]
    ds = TrajectoryDataset.from_arrays(
        states,
        references=references,
        actions=[np.ones((STEPS, 4)) for _ in plan],
        params=params,
        dt=DT,
        time_origin=np.zeros(len(plan)),
        context={"kind": [kind for kind, *_ in plan], "motors": ["upgraded"] * len(plan)},
        group=[experiment for _, experiment, _ in plan],
        ids=[f"log{i}" for i in range(len(plan))],
        state_names=STATES,
    )
    logged = np.ones(len(plan), dtype=bool)
    # of one flight the beginning is not logged
    logged[3] = False
    info = pd.DataFrame({"start_logged": logged, "violent": False}, index=ds.ids)
    return ds, info


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(_flights_data, "load", made_up)


@pytest.fixture
def short(monkeypatch):
    tiny = {"T": 20, "T, long": 20, "C": 20, "D": 20, "LSTM": 2}
    monkeypatch.setitem(_flights_models.STEPS, "quick", tiny)
    monkeypatch.setattr(_flights_data, "STRIDE", 70)
    monkeypatch.setattr(_flights_ranking, "N_BOOTSTRAP", 10)


@pytest.fixture(autouse=True)
def _few_settings(monkeypatch):
    monkeypatch.setattr(_flights_kernel, "LENGTHS", (8.0,))
    monkeypatch.setattr(_flights_kernel, "RIDGES", (0.01, 1.0))
    monkeypatch.setattr(_flights_kernel, "LINEAR_RIDGES", [(1.0,), (1e3,)])


# -- flights, folds, errors -----------------------------------------------------------------------


@pytest.mark.parametrize("split", SPLITS)
def test_no_experiment_is_in_training_and_test(few, split):
    ds = flights().ds
    tested = np.concatenate([test for _, test in folds(ds, split)])
    assert sorted(tested) == list(range(len(ds)))
    for train, test in folds(ds, split):
        assert not set(ds.group[train]) & set(ds.group[test])
        assert {*ds.context["kind"][test]} == {"line_y", "figure8"} or split == "experiment"


def test_the_tracking_error_is_that_along_the_driven_axes(few):
    every = flights()
    found = tracking_errors(every.ds.states, every.ds, start_logged=every.start_logged)
    gain = every.ds.params[:, 0]
    t = DT * np.arange(1, STEPS + 1)
    for window, begin in (("common", COMMON_FROM), ("full", dict.fromkeys(COMMON_FROM, 0.0))):
        for i, kind in enumerate(every.ds.context["kind"]):
            wave = np.cos(3 * t[(t >= begin[kind] - 1e-9) & (t <= MOTION_UNTIL[kind] + 1e-9)])
            want = np.sqrt((wave**2).mean()) / gain[i]
            if window == "full" and not every.start_logged[i]:
                want = np.nan
            assert found[window][i] == pytest.approx(want, nan_ok=True)


def test_errors_are_averaged_over_the_starts_of_a_flight(few):
    every = flights()
    at = truth_at(every.ds)
    assert np.isnan(at.truth[-1]).any()
    off = np.where(at.first, 3.0, 1.0)[:, None, None]
    found = squared_errors(at.truth + off, at, len(every.ds), motion=every.start_logged)
    begun = every.start_logged
    assert found["motion"][begun] == pytest.approx(9.0)
    assert np.isnan(found["motion"][~begun]).all()
    assert found["later"][begun] == pytest.approx(1.0)
    n = len(starts(every.ds)[3])
    assert found["later"][~begun][:, 0] == pytest.approx((9 + n - 1) / n)
    diverged = np.where(at.episode[:, None, None] == 0, np.inf, at.truth)
    found = squared_errors(diverged, at, len(every.ds), motion=begun)
    assert np.isinf(found["later"][0, 0]).all()
    assert (found["later"][1:, 0] == 0).all()


# -- kernel ridge and averages --------------------------------------------------------------------


def test_kernel_ridge_learns_from_the_gains_what_the_mean_flight_misses(few):
    ds = flights().ds
    test = np.isin(ds.group, [3, 12])
    truth = ds[test].states
    errors = [
        np.abs(model.fit(ds[~test]).curve(ds[test]) - truth).max()
        for model in (MeanEpisodeForecaster(), GainsCurveForecaster())
    ]
    assert errors[1] < 0.4 * errors[0]


def test_a_flight_that_begins_late_counts_where_it_is(few):
    ds = flights().ds
    late = ds[:1].assign(time_origin=np.array([-0.5]))
    model = GainsCurveForecaster().fit(late.concatenate(ds[1:]))
    assert np.isfinite(model.curve(ds)).all()


def test_out_of_fold_curves_do_not_know_their_own_experiment(few):
    ds = flights().ds
    ds = ds[ds.context["kind"] == "line_y"]
    model = GainsCurveForecaster()
    before = out_of_fold(model, ds)
    states = ds.states.copy()
    mine = np.repeat(ds.group == 4, ds.lengths + 1)
    states[mine] += 5.0
    bounds = ds.offsets[1:-1]
    changed = TrajectoryDataset.from_arrays(
        np.split(states, bounds),
        references=np.split(ds.references, bounds),
        params=ds.params,
        dt=DT,
        time_origin=ds.time_origin,
        context=ds.context,
        group=ds.group,
        state_names=STATES,
    )
    after = out_of_fold(model, changed)
    assert np.array_equal(before[mine], after[mine])
    assert not np.allclose(before[~mine], after[~mine])


def test_a_linear_correction_of_the_curve_helps_at_once(few):
    ds = flights().ds
    test = np.isin(ds.group, [3, 12])
    curves = GainsCurveForecaster().fit(ds[~test])
    linear = linear_forecast(ds[~test], ds[test], curves)
    truth = truth_at(ds[test]).truth
    assert np.array_equal(np.isnan(linear), np.isnan(truth))
    plain = forecast_at(curves, ds[test])
    off = [np.nanmean((some[:, 0] - truth[:, 0]) ** 2) for some in (plain, linear)]
    assert off[1] < off[0]


def test_the_average_is_c_at_first_and_without_c_later():
    others = ("kernel ridge + linear", "T, kernel ridge", "T, tracking error")
    predicted = {row: np.full((2, len(HORIZONS), 12), float(i)) for i, row in enumerate(others)}
    predicted["C"] = np.full((2, len(HORIZONS), 12), 10.0)
    found = blend(predicted)[0, :, 0]
    assert found[[0, 1]] == pytest.approx(10.0)
    assert found[4:] == pytest.approx(1.0)
    assert found[2] == pytest.approx(1 + 9 * np.log(5) / np.log(10))
    # where C has diverged it no longer counts
    predicted["C"][:, 4:] = np.inf
    assert blend(predicted)[0, 4:] == pytest.approx(1.0)


def test_forecasts_of_too_short_flights_are_missing(few):
    ds = flights().ds.truncate(60)
    found = forecast_at(MeanEpisodeForecaster().fit(ds), ds)
    assert found.shape[1] == len(HORIZONS)


# -- ranking --------------------------------------------------------------------------------------


def test_the_nearest_in_time_are_three_other_experiments_of_the_same_group(few):
    every = flights()
    errors = 1.0 * np.arange(len(every.ds))
    known = np.flatnonzero(every.ds.group != 3)
    # experiments 1, 2, 4 and 5 are as near in pairs: of the farther pair the earlier counts
    assert nearest(every, known, 6, errors) == pytest.approx((4.5 + 8.5 + 2.5) / 3)
    assert nearest(every, known[known != 18], 18, errors) == pytest.approx((17 + 16 + 15) / 3)


def test_repeats_are_the_other_flights_with_the_same_gains(few):
    every = flights()
    errors = 1.0 * np.arange(len(every.ds))
    errors[2] = np.nan
    found = repeats(every, errors)
    assert found[:2].tolist() == [1.0, 0.0]
    assert np.isnan(found[[2, 3]]).all()
    # nobody else flew these
    assert np.isnan(found[-5:]).all()


def test_a_ranking_has_a_line_a_row():
    head = {"split": "block", "window": "common", "group": MAIN, "seed": 0, "row": "T"}
    lines = {"fold": [0, 0, 0, 1, 1, 1], "experiment": range(6), "flown": [1.0, 2, 3, 4, 5, 6]}
    (line,) = rankings(pd.DataFrame(head | lines | {"predicted": [2.0, 4, 6, 8, 10, 12]})).to_dict(
        "records"
    )
    assert (line["pooled"], line["per_fold"], line["n"]) == (1.0, 1.0, 6)
    assert line["log_error"] == pytest.approx(np.log(2))


def test_what_gains_add_is_a_ratio_with_an_interval(few):
    every = flights()
    errors = Errors(every)
    n = len(every.ds)
    for row, size in (("T, tracking error", 1.0), ("T, tracking error, no gains", 4.0)):
        values = np.full((n, len(HORIZONS), 12), size)
        tracking = {window: np.ones(n) for window in ("common", "full")}
        result = {"motion": values, "later": values, "tracking": tracking}
        whole = {"flights": every.ds.ids.tolist(), "range": np.ones(12), "rows": {row: result}}
        errors.add("block", 0, 0, whole)
    table = gains_table(errors)
    assert set(table["group"]) == set(every.group)
    assert (table[["ratio", "low", "high"]].to_numpy() == 0.5).all()
    squared = np.ones((n, 1, 12))
    line = np.char.startswith(every.group, "line_y")
    assert driven(squared, every.group)[:, 0].tolist() == np.where(line, 1.0, 2.0).tolist()


# -- the command ----------------------------------------------------------------------------------


def check_the_run(folder):
    facts = json.loads((folder / "real-flights.json").read_text())
    assert set(facts["tables"]) == TABLES
    assert facts["settings"]["data"] == "crazyflie_lee_gains"
    errors = pd.read_csv(folder / "errors.csv")
    assert set(errors["row"]) == {row for rows in _flights_models.CELLS for row in rows}
    assert {ALL, MAIN} <= set(errors["group"])
    ranking = pd.read_csv(folder / "ranking.csv")
    assert {"direct GP", "nearest in time", "T, tracking error"} <= set(ranking["row"])
    # what is told the actions after the start cannot take part
    assert not ranking["row"].str.contains("logged").any()
    text = (folder / "real-flights.md").read_text()
    assert "### Ranking of held-out flights" in text
    assert "integrators" in text
    assert {path.stem for path in folder.glob("*.png")} == {
        f"real-flights-{name}" for name in ("horizon", "skill", "ranking", "example")
    }


def test_the_whole_study_comes_out_of_made_up_flights(few, short, tmp_path, capsys):
    BENCHMARK.main(["--quick", "--n-jobs", "1", "--out", str(tmp_path)])
    assert "quick mode" in capsys.readouterr().out
    check_the_run(tmp_path / "real-flights")


def test_a_full_run_takes_both_splits_and_every_seed(few, monkeypatch):
    asked = []

    class Asked(Exception):
        pass

    class Recorder:
        mode, seeds = "full", [0, 1, 2]

        def cells(self, cells, function):
            asked.extend(cells)
            raise Asked

    with pytest.raises(Asked):
        real_flights.run(Recorder())
    by_split = {split: [cell for cell in asked if cell["split"] == split] for split in SPLITS}
    assert len(by_split["experiment"]) == 5 * (1 + 3 * (len(CELLS) - 1))
    # on blocks what theta adds, and the average; of the rest one seed
    assert len(by_split["block"]) == 5 * (len(CELLS) + 2 * 3)
    seeds = {cell["seed"] for cell in by_split["block"] if "average" in cell["rows"]}
    assert seeds == {0, 1, 2}


@pytest.mark.data
def test_the_whole_study_comes_out_of_a_few_real_flights(data_folder, short, monkeypatch, tmp_path):
    folder = data_folder(_flights_data.FOLDER)
    monkeypatch.setenv("TRAJLEARN_FLIGHTS", "unset by the test's end")
    whole, facts = load_crazyflie_gains(folder, return_info=True)

    def some():
        group = np.array(whole.context["kind"]) + np.array(whole.context["motors"])
        chosen = np.concatenate(
            [np.flatnonzero(group == name)[:6] for name in ("line_yupgraded", "figure8upgraded")]
        )
        return whole[chosen], facts.iloc[chosen]

    monkeypatch.setattr(_flights_data, "load", some)
    rows = [CELLS[0], ["T, tracking error"], ["T, tracking error, no gains"], ["D, logged actions"]]
    monkeypatch.setattr(_flights_models, "CELLS", rows)
    options = ["--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    BENCHMARK.main([*options, "--data", str(folder.parent)])
    check_the_run(tmp_path / "real-flights")


@pytest.mark.data
@pytest.mark.parametrize("split", SPLITS)
def test_no_real_experiment_is_in_training_and_test(data_folder, monkeypatch, split):
    folder = data_folder(_flights_data.FOLDER)
    monkeypatch.setenv("TRAJLEARN_FLIGHTS", str(folder.parent))
    every = flights()
    assert isinstance(every, Flights)
    for train, test in folds(every.ds, split):
        assert not set(every.ds.group[train]) & set(every.ds.group[test])
        assert len(set(every.group[test])) == 4 or split == "experiment"


def test_a_folder_without_the_flights_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        BENCHMARK.main(["--quick", "--out", str(tmp_path), "--data", str(tmp_path)])
    assert "has no folder crazyflie_lee_gains" in capsys.readouterr().err
