"""Many episodes: validation, indexing, equality, pickles, and scikit-learn's model selection."""

import copy
import pickle

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn import config_context
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    KFold,
    LeaveOneGroupOut,
    StratifiedKFold,
    cross_val_predict,
    cross_val_score,
    cross_validate,
    learning_curve,
    train_test_split,
)
from sklearn.pipeline import make_pipeline

from trajlearn.exceptions import InvalidEpisodeError, MissingFieldError
from trajlearn.trajectories import Trajectory, TrajectoryDataset, as_dataset, is_episodes

SEEDS = st.integers(0, 2**32 - 1)
from_arrays = TrajectoryDataset.from_arrays


def ragged(lengths=(4, 8, 2), **fields):
    rng = np.random.default_rng(0)
    return from_arrays([rng.normal(size=(steps + 1, 2)) for steps in lengths], **fields)


# -- construction -----------------------------------------------------------------------------


def test_equal_lengths_come_as_blocks():
    rng = np.random.default_rng(0)
    ds = from_arrays(
        rng.normal(size=(3, 5, 2)),
        actions=rng.normal(size=(3, 4, 1)),
        rewards=rng.normal(size=(3, 4)),
        params=rng.normal(size=(3, 2)),
        dt=0.1,
    )
    assert repr(ds) == "TrajectoryDataset(n=3, steps=4, d_s=2, d_a=1, p=2)"
    assert ds.shape == (len(ds),) == (3,)
    np.testing.assert_allclose(ds.times[:5], np.arange(5) * 0.1)
    assert ds.state_names == ("s0", "s1")
    assert ds.param_names == ("theta0", "theta1")


def test_every_field_may_be_ragged():
    lengths = [4, 8]
    ds = from_arrays(
        [np.full((t + 1, 2), t) for t in lengths],
        actions=[np.full((t, 1), t) for t in lengths],
        rewards=[np.full(t, t) for t in lengths],
        references=[np.full((t + 1, 1), t) for t in lengths],
        times=[np.arange(t + 1) * t for t in lengths],
        params=[np.arange(t)[:, None] for t in lengths],
    )
    assert repr(ds) == "TrajectoryDataset(n=2, steps=4..8, d_s=2, d_a=1, p=1, d_r=1, params vary)"
    for i, steps in enumerate(lengths):
        episode = ds[i]
        assert episode.length == steps
        for field in ("states", "actions", "rewards", "references"):
            assert (getattr(episode, field) == steps).all()
        np.testing.assert_array_equal(episode.params[:, 0], np.arange(steps))


def test_pandas_labels_are_read_by_position_not_by_label():
    ds = ragged(
        (3, 3),
        group=pd.Series(["a", "b"], index=[7, 5]),
        params=pd.DataFrame({"kp": [1.0, 2.0]}, index=[1, 0]),
        terminated=pd.Series([True, False], index=[1, 0]),
    )
    assert ds.group.tolist() == ["a", "b"]
    assert ds.params[:, 0].tolist() == [1.0, 2.0]
    assert ds.terminated.tolist() == [True, False]


@given(seed=SEEDS)
def test_a_list_of_the_episodes_makes_the_same_dataset(make_dataset, seed):
    ds = make_dataset(seed)
    assert TrajectoryDataset(list(ds), **ds.names) == ds
    assert TrajectoryDataset.from_list(iter(ds), **ds.names) == ds


def test_ids_are_kept_if_they_tell_episodes_apart_else_numbered():
    episodes = [Trajectory(np.zeros((3, 1)), id=name) for name in ("a", "b")]
    assert TrajectoryDataset(episodes).ids.tolist() == ["a", "b"]
    assert TrajectoryDataset([episodes[0], episodes[0]]).ids.tolist() == [0, 1]


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_other_number_types_become_float64(dtype):
    values = np.arange(30).reshape(3, 5, 2).astype(dtype)
    ds = from_arrays(values, actions=values[:, :4], rewards=values[:, :4, 0], params=values[:, 0])
    for field in ("states", "actions", "rewards", "params", "times"):
        assert getattr(ds, field).dtype == np.float64
    np.testing.assert_array_equal(ds.states, values.reshape(15, 2))


def test_p_zero_is_a_dataset_without_params():
    ds = ragged(params=np.empty((3, 0)))
    assert not ds.has_params
    assert ds.params is ds.step_params is None
    assert ds.params_at().shape == (3, 0)
    assert ds.param_names == ()


# -- theta that changes -----------------------------------------------------------------------


def test_varying_params_by_step_and_at_a_start():
    first, second = np.array([[1.0], [1.0], [2.0]]), np.full((2, 1), 5.0)
    ds = ragged((3, 2), params=[first, second])
    assert ds.params_vary
    np.testing.assert_array_equal(ds.step_params[:, 0], [1, 1, 2, 5, 5])
    assert ds.params_at()[:, 0].tolist() == [1.0, 5.0]
    assert ds.params_at(2)[:, 0].tolist() == [2.0, 5.0]
    assert ds.params_at([1, 2])[:, 0].tolist() == [1.0, 5.0]
    # At the last state the last theta is still in force.
    assert ds.params_at([3, 2])[:, 0].tolist() == [2.0, 5.0]
    with pytest.raises(ValueError, match=r"ds\.step_params"):
        ds.params  # noqa: B018
    with pytest.raises(IndexError, match=r"start -1 is outside episode 0"):
        ds.params_at(-1)
    with pytest.raises(IndexError, match=r"start 3 is outside episode 1, whose states are 0\.\.2"):
        ds.params_at(3)


def test_params_that_do_not_change_inside_episodes_collapse():
    by_step = [np.full((3, 2), 1.0), np.full((2, 2), 2.0)]
    assert ragged((3, 2), params=by_step) == ragged((3, 2), params=[[1.0, 1.0], [2.0, 2.0]])


def test_choosing_episodes_of_constant_theta_collapses_too():
    ds = ragged((3, 2), params=[[[1.0], [1.0], [2.0]], [[5.0], [5.0]]])
    assert ds[[1]].params.tolist() == [[5.0]]
    assert ds[[0]].params_vary
    np.testing.assert_array_equal(
        ragged((3, 2), params=[[1.0], [2.0]]).step_params[:, 0], [1, 1, 1, 2, 2]
    )


# -- bad input --------------------------------------------------------------------------------

GOOD = [np.zeros((4, 2)), np.zeros((3, 2)), np.zeros((5, 2))]


def with_bad(value, position=1):
    states = [item.copy() for item in GOOD]
    states[position] = value
    return states


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"states": [], "ids": None}, "dataset is empty"),
        ({"states": None}, "states is None"),
        ({"states": 3.0}, "states is 3.0"),
        ({"states": np.zeros((4, 2)), "ids": None}, r"states has shape \(2,\)"),
        ({"states": with_bad(np.zeros((1, 2)))}, "episode fly: states has 1 row"),
        ({"states": with_bad(np.zeros((3, 3)))}, "episode fly: states has 3 columns, episode run"),
        ({"states": with_bad(np.full((3, 2), np.nan))}, "episode fly: states is nan at row 0"),
        ({"states": with_bad(np.full((3, 2), np.inf), 2)}, "episode 7: states is inf at row 0"),
        ({"actions": [np.zeros((3, 1))] * 3}, "episode fly: actions has 3 rows.*need 2"),
        (
            {"actions": [np.zeros((3, 1)), np.zeros((2, 2)), np.zeros((4, 1))]},
            "episode fly: actions has 2 columns, episode run has 1",
        ),
        (
            {"actions": [np.zeros((3, 1)), None, np.zeros((4, 1))]},
            r"actions is missing in 1 of 3 episodes \(first: episode fly\)",
        ),
        (
            {"actions": [np.zeros((3, 1)), np.zeros((2, 1)), [[0.0], [0.0], [0.0], [np.nan]]]},
            "episode 7: actions is nan at row 3, column 0",
        ),
        ({"actions": [np.zeros((3, 1))]}, "actions has 1 items for 3 episodes"),
        ({"rewards": [np.zeros(3), np.zeros(3), np.zeros(4)]}, "episode fly: rewards.*last row"),
        ({"params": [[1.0], [1.0, 2.0], [1.0]]}, "episode fly: params has 2 columns"),
        ({"params": [[1.0], [], [1.0]]}, "params is missing in 1 of 3"),
        ({"params": [[1.0], [np.nan], [1.0]]}, "episode fly: params is nan"),
        ({"params": [[1.0], np.ones((3, 1)), [1.0]]}, "episode fly: params has 3 rows"),
        ({"params": [1.0, 2.0, 3.0]}, r"params has shape \(\)"),
        ({"params": np.zeros((2, 1))}, "params has 2 items for 3 episodes"),
        ({"times": [np.arange(4), [0.0, 2.0, 1.0], np.arange(5)]}, "episode fly: times must incr"),
        ({"times": [np.arange(4), [0.0, 0.0, 1.0], np.arange(5)]}, "episode fly: times must incr"),
        ({"times": [np.arange(4), [0, 1, np.inf], np.arange(5)]}, "episode fly: times is inf"),
        ({"times": [np.arange(4), np.arange(4), np.arange(5)]}, "episode fly: times has 4 rows"),
        ({"references": [np.zeros((4, 1)), np.zeros((2, 1)), np.zeros((5, 1))]}, "fly: references"),
        ({"dt": 0.0}, "dt = 0.0"),
        ({"group": ["a", None, "b"]}, "episode fly: group is missing"),
        ({"group": ["a", np.nan, "b"]}, "episode fly: group is missing"),
        ({"group": ["a", 1, "b"]}, r"group must be all text.*\['int', 'str'\]"),
        ({"group": [True, 2, 3]}, r"group must be all text.*\['bool', 'int'\]"),
        ({"group": ["a", "b"]}, "group has 2 items for 3 episodes"),
        ({"group": 5}, "group is 5: give a sequence"),
        ({"context": {"task": ["a", "b"]}}, "task has 2 items"),
        ({"context": {"actions": ["a", "b"]}, "actions": None}, "actions has 2 items"),
        ({"context": {"load": [1.5, 2.0, 3.0]}}, "context 'load' must be all text"),
        ({"terminated": [0, np.nan, 1]}, "episode fly: terminated is nan"),
        ({"time_origin": [0.0, np.inf, 0.0]}, "episode fly: time_origin is infinite"),
        ({"ids": ["run", "run", "7"]}, "ids repeat"),
        ({"ids": ["run", "fly"]}, "ids has 2 items"),
        ({"state_names": ["x"]}, r"state_names = \['x'\]: expected 2 different"),
        ({"state_names": ["x", "x"]}, "expected 2 different"),
        ({"action_names": ["u"]}, "action_names.*expected 0"),
    ],
)
def test_bad_input_names_the_episode(fields, match):
    with pytest.raises(InvalidEpisodeError, match=match):
        from_arrays(**({"states": GOOD, "ids": ["run", "fly", "7"]} | fields))


def test_episodes_must_fit_together():
    plain = Trajectory(np.zeros((3, 2)), id="plain")
    acting = Trajectory(np.zeros((3, 2)), actions=np.zeros((2, 1)), id="acting")
    facts = Trajectory(np.zeros((3, 2)), context={"task": "a"}, id="facts")
    with pytest.raises(InvalidEpisodeError, match=r"actions is missing.*episode plain"):
        TrajectoryDataset([acting, plain])
    with pytest.raises(InvalidEpisodeError, match="episode facts: context has the keys"):
        TrajectoryDataset([plain, facts])
    with pytest.raises(InvalidEpisodeError, match=r"got ndarray; for plain arrays.*from_arrays"):
        TrajectoryDataset([np.zeros((3, 2))])
    with pytest.raises(InvalidEpisodeError, match="empty"):
        TrajectoryDataset([])


def test_require_names_the_field_and_who_needs_it():
    ds = ragged()
    for field in ("actions", "params", "references", "rewards"):
        with pytest.raises(MissingFieldError, match=f"MyModel needs {field}"):
            ds.require(field, by="MyModel")
    ragged(params=np.zeros((3, 1))).require("params", "states", by="MyModel")


def test_it_does_not_become_one_array():
    with pytest.raises(TypeError, match="cannot become one array"):
        np.asarray(ragged())
    for name in ("iloc", "columns", "dtype"):
        assert not hasattr(ragged(), name)


# -- immutability, equality, pickles ------------------------------------------------------------


def arrays_of(ds):
    fields = [getattr(ds, name) for name in ("offsets", "states", "times", "actions", "rewards")]
    fields += [ds.step_params if ds.params_vary else ds.params, ds.references, ds.terminated]
    fields += [ds.time_origin, ds.ids, ds.group, *ds.context.values()]
    return [item for item in fields if item is not None]


@given(seed=SEEDS)
def test_every_array_is_read_only_also_in_parts_and_copies(make_dataset, seed):
    ds = make_dataset(seed)
    for item in (ds, ds[[0]], ds[:], pickle.loads(pickle.dumps(ds)), copy.deepcopy(ds)):
        assert not any(array.flags.writeable for array in arrays_of(item))
        assert not item[0].states.flags.writeable


def test_it_owns_its_data():
    given_states, theta = np.zeros((2, 3, 1)), np.ones((2, 1))
    ds = from_arrays(given_states, params=theta)
    given_states += 1
    theta += 1
    assert (ds.states == 0).all()
    assert (ds.params == 1).all()
    with pytest.raises(ValueError, match="read-only"):
        ds.states[0] = 1.0
    with pytest.raises(AttributeError):
        ds.states = given_states
    ds.context["task"] = np.array(["a", "b"])
    assert ds.context == {}


@given(seed=SEEDS)
def test_equal_means_every_value_of_every_field(make_dataset, seed):
    ds, same = make_dataset(seed), make_dataset(seed)
    assert ds == same
    changes = [
        {"states": [2 * episode.states + 1 for episode in ds]},
        {"terminated": ~ds.terminated},
        {"time_origin": np.full(len(ds), 100.5)},
        {"group": [f"{i}x" for i in range(len(ds))]},
        {"ids": [f"{i}x" for i in range(len(ds))]},
        {"context": {"other": [0] * len(ds)}},
        {"state_names": [f"n{i}" for i in range(len(ds.state_names))]},
    ]
    same_fields = {
        name: [getattr(episode, name) for episode in ds]
        for name in ("states", "actions", "rewards", "params", "references", "times")
        if getattr(ds[0], name) is not None
    }
    same_fields |= {
        "terminated": ds.terminated,
        "time_origin": ds.time_origin,
        "group": ds.group,
        "ids": ds.ids,
        "context": ds.context,
        **ds.names,
    }
    assert from_arrays(**same_fields) == ds
    for change in changes:
        assert from_arrays(**(same_fields | change)) != ds
    assert ds != "something else"


@given(seed=SEEDS)
def test_pickle_and_deepcopy_give_the_same(make_dataset, seed):
    ds = make_dataset(seed)
    assert pickle.loads(pickle.dumps(ds)) == ds
    assert copy.deepcopy(ds) == ds


def test_pickle_of_many_episodes_is_about_as_large_as_the_arrays():
    rng = np.random.default_rng(0)
    ds = from_arrays(
        rng.normal(size=(2000, 51, 3)),
        actions=rng.normal(size=(2000, 50, 1)),
        params=rng.normal(size=(2000, 2)),
        group=[f"day {i % 7}" for i in range(2000)],
    )
    size = sum(array.nbytes for array in arrays_of(ds))
    assert len(pickle.dumps(ds)) < 1.01 * size + 10_000
    # Part of a dataset carries only its own rows, and so does one episode.
    assert len(pickle.dumps(ds[:20])) < 0.011 * size + 10_000
    assert len(pickle.dumps(ds[0])) < 10_000


# -- indexing ---------------------------------------------------------------------------------


def test_an_integer_gives_an_episode_without_copying():
    ds = ragged()
    assert isinstance(ds[0], Trajectory)
    assert ds[-1].length == ds[np.int64(2)].length == 2
    assert np.shares_memory(ds[1].states, ds.states)
    assert [episode.length for episode in ds] == [4, 8, 2]
    for outside in (3, -4):
        with pytest.raises(IndexError, match="of a dataset of 3"):
            ds[outside]


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        (slice(1, None), [1, 2]),
        (slice(None, None, -1), [2, 1, 0]),
        (slice(-2, 100), [1, 2]),
        ([2, 0], [2, 0]),
        ((2, 0), None),
        (np.array([0, 0, -1]), [0, 0, 2]),
        (np.array([1], dtype=np.uint8), [1]),
        (np.array([True, False, True]), [0, 2]),
        ([False, True, False], [1]),
        (pd.Series([0, 2], index=[5, 6]), [0, 2]),
        (([1, 2], Ellipsis), [1, 2]),
        ((np.array([1]), ...), [1]),
        ((np.array([True, True, False]), ...), [0, 1]),
        ((slice(0, 1), ...), [0]),
    ],
)
def test_everything_else_gives_a_dataset(key, expected):
    rng = np.random.default_rng(1)
    ds = ragged(
        ids=["a", "b", "c"],
        actions=[rng.normal(size=(t, 1)) for t in (4, 8, 2)],
        params=[rng.normal(size=(t, 2)) for t in (4, 8, 2)],
        references=[rng.normal(size=(t + 1, 1)) for t in (4, 8, 2)],
        rewards=[rng.normal(size=t) for t in (4, 8, 2)],
        group=["g", "h", "g"],
        context={"task": [1, 2, 3]},
        terminated=[True, False, False],
        time_origin=[0.0, np.nan, 1.0],
    )
    if expected is None:
        with pytest.raises(IndexError, match="index episodes only"):
            ds[key]
        return
    part = ds[key]
    assert isinstance(part, TrajectoryDataset)
    assert part.shape == (len(expected),)
    assert part.state_names == ds.state_names
    for episode, i in zip(part, expected, strict=True):
        np.testing.assert_equal(episode.to_dict(), ds[i].to_dict())


@pytest.mark.parametrize(
    "key", [[], np.array([], dtype=int), slice(3, 9), [False, False, False], True, [[0, 1]], None]
)
def test_an_index_that_selects_no_episode_is_refused(key):
    with pytest.raises(IndexError):
        ragged()[key]


@pytest.mark.parametrize("key", [[0.5], [3], [True, False], "a", (0, 1), (0, ..., 0)])
def test_an_index_that_makes_no_sense_is_refused(key):
    with pytest.raises(IndexError):
        ragged()[key]


@given(seed=SEEDS, data=st.data())
def test_indexing_twice_is_indexing_once(make_dataset, seed, data):
    ds = make_dataset(seed)
    index = st.lists(st.integers(-len(ds), len(ds) - 1), min_size=1, max_size=8)
    outer = np.array(data.draw(index))
    inner = np.array(data.draw(st.lists(st.integers(0, len(outer) - 1), min_size=1, max_size=8)))
    assert ds[outer][inner] == ds[outer[inner]]
    assert ds[outer] == ds[list(outer)] == ds[outer, ...]


def test_state_rows_finds_the_flat_row_of_a_start():
    ds = ragged()
    assert ds.state_rows().tolist() == [0, 5, 14]
    assert ds.state_rows([4, 0, 2]).tolist() == [4, 5, 16]
    with pytest.raises(IndexError, match="start 3 is outside episode 2"):
        ds.state_rows(3)


def test_as_dataset_and_is_episodes_tell_episodes_from_rows():
    ds = ragged()
    assert as_dataset(ds) is ds
    assert as_dataset(list(ds)) == ds
    assert as_dataset(ds[0]) == TrajectoryDataset([ds[0]])
    assert is_episodes(ds)
    assert is_episodes([ds[0]])
    for other in (np.zeros((3, 2)), [], [[1.0]], None):
        assert not is_episodes(other)
    with pytest.raises(TypeError, match="expected a TrajectoryDataset or a list of Trajectory"):
        as_dataset(np.zeros((3, 2)))


# -- scikit-learn -----------------------------------------------------------------------------


class MeanState(BaseEstimator):
    """Remembers what it saw; predicts each episode's distance to the mean state, shrunk."""

    def __init__(self, shrink=0.0):
        self.shrink = shrink

    def fit(self, X, y=None, groups=None, sample_weight=None):
        assert isinstance(X, TrajectoryDataset), type(X)
        self.ids_, self.n_rows_ = X.ids, len(X.states)
        self.groups_, self.weight_ = groups, sample_weight
        self.mean_ = (1 - self.shrink) * X.states.mean(axis=0)
        return self

    def predict(self, X):
        assert isinstance(X, TrajectoryDataset), type(X)
        return np.array([np.mean((episode.states - self.mean_) ** 2) for episode in X])

    def score(self, X, y=None, sample_weight=None):
        return -float(np.average(self.predict(X), weights=sample_weight))


class Shift(TransformerMixin, BaseEstimator):
    """A dataset-to-dataset transformer."""

    def __init__(self, by=0.0):
        self.by = by

    def fit(self, X, y=None):
        self.fitted_ = True
        return self

    def transform(self, X):
        return TrajectoryDataset(
            [Trajectory(**(item.to_dict() | {"states": item.states + self.by})) for item in X]
        )


@pytest.fixture(scope="module")
def flights():
    rng = np.random.default_rng(3)
    lengths = rng.integers(5, 30, 24)
    return from_arrays(
        [rng.normal(3.0, 1.0, size=(steps + 1, 2)) for steps in lengths],
        params=rng.normal(size=(24, 1)),
        group=[f"day {i % 4}" for i in range(24)],
        ids=[f"flight {i}" for i in range(24)],
    )


def assert_whole_episodes(ds, result):
    """Every fold was fitted on whole episodes, and no episode is on both sides."""
    pairs = zip(
        result["estimator"], result["indices"]["train"], result["indices"]["test"], strict=True
    )
    for fitted, train, test in pairs:
        fitted = fitted[-1] if hasattr(fitted, "steps") else fitted
        assert not set(train) & set(test)
        np.testing.assert_array_equal(fitted.ids_, ds.ids[train])
        assert fitted.n_rows_ == (ds.lengths[train] + 1).sum()


def test_train_test_split_keeps_episodes_whole(flights):
    train, test, a, b = train_test_split(flights, flights.group, test_size=0.25, random_state=0)
    assert isinstance(train, TrajectoryDataset)
    assert sorted([*train.ids, *test.ids]) == sorted(flights.ids)
    assert len(train.states) + len(test.states) == len(flights.states)
    np.testing.assert_array_equal(train.group, a)
    np.testing.assert_array_equal(test.group, b)
    _, test = train_test_split(flights, stratify=flights.group, test_size=4, random_state=0)
    assert len(set(test.group)) == 4


@pytest.mark.parametrize("cv", [KFold(3), KFold(4, shuffle=True, random_state=0), 5])
def test_cross_validate(flights, cv):
    result = cross_validate(MeanState(), flights, cv=cv, return_estimator=True, return_indices=True)
    assert_whole_episodes(flights, result)
    scores = cross_val_score(MeanState(), flights, cv=cv)
    np.testing.assert_array_equal(scores, result["test_score"])
    assert np.isfinite(scores).all()


@pytest.mark.parametrize("cv", [GroupKFold(4), LeaveOneGroupOut()])
def test_group_splits_part_no_group(flights, cv):
    result = cross_validate(
        MeanState(),
        flights,
        groups=flights.group,
        cv=cv,
        return_estimator=True,
        return_indices=True,
    )
    assert_whole_episodes(flights, result)
    for test in result["indices"]["test"]:
        assert len(set(flights.group[test])) == 1


def test_stratified_folds_take_the_group_as_y(flights):
    folds = list(StratifiedKFold(3).split(flights, flights.group))
    assert all(len(set(flights.group[test])) == 4 for _, test in folds)


def test_two_processes_give_the_same_scores():
    # Above 1 MB joblib hands workers read-only memory maps in place of arrays.
    rng = np.random.default_rng(0)
    large = from_arrays(rng.normal(size=(12, 6001, 2)))
    assert large.states.nbytes > 1_000_000
    result = cross_validate(
        MeanState(), large, cv=3, n_jobs=2, return_estimator=True, return_indices=True
    )
    assert_whole_episodes(large, result)
    np.testing.assert_array_equal(result["test_score"], cross_val_score(MeanState(), large, cv=3))


def test_grid_search_finds_the_better_value_and_refits_on_all(flights):
    search = GridSearchCV(MeanState(), {"shrink": [1.0, 0.0, 0.5]}, cv=GroupKFold(3))
    search.fit(flights, groups=flights.group)
    assert search.best_params_ == {"shrink": 0.0}
    assert search.best_estimator_.n_rows_ == len(flights.states)
    assert search.predict(flights).shape == (24,)
    assert search.score(flights) == MeanState().fit(flights).score(flights)


def test_a_pipeline_of_dataset_transformers(flights):
    pipeline = make_pipeline(Shift(by=-3.0), MeanState(shrink=1.0))
    assert pipeline.fit(flights).predict(flights).shape == (24,)
    search = GridSearchCV(pipeline, {"shift__by": [0.0, -3.0]}, cv=3).fit(flights)
    assert search.best_params_ == {"shift__by": -3.0}
    result = cross_validate(pipeline, flights, cv=3, return_estimator=True, return_indices=True)
    assert_whole_episodes(flights, result)


def test_learning_curve_counts_episodes(flights):
    sizes, train, test = learning_curve(
        MeanState(), flights, None, train_sizes=[0.25, 1.0], cv=KFold(4), shuffle=False
    )
    assert sizes.tolist() == [4, 18]
    assert train.shape == test.shape == (2, 4)
    assert np.isfinite(test).all()


def test_cross_val_predict_returns_each_episode_once(flights):
    predicted = cross_val_predict(MeanState(), flights, cv=KFold(4))
    assert predicted.shape == (24,)
    train, test = next(KFold(4).split(flights))
    np.testing.assert_array_equal(
        predicted[test], clone(MeanState()).fit(flights[train]).predict(flights[test])
    )


def test_metadata_routing_hands_out_groups_and_weights(flights):
    weight = np.arange(24.0)
    with config_context(enable_metadata_routing=True):
        estimator = (
            MeanState()
            .set_fit_request(groups=True, sample_weight=True)
            .set_score_request(sample_weight=True)
        )
        result = cross_validate(
            make_pipeline(Shift(), estimator),
            flights,
            cv=GroupKFold(4),
            params={"groups": flights.group, "sample_weight": weight},
            return_estimator=True,
            return_indices=True,
        )
        assert_whole_episodes(flights, result)
        for fitted, train in zip(result["estimator"], result["indices"]["train"], strict=True):
            np.testing.assert_array_equal(fitted[-1].groups_, flights.group[train])
            np.testing.assert_array_equal(fitted[-1].weight_, weight[train])
        search = GridSearchCV(estimator, {"shrink": [0.0, 1.0]}, cv=GroupKFold(2))
        search.fit(flights, groups=flights.group, sample_weight=weight)
        assert search.best_params_ == {"shrink": 0.0}
