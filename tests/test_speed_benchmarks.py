"""The speed benchmarks run and report; how fast anything is, no test asks."""

import dataclasses
import json
import math
import sys

import numpy as np
import pytest
import torch

from benchmarks.speed import _command, _gemm, _mbrl, _timing, plan, predict, relabel, train_step

TINY = {
    train_step: train_step.Effort(rows=16, rounds=2, batch_sizes=(8,), members=(1, 2)),
    predict: predict.Effort(rounds=2, fit_steps=5, candidates=(2,), n_steps=20),
    plan: plan.Effort(rounds=2, fit_steps=5, candidates=(5,), n_steps=20),
    relabel: relabel.Effort(rounds=2, n_rows=50, episodes=3, steps=(12,)),
}
BENCHMARKS = [pytest.param(module, id=module.NAME) for module in TINY]


def as_stored(outcome, folder):
    _command.finish("any", outcome, {"what": lambda row: row["case"]}, folder)
    return json.loads((folder / "quick.json").read_text())


@pytest.fixture(scope="module")
def outcomes():
    return {module.NAME: module.run("quick", effort) for module, effort in TINY.items()}


@pytest.mark.parametrize("module", BENCHMARKS)
def test_result_tells_the_numbers_and_where_they_come_from(module, outcomes, tmp_path):
    stored = as_stored(outcomes[module.NAME], tmp_path)
    assert stored["benchmark"] == f"benchmarks.speed.{module.NAME}"
    assert stored["mode"] == "quick"
    assert stored["threads"] == 1
    assert stored["cpu"]
    assert stored["date"]
    assert {"trajlearn", "numpy", "torch", "scikit-learn"} <= set(stored["packages"])
    effort = json.loads(json.dumps(dataclasses.asdict(TINY[module])))
    assert effort.items() <= stored["settings"].items()
    for row in stored["rows"]:
        low, high = row["seconds_quartiles"]
        assert 0 < low <= row["seconds"] <= high
        low, high = row["ratio_quartiles"]
        assert 0 < low <= row["ratio"] <= high
        assert row["rounds"] == 2
        assert not row["base"] or row["ratio"] == 1


@pytest.mark.parametrize("module", BENCHMARKS)
def test_table_has_a_line_for_every_row(module, outcomes):
    rows = outcomes[module.NAME]["rows"]
    lines = _command.table(rows, module.COLUMNS).splitlines()
    assert len(lines) == 2 + len(rows)
    assert {line.count("|") for line in lines} == {len(module.COLUMNS) + 1}


def test_train_step_compares_with_others_where_there_is_one_member(outcomes):
    cases = {n: set() for n in (1, 2)}
    for row in outcomes["train_step"]["rows"]:
        cases[row["n_members"]].add(row["case"])
    assert cases[1] - cases[2] == {"scikit-learn MLPRegressor", "torch DataLoader loop"}


def test_mbrl_stands_beside_the_others_and_fails_before_they_run(monkeypatch, outcomes):
    own = outcomes["train_step"]["rows"][0]
    theirs = [own | {"case": "mbrl-lib", "n_members": n} for n in (1, 2)]
    monkeypatch.setattr(_mbrl, "interpreter", lambda: "python")
    monkeypatch.setattr(_mbrl, "run", lambda *_: ({"mbrl": "0.2.0"}, theirs))
    outcome = train_step.run("quick", TINY[train_step], mbrl=True)
    members = [row["n_members"] for row in outcome["rows"]]
    assert members == sorted(members)
    assert sum(row["case"] == "mbrl-lib" for row in outcome["rows"]) == 2
    assert outcome["settings"]["mbrl"] == {"mbrl": "0.2.0"}

    def refuse():
        raise _mbrl.InstallationError("refused")

    monkeypatch.setattr(_mbrl, "interpreter", refuse)
    monkeypatch.setattr(train_step, "measure", lambda *_, **__: pytest.fail("measured in vain"))
    with pytest.raises(_mbrl.InstallationError):
        train_step.run("quick", TINY[train_step], mbrl=True)


def test_relabel_extrapolates_what_it_ran_on_a_part(outcomes):
    part = {row["case"]: row["part"] for row in outcomes["relabel"]["rows"]}
    assert part["Python loop over pairs"] == pytest.approx(1 / 3)
    assert part["SubtrajectoryRelabeler"] == 1


def test_listing_and_loop_make_the_rows_that_the_relabeler_makes():
    ds = relabel._episodes(2, 6)
    exhaustive = relabel.SubtrajectoryRelabeler(max_rows=None).fit_resample(ds)
    want = np.column_stack(exhaustive)
    assert np.allclose(np.column_stack([np.array(part) for part in relabel._loop(ds)]), want)
    listed = np.column_stack(relabel._listing(ds, 10**6, np.random.default_rng(0)))
    order = [np.lexsort(np.round(rows, 9).T) for rows in (listed, want)]
    assert np.allclose(listed[order[0]], want[order[1]])


def test_predictor_cases_compute_the_same(monkeypatch):
    models = predict._Models(fit_steps=5, n_steps=10)
    by_name = {case.name: case.run for case in models.cases(3)}
    rows = by_name["T, Predictor on rows"]()
    assert np.allclose(by_name["T, Predictor on the product"](), rows, atol=1e-5)
    full = by_name["T, predict_trajectory"]()
    assert full.mean.shape == (3, 10, 4)
    few = by_name["T, every 10th horizon"]()
    assert np.allclose(few.mean, full.mean[:, 9:], atol=1e-9)
    assert by_name["one-step roll-out, 5 members"]().actions == "policy"


def test_planning_cases_decide_among_as_many_candidates():
    planners = plan._Planners(fit_steps=5, n_steps=20)
    cases = planners.cases(70)
    assert cases[0].name == "bare GEMM"
    plans = {case.name: case.run() for case in cases[1:]}
    assert {found.n_candidates for found in plans.values()} == {70}
    whole, part = plans["T over policies"], plans["T over policies, every 10th step"]
    assert whole.params.shape == (4,)
    assert part.value != whole.value
    assert plans["one-step over actions"].actions.shape == (20, 1)
    assert {case.goal for case in cases} == {""}
    assert [case.goal for case in planners.cases(1000)] == ["", "1.3x", "0.43x", "", "", ""]


def test_measure_interleaves_and_compares_within_a_round(monkeypatch):
    clock, order = iter(range(10**6)), []
    now = 0.0

    def spend(name, seconds):
        def run():
            nonlocal now
            order.append(name)
            now += seconds * (1 + next(clock) // 10)  # the machine slows down on the way

        return run

    monkeypatch.setattr(_timing.time, "process_time", lambda: now)
    cases = [
        _timing.Case("base", spend("base", 1.0)),
        _timing.Case("twice", spend("twice", 2.0)),
        _timing.Case("ten steps", spend("ten steps", 5.0), units=10, goal="1x"),
    ]
    rows = _timing.measure(cases, rounds=3, label="here")
    assert order[6:] == [
        *("base", "twice", "ten steps"),
        *("twice", "ten steps", "base"),
        *("ten steps", "base", "twice"),
    ]
    assert [row["ratio"] for row in rows[:2]] == [1.0, 2.0]
    assert rows[2]["ratio"] == pytest.approx(0.5, rel=0.6)
    assert [row["base"] for row in rows] == [True, False, False]
    assert rows[2]["goal"] == "1x"
    assert {row["label"] for row in rows} == {"here"}


def test_short_calls_are_repeated(monkeypatch):
    calls = []
    now = 0.0

    def run():
        nonlocal now
        calls.append(None)
        now += 0.01

    monkeypatch.setattr(_timing.time, "process_time", lambda: now)
    (row,) = _timing.measure([_timing.Case("short", run)], rounds=2, min_seconds=0.095)
    assert row["calls_a_round"] == 10
    assert len(calls) == 2 + 2 * 10
    assert row["seconds"] == pytest.approx(0.01)


def test_products_are_those_of_a_training_step(monkeypatch):
    shapes = []

    def product(a, b, out):
        shapes.append((*a.shape, b.shape[1]))
        assert out.shape == (a.shape[0], b.shape[1])

    monkeypatch.setattr(torch, "mm", product)
    _gemm.training_products((3, 5, 2), n_members=2, batch_size=7)()
    one = [(7, 3, 5), (3, 7, 5), (7, 5, 2), (5, 7, 2), (7, 2, 5)]
    assert shapes == 2 * one
    shapes.clear()
    _gemm.forward_products((3, 5, 2), n_rows=10, block=4)()
    assert sum(math.prod(shape) for shape in shapes) == 10 * (3 * 5 + 5 * 2)


def test_one_thread_inside_and_the_old_number_after():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with _command.one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_command_writes_where_it_is_told(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(relabel.EFFORT, "quick", TINY[relabel])
    relabel.main(["--quick", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "| SubtrajectoryRelabeler |" in printed
    assert (tmp_path / "quick.md").read_text() in printed
    assert json.loads((tmp_path / "quick.json").read_text())["mode"] == "quick"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["quick.json", "quick.md"]


@pytest.mark.parametrize("module", BENCHMARKS)
def test_help(module, capsys):
    with pytest.raises(SystemExit) as stop:
        module.main(["--help"])
    assert stop.value.code == 0
    assert "--quick" in capsys.readouterr().out


def test_durations_and_ratios_are_readable():
    assert [_command.duration(s) for s in (2.5, 0.0125, 99.97e-6)] == [
        "2.50 s",
        "12.5 ms",
        "100 us",
    ]
    assert [_command.times(r) for r in (1.0, 0.12345, 187.4)] == ["1.00x", "0.123x", "187x"]


def test_mbrl_pins_come_from_the_constraints():
    _, (mbrl, *pins), replaced = _mbrl._installation()
    constraints = (_mbrl.ROOT / "constraints.txt").read_text().splitlines()
    assert mbrl == "mbrl==0.2.0"
    assert len(pins) == 2
    assert set(pins) <= set(constraints)
    assert replaced == ["hydra-core==1.3.2", "omegaconf==2.3.0"]


def test_failed_installation_names_the_log(monkeypatch, tmp_path):
    monkeypatch.setattr(_mbrl, "ENVIRONMENT", tmp_path / "env")
    monkeypatch.setattr(_mbrl, "_installation", lambda: [["a name that pip refuses"]])
    made = []

    def run(command, **settings):
        made.append(command)
        if "venv" in command:
            (tmp_path / "env").mkdir()
            return None
        return original([sys.executable, "-c", "print('refused'); raise SystemExit(3)"], **settings)

    original = _mbrl.subprocess.run
    monkeypatch.setattr(_mbrl.subprocess, "run", run)
    with pytest.raises(_mbrl.InstallationError, match=r"exit status 3.*install\.log"):
        _mbrl.interpreter()
    assert "refused" in (tmp_path / "env" / "install.log").read_text()
    assert made[1][-1] == "a name that pip refuses"
    assert not (tmp_path / "env" / ".installed").exists()
