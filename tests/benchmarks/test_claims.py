"""Verdicts follow from comparisons, and comparisons can fail."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper._claims import (
    Claim,
    Comparison,
    compare,
    compare_seeds,
    from_tables,
    number,
    to_tables,
)


def ratio(estimate, low, high, seeds=(), condition="here", same=False):
    return Comparison(condition, "a / b", estimate, low, high, tuple(seeds), same)


@pytest.mark.parametrize(
    ("comparison", "expected"),
    [
        (ratio(2, 1.5, 3, [1.2, 4]), "for"),
        (ratio(2, 1.5, 3, [0.9, 4]), "open"),  # one seed disagrees
        (ratio(2, 0.9, 3, [1.5, 4]), "open"),  # the interval takes in 1
        (ratio(0.5, 0.3, 0.7, [0.4, 0.6]), "against"),
        (ratio(np.inf, 5, np.inf, [3, np.inf]), "for"),
        (ratio(2, np.nan, np.nan, [1.5, 3]), "for"),  # known by seed only
        (ratio(np.nan, np.nan, np.nan, [np.nan]), "open"),
        (ratio(2, 1.5, 3, [2, np.nan, 2]), "open"),
        (ratio(1.1, 0.9, 1.2, [1, 1.3], same=True), "for"),
        (ratio(1.1, 0.9, 1.6, [1, 1.3], same=True), "open"),
        (ratio(3, 2, 4, [2.5, 3.5], same=True), "against"),
    ],
)
def test_a_comparison_speaks_only_if_interval_and_seeds_agree(comparison, expected):
    assert comparison.verdict == expected


def test_a_claim_holds_where_all_its_comparisons_do():
    good, bad = ratio(2, 1.5, 3), ratio(0.5, 0.3, 0.7, condition="there")
    unsure = ratio(1, 0.5, 2, condition="here")
    assert Claim("c", "s", [good]).verdict == "holds"
    assert Claim("c", "s", [bad, unsure]).verdict == "fails"
    mixed = Claim("c", "s", [good, bad])
    assert mixed.verdict == "holds only if"
    assert mixed.conditions("for") == ["here"]
    assert mixed.conditions("against") == ["there"]
    # a condition counts only if everything measured under it agrees
    assert Claim("c", "s", [good, unsure, bad]).conditions("for") == []
    assert Claim("c", "s", [good, unsure, bad]).verdict == "fails"
    assert Claim("c", "s", [unsure]).verdict == "open"
    assert Claim("c", "s", []).verdict == "not measured"
    assert mixed.mixed() == []
    assert Claim("c", "s", [good, unsure, bad]).mixed() == ["here"]
    assert [mixed.effect(verdict) for verdict in ("for", "against", "open")] == [
        "1 (2)",
        "1 (0.5)",
        "0",
    ]
    assert Claim("c", "s", [good, ratio(4, 3, 5)]).effect("for") == "2 (2 to 4)"


def table(factor=1.0):
    rng = np.random.default_rng(0)
    errors = rng.lognormal(size=(3, 200))
    return pd.DataFrame(
        [
            {"model": model, "seed": seed, "episode": i, "long": value * times}
            for model, times in (("D", factor), ("T", 1.0))
            for seed, row in enumerate(errors)
            for i, value in enumerate(row)
        ]
    )


def test_compare_finds_a_known_ratio():
    found = compare(table(3.0), {"model": "D"}, {"model": "T"}, "long", condition="x", what="D / T")
    assert found.estimate == pytest.approx(3.0)
    assert found.seeds == pytest.approx((3.0, 3.0, 3.0))
    assert found.low == pytest.approx(3.0)
    assert found.verdict == "for"


def test_compare_says_what_is_missing():
    with pytest.raises(ValueError, match=r"no lines with .*LSTM"):
        compare(table(), {"model": "LSTM"}, {"model": "T"}, "long", condition="x", what="y")


def test_seeds_alone_are_compared_with_infinities():
    found = compare_seeds([2.0, np.inf, 3.0], [1.0, 1.0, 1.0], condition="x", what="y")
    assert (found.estimate, found.verdict) == (3.0, "for")
    assert np.isnan(found.low)
    with pytest.raises(ValueError, match="no seed"):
        compare_seeds([], [], condition="x", what="y")


def test_claims_come_back_from_their_tables(tmp_path):
    claims = [
        Claim(
            "first", "says so", [ratio(2, 1, np.inf, [1.5, np.inf]), ratio(1, 1, 1, [1], same=True)]
        ),
        Claim(
            "second", "says that", [ratio(0.5, np.nan, np.nan, [0.5])], ["a note", "two"], "f.png"
        ),
        Claim("third", "never measured", []),
    ]
    tables = {}
    for name, some in to_tables(claims).items():
        some.to_csv(tmp_path / f"{name}.csv", index=False)
        tables[name] = pd.read_csv(tmp_path / f"{name}.csv")
    again = from_tables(tables)
    assert [one.title for one in again] == ["first", "second", "third"]
    assert [one.verdict for one in again] == [one.verdict for one in claims]
    assert again[0].comparisons[0] == claims[0].comparisons[0]
    assert again[0].comparisons[1].same
    assert (list(again[1].notes), again[1].figure) == (["a note", "two"], "f.png")


def test_numbers_keep_two_digits():
    assert [number(x) for x in (1.234, np.inf, np.nan, 12345.0)] == ["1.2", "∞", "?", "1.2e+04"]
