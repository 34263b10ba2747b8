import pickle

import numpy as np
import pytest
import sklearn
from hypothesis import given
from hypothesis import strategies as st
from sklearn.base import BaseEstimator, clone
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, KFold, cross_validate

from trajlearn import TrajectoryDataset, TrajectoryRegressor
from trajlearn.evaluation import (
    BlockKFold,
    cross_val_forecast,
    cross_validate_horizons,
    horizon_scorer,
)
from trajlearn.exceptions import MissingFieldError


def episodes(n, **fields):
    return TrajectoryDataset.from_arrays(np.zeros((n, 3, 1)), **fields)


def as_lists(splits):
    return [(train.tolist(), test.tolist()) for train, test in splits]


def in_order(labels):
    """Distinct labels in the order in which they first appear."""
    return list(dict.fromkeys(labels))


@given(data=st.data())
def test_folds_are_blocks_of_groups_in_order(data):
    n_splits = data.draw(st.integers(2, 5))
    labels = data.draw(st.lists(st.integers(0, 9), min_size=1, max_size=40))
    labels += list(range(20, 20 + n_splits))  # never too few
    gap = data.draw(st.integers(0, 2)) if len(set(labels)) > 3 * n_splits else 0
    groups = in_order(labels)
    folds = list(BlockKFold(n_splits, gap=gap).split(np.zeros((len(labels), 1)), groups=labels))
    tested = [in_order(labels[i] for i in test) for _, test in folds]
    assert [g for fold in tested for g in fold] == groups  # blocks, one after another
    sizes = [len(fold) for fold in tested]
    assert max(sizes) - min(sizes) <= 1
    for (train, test), own in zip(folds, tested, strict=True):
        low, high = groups.index(own[0]), groups.index(own[-1])
        for i, label in enumerate(labels):
            assert (i in test) == (low <= groups.index(label) <= high)
            assert (i in train) == (not low - gap <= groups.index(label) <= high + gap)


def test_without_groups_it_is_k_fold_in_order():
    X = np.zeros((11, 2))
    assert as_lists(BlockKFold(3).split(X)) == as_lists(KFold(3).split(X))


def test_the_group_of_the_dataset_is_the_default_and_explicit_ones_win():
    ds = episodes(6, group=list("aabbcc"))
    assert [test for _, test in as_lists(BlockKFold(3).split(ds))] == [[0, 1], [2, 3], [4, 5]]
    assert as_lists(BlockKFold(3).split(list(ds))) == as_lists(BlockKFold(3).split(ds))
    other = BlockKFold(2).split(ds, groups=[1, 0, 0, 0, 0, 0])
    assert [test for _, test in as_lists(other)] == [[0], [1, 2, 3, 4, 5]]


def test_a_group_that_returns_later_belongs_to_its_first_block():
    splits = BlockKFold(2).split(np.zeros(6), groups=list("zzaabz"))
    # z, a come first, then b
    assert as_lists(splits) == [([4], [0, 1, 2, 3, 5]), ([0, 1, 2, 3, 5], [4])]


@pytest.mark.parametrize("names", ["kind", ("kind", "motors")])
def test_blocks_are_cut_inside_each_stratum(names):
    kind, motors = list("xyxyxxyyxxyy"), ["old"] * 6 + ["new"] * 6
    ds = episodes(12, context={"kind": kind, "motors": motors})
    keys = [k if names == "kind" else (k, m) for k, m in zip(kind, motors)]
    folds = list(BlockKFold(2, within=names).split(ds))
    assert sorted(np.concatenate([test for _, test in folds])) == list(range(12))
    for key in set(keys):
        members = [i for i, other in enumerate(keys) if other == key]
        parts = [[i for i in members if i in test] for _, test in folds]
        assert [i for part in parts for i in part] == members
        assert abs(len(parts[0]) - len(parts[1])) <= 1


def test_what_is_left_over_goes_to_the_smallest_folds():
    # three strata of four groups in three folds: one group left over in each
    ds = episodes(12, context={"kind": list("aaaabbbbcccc")})
    sizes = [len(test) for _, test in BlockKFold(3, within="kind").split(ds)]
    assert sizes == [4, 4, 4]


def test_a_gap_is_left_inside_each_stratum():
    ds = episodes(8, context={"kind": list("abababab")})
    train, test = next(BlockKFold(4, within="kind", gap=1).split(ds))
    assert test.tolist() == [0, 1]
    assert train.tolist() == [4, 5, 6, 7]


def test_a_group_of_several_kinds_is_never_parted():
    ds = episodes(9, group=[0, 1, 2, 2, 2, 3, 4, 5, 6], context={"kind": list("aaabbbbba")})
    for train, test in BlockKFold(2, within="kind").split(ds):
        assert not set(ds.group[train]) & set(ds.group[test])
        assert len(train) + len(test) == 9


def test_scikit_learn_and_our_cross_validation_take_it(decays):
    cv, model = BlockKFold(3), TrajectoryRegressor(LinearRegression(), random_state=0)
    assert cross_validate_horizons(model, decays, [1, 20], cv=cv)["n_episodes"].tolist() == [4] * 6
    assert len(cross_val_forecast(model, decays, cv)) == 12
    search = GridSearchCV(
        model,
        {"estimator__fit_intercept": [True, False]},
        scoring=horizon_scorer(20),
        cv=BlockKFold(3),
        error_score="raise",
    )
    assert clone(search).fit(decays).n_splits_ == 3
    assert pickle.loads(pickle.dumps(cv)).get_n_splits() == 3
    assert repr(BlockKFold(3, within="kind")) == "BlockKFold(gap=0, n_splits=3, within='kind')"


def test_groups_are_routed_without_a_request():
    seen = []

    class Constant(BaseEstimator):
        def fit(self, X, y=None):
            seen.append(X[:, 0].tolist())
            return self

        def score(self, X, y=None):
            return 0.0

    X = np.arange(4.0)[:, None]
    with sklearn.config_context(enable_metadata_routing=True):
        cross_validate(Constant(), X, cv=BlockKFold(2), params={"groups": list("abbb")})
    assert seen == [[1, 2, 3], [0]]


@pytest.mark.parametrize(
    ("settings", "groups", "message"),
    [
        ({"n_splits": 1}, None, "n_splits = 1 must be a whole number, at least 2"),
        ({"n_splits": 2.0}, None, r"n_splits = 2\.0 must be"),
        ({"n_splits": True}, None, "n_splits = True"),
        ({"gap": -1}, None, "gap = -1 must be a whole number, at least 0"),
        ({"n_splits": 4}, list("aabbcc"), "n_splits = 4, but there are only 3 groups: take fewer"),
        ({"n_splits": 2}, [1, 2], r"groups has shape \(2,\).*\(6,\)"),
        ({"n_splits": 2, "gap": 3}, None, "gap = 3 leaves no group to train on in fold 0"),
        (
            {"n_splits": 3, "within": ("kind", "motors")},
            None,
            "only 2 groups where kind = 'x', motors = 'old'.*or leave such episodes out",
        ),
        ({"n_splits": 2, "within": "task"}, None, r"\['task'\].*\['kind', 'motors'\]"),
    ],
)
def test_bad_arguments_are_refused(settings, groups, message):
    ds = episodes(6, context={"kind": list("xxyyyy"), "motors": ["old"] * 6})
    with pytest.raises(ValueError, match=message):
        list(BlockKFold(**settings).split(ds, groups=groups))


def test_strata_need_episodes():
    with pytest.raises(MissingFieldError, match=r"names context of a TrajectoryDataset.*ndarray"):
        list(BlockKFold(2, within="kind").split(np.zeros((6, 1))))
