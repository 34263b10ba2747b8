"""Long tables: reading, refusing, writing, and the summary."""

import time

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories import TrajectoryDataset, from_frame, to_frame

SEEDS = st.integers(0, 2**32 - 1)
NAN = np.nan


@pytest.fixture
def log():
    """Two flights, the second one shorter; what belongs to no step is missing."""
    return pd.DataFrame(
        {
            "flight": ["b", "b", "b", "a", "a"],
            "t": [0.0, 0.1, 0.3, 5.0, 5.2],
            "height": [1.0, 2.0, 3.0, 4.0, 5.0],
            "speed": [0.1, 0.2, 0.3, 0.4, 0.5],
            "thrust": [7.0, 8.0, NAN, 9.0, NAN],
            "score": [0.7, 0.8, NAN, 0.9, NAN],
            "gain": [2.0, 3.0, NAN, 4.0, NAN],
            "set_point": [1, 1, 2, 2, 2],
            "motor": ["x", "x", "x", "y", "y"],
            "battery": [3.0, 3.0, 3.0, 4.0, 4.0],
            "fell": [False, False, False, True, True],
            "begin": [-0.5, -0.5, -0.5, NAN, NAN],
        }
    )


COLUMNS = {
    "episode": "flight",
    "time": "t",
    "states": ["height", "speed"],
    "actions": ["thrust"],
    "rewards": "score",
    "params": ["gain"],
    "references": ["set_point"],
    "context": ["motor", "battery"],
    "group": "motor",
    "terminated": "fell",
    "time_origin": "begin",
}


def test_every_column_reaches_its_field(log):
    ds = from_frame(log, **COLUMNS)
    assert ds == TrajectoryDataset.from_arrays(
        [[[1.0, 0.1], [2.0, 0.2], [3.0, 0.3]], [[4.0, 0.4], [5.0, 0.5]]],
        actions=[[[7.0], [8.0]], [[9.0]]],
        rewards=[[0.7, 0.8], [0.9]],
        params=[[[2.0], [3.0]], [[4.0]]],
        references=[[[1.0], [1.0], [2.0]], [[2.0], [2.0]]],
        times=[[0.0, 0.1, 0.3], [5.0, 5.2]],
        time_origin=[-0.5, NAN],
        context={"motor": ["x", "y"], "battery": [3, 4]},
        group=["x", "y"],
        terminated=[False, True],
        ids=["b", "a"],
        state_names=["height", "speed"],
        action_names=["thrust"],
        param_names=["gain"],
        reference_names=["set_point"],
    )
    assert TrajectoryDataset.from_frame(log, **COLUMNS) == ds


def test_the_last_row_of_step_columns_is_ignored(log):
    full = log.fillna({"thrust": 99.0, "score": 99.0, "gain": 99.0})
    assert from_frame(full, **COLUMNS) == from_frame(log, **COLUMNS)


def test_only_states_are_needed_and_dt_stands_in_for_times(log):
    ds = from_frame(log, episode="flight", states="height", dt=0.5)
    assert ds.state_names == ("height",)
    np.testing.assert_array_equal(ds.times, [0.0, 0.5, 1.0, 0.0, 0.5])
    assert ds.actions is ds.rewards is ds.references is ds.group is None
    assert not ds.has_params
    assert not ds.terminated.any()


def test_constant_params_become_one_row_an_episode(log):
    log["gain"] = [2.0, 2.0, NAN, 4.0, NAN]
    assert from_frame(log, **COLUMNS).params.tolist() == [[2.0], [4.0]]


def test_rows_may_alternate_between_episodes_if_time_orders_them(log):
    mixed = log.iloc[[0, 3, 1, 4, 2]]
    assert from_frame(mixed, **COLUMNS) == from_frame(log, **COLUMNS)
    with pytest.raises(InvalidEpisodeError, match=r"episode b: its rows are interrupted.*row 2"):
        from_frame(mixed, **(COLUMNS | {"time": None}))


def test_unsorted_times_are_refused_not_sorted(log):
    with pytest.raises(InvalidEpisodeError, match=r"episode b: times must increase.*0.3 to 0.1"):
        from_frame(log.iloc[[0, 2, 1, 3, 4]], **COLUMNS)
    # Two logs under one name: each is sorted, both together are not.
    log["flight"] = "b"
    with pytest.raises(InvalidEpisodeError, match="episode b: column 'motor'"):
        from_frame(log, **COLUMNS)
    log["t"] = [0.0, 0.1, 0.3, 0.0, 0.1]
    with pytest.raises(InvalidEpisodeError, match=r"episode b: times must increase.*0.3 to 0.0"):
        from_frame(log, episode="flight", time="t", states=["height"])


def test_missing_columns_are_named_all_at_once(log):
    wrong = COLUMNS | {"states": ["heigth", "speed"], "actions": ["u"], "group": "Motor"}
    with pytest.raises(ValueError, match=r"'heigth' \(states; did you mean 'height'\?\)") as error:
        from_frame(log, **wrong)
    assert "'u' (actions)" in str(error.value)
    assert "'Motor' (group; did you mean 'motor'?)" in str(error.value)
    assert "'set_point'" in str(error.value)


@pytest.mark.parametrize(
    ("roles", "match"),
    [
        ({"actions": ["height"]}, r"two purposes: 'height' \(states, actions\)"),
        ({"states": ["height", "height"]}, r"'height' \(states, states\)"),
        ({"states": ["t"]}, r"'t' \(time, states\)"),
        ({"rewards": "gain"}, r"'gain' \(rewards, params\)"),
        ({"states": []}, "states names no column"),
        ({"states": ["motor"]}, r"column 'motor' \(states\) has the type .*pandas.to_numeric"),
        ({"time_origin": "motor"}, r"column 'motor' \(time_origin\) has the type"),
        ({"terminated": "battery"}, r"episode b: column 'battery' \(terminated\) is 3"),
        ({"terminated": "begin"}, r"episode a: column 'begin' \(terminated\) is missing"),
        ({"group": "height"}, r"episode b: column 'height' \(group\) changes in row 1"),
        ({"context": ["set_point"]}, r"episode b: column 'set_point' \(context\) changes in row 2"),
        ({"group": "begin"}, r"episode a: column 'begin' \(group\) is missing"),
        ({"time_origin": "speed"}, r"episode b: column 'speed' \(time_origin\) changes in row 1"),
        ({"group": "speed", "episode": "height"}, "episode 1: has 1 row"),
        ({"episode": "begin"}, r"column 'begin' \(episode\) is missing in row 3"),
        ({"references": ["thrust"], "actions": []}, "episode b: references is nan at row 2"),
        ({"dt": 0.0, "time": None}, "dt = 0.0 must be positive"),
    ],
)
def test_columns_that_do_not_fit_are_refused(log, roles, match):
    with pytest.raises(ValueError, match=match):
        from_frame(log, **(COLUMNS | roles))


@pytest.mark.parametrize(
    ("column", "row", "value", "match"),
    [
        ("thrust", 0, NAN, "episode b: actions is nan at row 0, column 0"),
        ("thrust", 3, np.inf, "episode a: actions is inf at row 0, column 0"),
        ("score", 1, NAN, "episode b: rewards is nan at row 1"),
        ("gain", 1, NAN, "episode b: params is nan at row 1"),
        ("speed", 4, NAN, "episode a: states is nan at row 1, column 1"),
        ("t", 4, NAN, "episode a: times is nan at row 1"),
        ("motor", 3, None, r"episode a: column 'motor' \(context\) changes in row 1"),
        ("fell", 0, True, r"column 'fell' \(terminated\) changes in row 1.*transform\('any'\)"),
    ],
)
def test_bad_cells_name_the_episode_and_the_row_in_it(log, column, row, value, match):
    log.loc[row, column] = value
    with pytest.raises(InvalidEpisodeError, match=match):
        from_frame(log, **COLUMNS)


def test_timestamps_are_refused_with_the_remedy(log):
    log["t"] = pd.to_datetime(log["t"], unit="s")
    with pytest.raises(InvalidEpisodeError, match=r"total_seconds\(\)"):
        from_frame(log, **COLUMNS)


def test_a_table_is_a_data_frame_with_rows_and_unique_columns(log):
    with pytest.raises(TypeError, match="frame must be a pandas DataFrame, got dict"):
        from_frame({"flight": [1]}, **COLUMNS)
    with pytest.raises(InvalidEpisodeError, match="there are no rows"):
        from_frame(log.iloc[:0], **COLUMNS)
    with pytest.raises(InvalidEpisodeError, match="episode b: has 1 row"):
        from_frame(log.iloc[2:], **COLUMNS)
    with pytest.raises(ValueError, match=r"several columns called \['height'\]"):
        from_frame(pd.concat([log, log[["height"]]], axis=1), **COLUMNS)


def test_column_types_of_pandas_do_not_matter(log):
    expected = from_frame(log, **COLUMNS)
    log.index = [9, 9, 3, 1, 0]
    typed = log.astype(
        {"flight": "category", "motor": "string", "height": "Float64", "fell": "boolean"}
    )
    typed["thrust"] = typed["thrust"].astype("Float32")
    typed["score"] = log["score"].astype(object)
    typed["set_point"] = typed["set_point"].astype("Int8")
    assert from_frame(typed, **COLUMNS) == expected


def test_the_dataset_does_not_follow_later_changes_of_the_table(log):
    ds = from_frame(log, **COLUMNS)
    log.loc[:, "height"] = -1.0
    log["t"] += 1.0
    assert ds.states[0, 0] == 1.0
    assert ds.times[0] == 0.0


def roles_of(ds):
    """Columns that to_frame promises for the fields that are there."""
    roles = {
        "states": ds.state_names,
        "actions": ds.action_names,
        "params": ds.param_names,
        "references": ds.reference_names,
        "context": list(ds.context),
    }
    if ds.rewards is not None:
        roles["rewards"] = "reward"
    if ds.group is not None:
        roles["group"] = "group"
    if ds.terminated.any():
        roles["terminated"] = "terminated"
    if np.isfinite(ds.time_origin).any():
        roles["time_origin"] = "time_origin"
    return {"episode": "episode", "time": "time"} | roles


@given(seed=SEEDS)
def test_a_table_gives_the_dataset_back(make_dataset, seed):
    ds = make_dataset(seed)
    frame = to_frame(ds)
    assert len(frame) == len(ds.states)
    back = from_frame(frame, **roles_of(ds))
    assert back == ds
    assert back.states.tobytes() == ds.states.tobytes()
    # A loop over rows, as a reader of the table would write it.
    for label, episode in zip(ds.ids.tolist(), ds, strict=True):
        rows = frame[frame["episode"] == label]
        for name, column in zip(ds.state_names, episode.states.T, strict=True):
            np.testing.assert_array_equal(rows[name], column)
        for j, name in enumerate(ds.action_names):
            np.testing.assert_array_equal(rows[name], [*episode.actions[:, j], NAN])
        if ds.group is not None:
            assert (rows["group"] == episode.group).all()


def test_a_csv_file_gives_the_dataset_back(make_dataset, tmp_path):
    rng = np.random.default_rng(0)
    ds = TrajectoryDataset.from_arrays(
        [rng.normal(size=(t + 1, 2)) for t in (3, 5)],
        actions=[rng.normal(size=(t, 1)) for t in (3, 5)],
        params=[rng.normal(size=(t, 1)) for t in (3, 5)],
        group=["a", "b"],
        terminated=[True, False],
        ids=[4, 2],
    )
    to_frame(ds).to_csv(tmp_path / "log.csv", index=False)
    assert from_frame(pd.read_csv(tmp_path / "log.csv"), **roles_of(ds)) == ds


@pytest.mark.parametrize(
    ("names", "fields", "match"),
    [
        ({"state_names": ["u"], "action_names": ["u"]}, {}, r"'u' \(states and actions\)"),
        ({"state_names": ["time"]}, {}, r"'time' \(time and states\)"),
        ({"state_names": ["reward"]}, {}, r"'reward' \(states and rewards\)"),
        ({}, {"context": {"episode": ["a"]}}, r"'episode' \(episode and context\)"),
    ],
)
def test_names_that_collide_are_refused(names, fields, match):
    ds = TrajectoryDataset.from_arrays(
        np.zeros((1, 3, 1)),
        actions=np.zeros((1, 2, 1)),
        rewards=np.zeros((1, 2)),
        **names,
        **fields,
    )
    with pytest.raises(ValueError, match=match):
        to_frame(ds)


def test_a_bootstrap_sample_is_numbered():
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 3, 1)), ids=["a", "b"])
    frame = ds[[1, 1]].to_frame()
    assert frame["episode"].tolist() == [0, 0, 0, 1, 1, 1]


def test_conversions_are_vectorised():
    rng = np.random.default_rng(0)
    ds = TrajectoryDataset.from_arrays(
        rng.normal(size=(2000, 201, 4)),
        actions=rng.normal(size=(2000, 200, 2)),
        params=rng.normal(size=(2000, 3)),
        group=[f"day {i % 20}" for i in range(2000)],
        ids=[f"run {i}" for i in range(2000)],
    )
    start = time.process_time()
    frame = to_frame(ds)
    middle = time.process_time()
    back = from_frame(frame, **roles_of(ds))
    end = time.process_time()
    assert back == ds
    assert middle - start < 1.0
    assert end - middle < 1.0


# -- describe ---------------------------------------------------------------------------------


@given(seed=SEEDS)
def test_describe_agrees_with_pandas(make_dataset, seed):
    ds = make_dataset(seed)
    with np.errstate(all="ignore"):
        table, frame = ds.describe(), to_frame(ds)
        assert table.loc[("episode", "steps"), "max"] == max(item.length for item in ds)
        assert table.loc[("times", "dt"), "count"] == ds.lengths.sum()
        for field, names in (("states", ds.state_names), ("actions", ds.action_names)):
            for name in names:
                column = frame[name].dropna()
                row = table.loc[(field, name)]
                assert row["count"] == len(column)
                assert (row["min"], row["max"]) == (column.min(), column.max())
                if np.abs(column).max() < 1e100:
                    np.testing.assert_allclose(row["mean"], column.mean(), rtol=1e-9, atol=1e-12)
                    np.testing.assert_allclose(
                        row["std"], column.std(ddof=0), rtol=1e-6, atol=1e-9 * np.abs(column).max()
                    )
    for key, values in ds.context.items():
        assert table.loc[("context", key), "distinct"] == len(set(values.tolist()))
    if ds.group is not None:
        assert table.loc[("group", "group"), "distinct"] == len(set(ds.group.tolist()))


def test_describe_has_a_row_for_every_field_that_is_there(log):
    table = from_frame(log, **COLUMNS).describe()
    assert table.index.tolist() == [
        ("episode", "steps"),
        ("times", "dt"),
        ("states", "height"),
        ("states", "speed"),
        ("actions", "thrust"),
        ("rewards", "reward"),
        ("params", "gain"),
        ("references", "set_point"),
        ("time_origin", "time_origin"),
        ("terminated", "terminated"),
        ("context", "motor"),
        ("context", "battery"),
        ("group", "group"),
    ]
    assert table.loc[("time_origin", "time_origin"), "count"] == 1
    assert table.loc[("terminated", "terminated"), "mean"] == 0.5
    assert table.loc[("params", "gain"), "count"] == 3
    plain = TrajectoryDataset.from_arrays(np.zeros((3, 4, 1)), params=[[1.0], [1.0], [2.0]])
    assert plain.describe().loc[("params", "theta0"), ["count", "distinct"]].tolist() == [3, 2]
    assert len(plain.describe()) == 4
