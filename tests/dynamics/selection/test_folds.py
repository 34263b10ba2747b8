"""Folds of a selector: whole episodes, each held out once, and never by what was fitted on it."""

import numpy as np
import pytest

from tests.dynamics.crossing import decays
from trajlearn.dynamics._selection.folds import held_out_folds, units_of


def folds_of(ds, cv):
    return held_out_folds(ds, cv, np.random.default_rng(0))


def test_units_are_groups_or_episodes():
    assert units_of(decays(3)).tolist() == [0, 1, 2]
    assert units_of(decays(4, group=["b", "a", "b", "c"])).tolist() == [1, 0, 1, 2]


def test_masks_are_as_good_as_indices():
    ds, first = decays(6), np.arange(6) < 2
    ((train, test),) = folds_of(ds, [(~first, first)])
    assert train.tolist() == [2, 3, 4, 5]
    assert test.tolist() == [0, 1]


def test_a_fold_that_holds_out_what_it_trains_on_is_refused():
    good = (np.arange(3, 6), np.arange(3))
    with pytest.raises(ValueError, match=r"fold 1 of cv trains on episodes .* number 4"):
        folds_of(decays(6), [good, (np.arange(5), np.arange(4, 6))])


@pytest.mark.parametrize("cv", [[], [([0, 1], [])], [([], [0, 1])]], ids=["none", "test", "train"])
def test_empty_folds_are_refused(cv):
    with pytest.raises(ValueError, match="no fold, or an empty one"):
        folds_of(decays(6), cv)
