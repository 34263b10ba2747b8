"""The audit page says what the committed results say, and nothing else."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks._results import write_csv
from benchmarks.paper import _audit_page, audit
from benchmarks.paper._claims import Claim, Comparison, from_tables, to_tables
from benchmarks.paper._command import RESULTS, read_tables

STORED = RESULTS / "audit"
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def stored():
    return read_tables(STORED, "audit")


def test_the_page_is_made_from_the_committed_tables(stored):
    assert audit.DOCS.read_text(encoding="utf-8") == _audit_page.page(stored)


def test_it_rests_on_full_runs_of_three_seeds(stored):
    sources = stored["sources"]
    assert {name.partition(",")[0] for name in sources["benchmark"]} == set(audit.SOURCES)
    assert set(sources["mode"]) == {"full"}
    assert sources["seeds"].min() >= 3
    assert all(stored[name]["seed"].nunique() >= 3 for name in ("rewards", "late", "planning"))


@pytest.fixture(scope="module")
def sources():
    return audit.stored(RESULTS)


def test_the_committed_results_still_lead_to_these_comparisons(stored, sources, tmp_path):
    judged = to_tables(audit.claims(sources | {"audit": stored}))
    for name, table in judged.items():
        write_csv(tmp_path / f"{name}.csv", table)
        assert (tmp_path / f"{name}.csv").read_bytes() == (STORED / f"{name}.csv").read_bytes()


def test_a_comparison_is_that_of_the_raw_lines(stored, sources):
    def medians(table, column, **chosen):
        for name, value in chosen.items():
            table = table[table[name] == value]
        return [np.median(some[column]) for _, some in table.groupby("seed")]

    def found(claim, condition, what):
        [one] = [
            one
            for some in from_tables(stored)
            for one in some.comparisons
            if (some.title, one.condition, one.what) == (claim, condition, what)
        ]
        return one

    episodes = sources["horizon-error"]["episodes"]
    episodes = episodes[episodes["task"] == "reacher"]
    d, t = (medians(episodes, "long", model=name, actions=how)
            for name, how in (("D", "logged"), ("T", "none")))  # fmt: skip
    one = found(
        "Trajectory models are more accurate far ahead",
        "reacher, paper's settings, logged actions",
        "D / T",
    )
    assert one.estimate == pytest.approx(np.median(d) / np.median(t), rel=1e-3)
    assert one.seeds == pytest.approx(np.divide(d, t), rel=1e-3)
    # for the claim that T is worse at first, the same the other way round
    d, t = (medians(episodes, "short", model=name, actions=how)
            for name, how in (("D", "logged"), ("T", "none")))  # fmt: skip
    one = found(
        "Trajectory models are less accurate at short horizons",
        "reacher, paper's settings, logged actions",
        "T / D",
    )
    assert one.estimate == pytest.approx(np.median(t) / np.median(d), rel=1e-3)
    rewards = sources["reward-table"]["cartpole"]
    gp, t = (medians(rewards, "mean", settings="tuned", row=row) for row in ("GP", "T"))
    one = found(
        "Trajectory models predict the reward of an episode best",
        "cartpole, tuned on training episodes, against GP",
        "mean squared error of the reward, over that of T",
    )
    assert one.seeds == pytest.approx(np.divide(gp, t), rel=1e-3)


def test_the_pictures_of_the_page_are_there():
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", audit.DOCS.read_text(encoding="utf-8"))
    assert pictures
    assert [name for name in pictures if not (audit.DOCS.parent / name).is_file()] == []


def test_every_claim_was_measured(stored):
    assert [one.title for one in from_tables(stored) if not one.comparisons] == []


def comparison(estimate, condition):
    ends = estimate / 1.1, estimate * 1.1
    return Comparison(condition, "one-step / T", estimate, *ends, ends)


def test_a_section_names_the_conditions_and_their_opposites():
    claim = Claim("T wins", "always", [comparison(3, "logged"), comparison(0.2, "recomputed")])
    text = "\n".join(_audit_page._section(1, claim))
    assert "**holds only if**" in text
    assert "It holds for: logged." in text
    assert "The opposite holds for: recomputed." in text
    assert "| recomputed | one-step / T | 0.2 | 0.18 to 0.22 |" in text


def test_the_reward_table_takes_the_defects_away_one_by_one():
    lines = [
        {"task": "reacher", "method": method, "scored_on": on, "actions": actions, "seed": seed}
        | {"error": error, "all_pairs": 10 * error, "variance": 1.0}
        for seed in range(3)
        for method, actions, on, error in (
            ("GP", "none", "train", 1.0),
            ("GP", "none", "test", 2.0),
            ("D late weak", "policy", "train", 3.0),
            ("D late", "policy", "train", 4.0),
            ("D late", "policy", "test", 5.0),
            ("D", "policy", "test", 6.0),
        )
    ]
    table = _audit_page.reward_table(pd.DataFrame(lines)).set_index(["task", "method"])
    columns = ["with its defects", "proper difference", "right gains", "fresh episodes"]
    columns.append("actions aligned")

    def numbers(method):
        entries = table.loc[("reacher", method), columns]
        return [float(entry.split()[0]) if entry else None for entry in entries]

    assert numbers("GP") == [10, 1, None, 2, None]
    assert numbers("D, recomputed actions") == [3, None, 4, 5, 6]


def test_rewards_and_medians_of_cells_become_lines():
    asked = {"task": "cartpole", "method": "D", "mode": "quick", "seed": 1}
    result = {"test, logged": {"truth": [0.0, 2.0], "estimate": [1.0, "inf"]}}
    result["train, logged"] = {"truth": [0.0, 2.0], "estimate": [1.0, 1.0]}
    table = audit._rewards([(asked, result)])
    assert table["error"].tolist() == [np.inf, 1.0]
    assert table["variance"].tolist() == [1.0, 1.0]
    assert table["scored_on"].tolist() == ["test", "train"]
    medians = audit._medians([(asked, {"logged": {"long": [1.0, 5.0, np.inf]}})])
    assert medians[["actions", "seed", "long"]].values.tolist() == [["logged", 1, 5.0]]


def test_claims_stay_the_same_through_the_stored_tables(stored):
    claims = from_tables(stored)
    again = to_tables(claims)["comparisons"]
    pd.testing.assert_frame_equal(again, stored["comparisons"], check_dtype=False)
