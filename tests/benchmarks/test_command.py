"""What every command of the paper's folder does: options, files, redrawing."""

import ast
import json
import runpy
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _command
from benchmarks.paper._command import Benchmark, markdown, read_tables

MODULES = sorted(Path(_command.__file__).parent.glob("[a-z]*.py"))
WITH_BENCHMARK = [path for path in MODULES if "\nBENCHMARK = " in path.read_text(encoding="utf-8")]


def cell(seed, mode, log):
    with open(log, "a") as file:
        file.write(f"{seed}\n")
    return {"horizon": [1, 2, 3], "error": [0.1 + seed, 1 / 3, float("inf")]}


@pytest.fixture
def log(tmp_path):
    return tmp_path / "log"


@pytest.fixture
def benchmark(log, tmp_path, monkeypatch):
    """A made-up benchmark whose cells leave a trace in a log, and a folder to run it in."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_command, "RESULTS", tmp_path / "committed")

    def run(run, shared=None):
        cells = [{"seed": seed, "mode": run.mode, "log": str(log)} for seed in run.seeds]
        results = run.cells(cells, cell, shared=shared)
        table = pd.concat([pd.DataFrame(result) for result in results], ignore_index=True)
        # what a table cannot hold to the last digit tells the stored one from the fresh one
        table["third"] = 1 / 3
        summary = table.groupby("horizon")[["error"]].median().reset_index()
        return {"errors": table, "summary": summary}

    def draw(tables):
        import matplotlib.pyplot as plt

        figure, ax = plt.subplots()
        ax.plot(tables["errors"]["horizon"], tables["errors"]["error"], "o-", clip_on=True)
        ax.fill_between([1, 2], [0, 0], [1, 1], hatch="//")
        ax.set_xlabel("horizon (steps)")
        return {"tiny-errors": figure}

    def report(tables):
        third = tables["errors"]["third"].iloc[0]
        return f"### Errors, {third}\n\n{markdown(tables['summary'])}\n\n"

    def settings(mode):
        return {"steps": {"full": 9, "quick": 2}[mode]}

    made = Benchmark("tiny", "A made-up one.", run, report, draw, settings, minutes=7, seeds=2)
    return made


SERIAL = ["--n-jobs", "1"]
FILES = {"tiny.json", "tiny.md", "errors.csv", "summary.csv", "tiny-errors.png", "tiny-errors.svg"}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_full_run_stores_tables_text_figures_and_provenance(benchmark, tmp_path, capsys):
    benchmark.main(SERIAL)
    folder = tmp_path / "committed" / "tiny"
    assert set(contents(folder)) == FILES
    facts = json.loads((folder / "tiny.json").read_text())
    assert facts["mode"] == "full"
    assert facts["seeds"] == [0, 1]
    assert facts["settings"] == {"steps": 9}
    assert facts["tables"] == ["errors", "summary"]
    assert {"packages", "python", "commit"} <= set(facts)
    errors = pd.read_csv(folder / "errors.csv")
    np.testing.assert_allclose(errors["error"], [0.1, 0.33333, np.inf, 1.1, 0.33333, np.inf])
    text = (folder / "tiny.md").read_text()
    lines = ["| horizon | error |", "|---|---|", "| 1 | 0.6 |", "| 2 | 0.33 |", "| 3 | inf |"]
    assert text == "### Errors, 0.33333\n\n" + "\n".join(lines) + "\n"
    printed = capsys.readouterr().out
    assert text in printed
    assert f"Written to {folder}." in printed
    assert "quick" not in printed
    assert (folder / "tiny-errors.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (folder / "tiny-errors.svg").read_bytes()


def test_no_figure_stays_open(benchmark):
    import matplotlib.pyplot as plt

    benchmark.main([*SERIAL, "--quick"])
    assert plt.get_fignums() == []


def test_redrawing_gives_the_same_bytes_and_runs_nothing(benchmark, log, tmp_path):
    benchmark.main(SERIAL)
    folder = tmp_path / "committed" / "tiny"
    before, ran = contents(folder), log.read_text()
    assert b"<dc:date>" not in before["tiny-errors.svg"]
    for name in ("tiny.md", "tiny-errors.png", "tiny-errors.svg"):
        (folder / name).unlink()
    benchmark.main(["--redraw"])
    assert contents(folder) == before
    assert log.read_text() == ran


def test_redrawing_shows_what_the_tables_say(benchmark, tmp_path):
    benchmark.main(SERIAL)
    folder = tmp_path / "committed" / "tiny"
    before = contents(folder)
    pd.DataFrame({"horizon": [8], "error": [0.25]}).to_csv(folder / "summary.csv", index=False)
    errors = pd.DataFrame({"horizon": [8, 9], "error": [1, 2], "third": 7})
    errors.to_csv(folder / "errors.csv", index=False)
    benchmark.main(["--redraw"])
    after = contents(folder)
    assert after["tiny.md"].startswith(b"### Errors, 7\n")
    assert b"| 8 | 0.25 |" in after["tiny.md"]
    assert after["tiny-errors.png"] != before["tiny-errors.png"]
    assert after["tiny-errors.svg"] != before["tiny-errors.svg"]


def test_redrawing_without_results_says_so(benchmark, log, tmp_path):
    with pytest.raises(SystemExit, match=r"no results in .*committed/tiny .*without --redraw"):
        benchmark.main(["--redraw"])
    benchmark.main(SERIAL)
    (tmp_path / "committed" / "tiny" / "summary.csv").unlink()
    with pytest.raises(SystemExit, match=r"summary\.csv is missing.*without --redraw"):
        benchmark.main(["--redraw"])


def test_quick_goes_to_results_here_and_says_that_it_was_quick(benchmark, tmp_path, capsys):
    benchmark.main([*SERIAL, "--quick"])
    folder = tmp_path / "results" / "tiny"
    assert set(contents(folder)) == FILES
    assert not (tmp_path / "committed").exists()
    facts = json.loads((folder / "tiny.json").read_text())
    assert (facts["mode"], facts["seeds"], facts["settings"]) == ("quick", [0], {"steps": 2})
    printed = capsys.readouterr().out
    assert "quick mode" in printed
    assert "7 minutes" in printed
    assert "trajlearn reproduce tiny" in printed


@pytest.mark.parametrize("below", ["", "deeper"])
def test_quick_never_goes_where_the_documentation_quotes(benchmark, log, tmp_path, capsys, below):
    with pytest.raises(SystemExit) as caught:
        benchmark.main([*SERIAL, "--quick", "--out", str(tmp_path / "committed" / below)])
    assert caught.value.code == 2
    assert "choose another folder with --out" in capsys.readouterr().err
    assert not (tmp_path / "committed").exists()
    assert not log.exists()


def test_the_committed_results_are_those_of_this_checkout():
    assert Path(_command.__file__).parent / "results" == _command.RESULTS


def test_a_second_run_repeats_no_cell_and_fresh_repeats_all(benchmark, log, tmp_path):
    benchmark.main([*SERIAL, "--out", str(tmp_path / "out")])
    first = contents(tmp_path / "out" / "tiny")
    benchmark.main([*SERIAL, "--out", str(tmp_path / "out")])
    assert log.read_text().split() == ["0", "1"]
    benchmark.main([*SERIAL, "--out", str(tmp_path / "out"), "--fresh"])
    assert log.read_text().split() == ["0", "1", "0", "1"]
    assert contents(tmp_path / "out" / "tiny") == first


def test_more_seeds_repeat_no_cell(benchmark, log):
    benchmark.main([*SERIAL, "--seeds", "1"])
    benchmark.main([*SERIAL, "--seeds", "3"])
    assert log.read_text().split() == ["0", "1", "2"]


def test_quick_and_full_cells_do_not_mix(benchmark, log, tmp_path):
    out = ["--out", str(tmp_path / "out")]
    benchmark.main([*SERIAL, *out, "--seeds", "1"])
    benchmark.main([*SERIAL, *out, "--quick"])
    assert log.read_text().split() == ["0", "0"]
    assert {path.name for path in (tmp_path / "out/tiny/cells").iterdir()} == {"full", "quick"}


def test_benchmarks_share_cells_and_fresh_forgets_those_too(benchmark, log, tmp_path):
    def shared(run):
        return benchmark.run(run, shared="fits")

    one, other = (replace(benchmark, name=name, run=shared) for name in ("one", "other"))
    one.main(SERIAL)
    other.main(SERIAL)
    assert log.read_text().split() == ["0", "1"]
    assert len(list((tmp_path / "committed/fits/cells/full").iterdir())) == 2
    other.main([*SERIAL, "--fresh"])
    assert log.read_text().split() == ["0", "1", "0", "1"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--seeds", "0"], "must be at least 1"),
        (["--local-workers", "0"], "must be at least 1"),
        (["--local-workers", "2", "--scheduler", "tcp://node:8786"], "not allowed with"),
        (["--wrong"], "unrecognized arguments"),
    ],
)
def test_wrong_options_are_refused(benchmark, log, capsys, arguments, complaint):
    with pytest.raises(SystemExit) as caught:
        benchmark.main(arguments)
    assert caught.value.code == 2
    assert complaint in capsys.readouterr().err
    assert not log.exists()


@pytest.mark.parametrize(
    ("arguments", "sent"),
    [
        ([], {"scheduler": None, "local_workers": None}),
        (["--local-workers", "3"], {"scheduler": None, "local_workers": 3}),
        (["--scheduler", "tcp://node:1"], {"scheduler": "tcp://node:1", "local_workers": None}),
    ],
)
def test_options_say_where_the_cells_run(benchmark, monkeypatch, arguments, sent):
    asked = {}

    def run_cells(cells, function, folder, **options):
        asked.update(options)
        return [{"horizon": [1], "error": [1.0]} for _ in cells]

    monkeypatch.setattr(_command, "run_cells", run_cells)
    benchmark.main(["--n-jobs", "5", *arguments])
    assert asked == sent | {"n_jobs": 5, "description": "tiny", "fresh": False}


def test_tables_come_back_as_they_were_written(benchmark, tmp_path):
    benchmark.main(SERIAL)
    tables = read_tables(tmp_path / "committed" / "tiny", "tiny")
    assert list(tables) == ["errors", "summary"]
    assert tables["errors"]["horizon"].tolist() == [1, 2, 3, 1, 2, 3]
    assert tables["errors"]["error"].iloc[2] == np.inf


def test_markdown_rounds_and_leaves_missing_entries_blank():
    table = pd.DataFrame({"model": ["D", "T"], "error": [0.01234, np.nan], "n": [1, 20]})
    text = "| model | error | n |\n|---|---|---|\n| D | 0.012 | 1 |\n| T |  | 20 |"
    assert markdown(table) == text


# that another test has imported the module
@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_help_of_every_benchmark(path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [path.stem, "--help"])
    with pytest.raises(SystemExit) as caught:
        runpy.run_module(f"benchmarks.paper.{path.stem}", run_name="__main__")
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    assert "--quick" in printed
    # as the list of benchmarks shows it
    summary = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))).partition("\n")[0]
    assert summary.endswith((".", "?"))
    assert " ".join(summary.split()) in " ".join(printed.split())


@pytest.mark.parametrize("path", WITH_BENCHMARK, ids=lambda path: path.stem)
def test_a_benchmark_is_called_as_its_file(path):
    benchmark = import_module(f"benchmarks.paper.{path.stem}").BENCHMARK
    assert benchmark.name == path.stem.replace("_", "-")
    assert benchmark.seeds >= 3
    assert benchmark.minutes > 0
    json.dumps([benchmark.settings(mode) for mode in ("full", "quick")])
