"""Files: every bit back, whole or not at all, and a clear error for anything else."""

import io
import json
import os
import pickle
import zipfile

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trajlearn.exceptions import UnknownFileError
from trajlearn.trajectories import Trajectory, TrajectoryDataset, files, from_frame
from trajlearn.trajectories.files import load_dataset, save_dataset

SEEDS = st.integers(0, 2**32 - 1)
SUFFIXES = [".npz", ".parquet"]


@pytest.fixture(scope="module")
def ds():
    rng = np.random.default_rng(0)
    lengths = (3, 6)
    return TrajectoryDataset.from_arrays(
        [rng.normal(size=(t + 1, 2)) for t in lengths],
        actions=[rng.normal(size=(t, 1)) for t in lengths],
        rewards=[rng.normal(size=t) for t in lengths],
        params=[rng.normal(size=(t, 1)) for t in lengths],
        references=[rng.normal(size=(t + 1, 1)) for t in lengths],
        time_origin=[np.nan, -0.5],
        context={"motor": ["x", "ÿ"], "load": [1, 2], "wet": [True, False]},
        group=["a", "b"],
        ids=["run 1", "run 2"],
        terminated=[True, False],
        dt=0.1,
        state_names=["x", "Größe"],
    )


def saved(ds, tmp_path, suffix):
    path = tmp_path / f"log{suffix}"
    ds.save(path)
    return path


def bits(ds):
    fields = (ds.states, ds.times, ds.actions, ds.rewards, ds.references, ds.step_params)
    return [None if item is None else item.tobytes() for item in fields]


@pytest.mark.parametrize("suffix", SUFFIXES)
@given(seed=SEEDS)
def test_every_bit_comes_back(make_dataset, tmp_path_factory, suffix, seed):
    ds = make_dataset(seed)
    path = saved(ds, tmp_path_factory.mktemp("files"), suffix)
    back = TrajectoryDataset.load(path)
    assert back == ds
    assert bits(back) == bits(ds)
    assert not back.states.flags.writeable
    assert [type(item) for item in back.ids.tolist()] == [type(item) for item in ds.ids.tolist()]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_repeated_ids_and_colliding_names_come_back(ds, tmp_path, suffix):
    sample = ds[[1, 1, 0]]
    assert load_dataset(saved(sample, tmp_path, suffix)) == sample
    same = TrajectoryDataset.from_arrays(
        np.zeros((2, 3, 1)),
        actions=np.ones((2, 2, 1)),
        context={"u": [1, 2], "episode": [3, 4]},
        state_names=["u"],
        action_names=["u"],
    )
    assert load_dataset(saved(same, tmp_path, suffix)) == same


@pytest.mark.parametrize("suffix", [".NPZ", ".Parquet"])
def test_the_path_may_be_text_and_the_suffix_in_capitals(ds, tmp_path, suffix):
    path = str(saved(ds, tmp_path, suffix))
    assert load_dataset(path) == ds


def test_parquet_is_the_long_table_for_any_reader(ds, tmp_path):
    frame = pd.read_parquet(saved(ds, tmp_path, ".parquet"))
    pd.testing.assert_frame_equal(frame.drop(columns="step"), ds.to_frame())
    assert frame["step"].tolist() == [*range(4), *range(7)]
    back = from_frame(frame, episode="episode", time="time", states=ds.state_names)
    assert back.states.tobytes() == ds.states.tobytes()


def test_the_same_dataset_gives_the_same_file(ds, tmp_path):
    first = saved(ds, tmp_path, ".npz").read_bytes()
    assert saved(ds, tmp_path, ".npz").read_bytes() == first


# -- writing ----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_write_that_fails_leaves_the_old_file_and_no_other(ds, tmp_path, suffix, monkeypatch):
    path = saved(ds, tmp_path, suffix)

    def half(columns, handle):
        handle.write(b"half")
        raise OSError("no space left on device")

    writer = {".npz": "write_npz", ".parquet": "_write_parquet"}[suffix]
    monkeypatch.setattr(files, writer, half)
    with pytest.raises(OSError, match="no space left"):
        ds[[0]].save(path)
    assert load_dataset(path) == ds
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_of_the_same_name_is_replaced(ds, tmp_path, suffix):
    path = saved(ds, tmp_path, suffix)
    before = path.read_bytes()
    with path.open("rb") as reader:
        ds[[0]].save(path)
        if os.name == "posix":
            # Whoever is reading the old file goes on reading all of it.
            assert reader.read() == before
    assert load_dataset(path) == ds[[0]]
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.skipif(os.name != "posix", reason="permission bits are POSIX")
def test_the_file_has_the_usual_permissions(ds, tmp_path):
    (tmp_path / "plain").touch()
    path = saved(ds, tmp_path, ".npz")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("name", ["log.csv", "log", "log.npz.gz", "log.npy", "log.pkl"])
def test_an_unknown_suffix_is_refused(ds, tmp_path, name):
    with pytest.raises(UnknownFileError, match=r"neither '\.npz' nor '\.parquet'"):
        save_dataset(ds, tmp_path / name)
    with pytest.raises(UnknownFileError, match=r"neither '\.npz' nor '\.parquet'"):
        load_dataset(tmp_path / name)
    assert not os.listdir(tmp_path)


def test_a_missing_folder_or_file_is_an_ordinary_error(ds, tmp_path):
    with pytest.raises(FileNotFoundError):
        ds.save(tmp_path / "nowhere" / "log.npz")
    for suffix in SUFFIXES:
        with pytest.raises(FileNotFoundError):
            load_dataset(tmp_path / f"nothing{suffix}")


def test_parquet_without_pyarrow_names_the_extra(ds, tmp_path, monkeypatch):
    path = saved(ds, tmp_path, ".parquet")
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    for use in (lambda: ds.save(tmp_path / "new.parquet"), lambda: load_dataset(path)):
        with pytest.raises(ImportError, match=r'pip install "trajlearn\[parquet\]"'):
            use()
    assert os.listdir(tmp_path) == [path.name]


# -- files that are not ours, or no longer -------------------------------------------------------


def foreign_files():
    array = io.BytesIO()
    np.save(array, np.zeros(3))
    archive = io.BytesIO()
    np.savez(archive, states=np.zeros((3, 2)))
    headed = io.BytesIO()
    np.savez(headed, header=np.frombuffer(b'{"format": "other"}', dtype=np.uint8))
    other = io.BytesIO()
    np.savez(other, header=np.frombuffer(b"[1, 2]", dtype=np.uint8))
    table = io.BytesIO()
    pd.DataFrame({"x": [1.0]}).to_parquet(table)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr("readme.txt", "hello")
    return {
        "empty": b"",
        "text": b"time,x\n0,1\n",
        "npy": array.getvalue(),
        "npz": archive.getvalue(),
        "npz with a header": headed.getvalue(),
        "npz with a list": other.getvalue(),
        "parquet": table.getvalue(),
        "zip": packed.getvalue(),
        "pickle": pickle.dumps({"states": [1, 2]}),
    }


@pytest.mark.parametrize("kind", foreign_files())
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_foreign_files_are_unknown(tmp_path, suffix, kind):
    path = tmp_path / f"log{suffix}"
    path.write_bytes(foreign_files()[kind])
    with pytest.raises(UnknownFileError, match=str(path)) as error:
        load_dataset(path)
    # numpy would advise allow_pickle=True as if that were the remedy.
    assert "allow_pickle=True" not in str(error.value)


def repack(path, **changes):
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays |= changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})


class Trap:
    """Would act when unpickled."""

    sprung = False

    def __reduce__(self):
        return (Trap.spring, ())

    @staticmethod
    def spring():
        Trap.sprung = True
        return "a"


@pytest.mark.parametrize("field", ["ids", "header", "states", "extra"])
def test_nothing_in_a_file_is_executed(ds, tmp_path, field):
    path = saved(ds, tmp_path, ".npz")
    repack(path, **{field: np.array([Trap(), Trap()], dtype=object)})
    with pytest.raises(UnknownFileError):
        load_dataset(path)
    assert not Trap.sprung


def header(**changes):
    plain = {"format": "trajlearn.dataset", "version": 1, "params_per_step": True}
    plain |= {"names": {"states": ["x", "v"]}, "context": ["motor", "load", "wet"]}
    return np.frombuffer(json.dumps(plain | changes).encode(), dtype=np.uint8)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"states": np.full((11, 2), np.nan)}, "states is nan"),
        ({"states": np.zeros((10, 2))}, "states has shape"),
        ({"states": np.zeros(11)}, "states has shape"),
        ({"states": np.array([["a", "b"]] * 11)}, "damaged"),
        ({"states": None}, "damaged"),
        ({"counts": np.array([4, 8])}, "states has shape"),
        ({"counts": np.array([12, -1])}, "run 2"),
        ({"counts": np.array([10, 1])}, "episode run 2: has 1 row"),
        ({"counts": np.array([], dtype=int)}, "damaged"),
        ({"times": np.zeros(11)}, "times must increase"),
        ({"times": np.full(11, np.inf)}, "times is inf"),
        ({"ids": np.array(["run 1"])}, "damaged"),
        ({"ids": np.array([1.5, 2.5])}, "episode id must be"),
        ({"group": np.array(["a"])}, "group has 1 values for 2"),
        ({"context0": None}, "context0"),
        ({"context1": np.array([1])}, "labels must have one value"),
        ({"terminated": np.array([True])}, "damaged"),
        ({"time_origin": np.array([np.inf, 0.0])}, "time_origin is infinite"),
        ({"params": np.zeros((2, 1))}, "params has shape"),
        ({"surprise": np.zeros(1)}, "surprise"),
        ({"header": header(version=2)}, "version 2 of the format, this package reads 1"),
        ({"header": header(format="x")}, "not a dataset that trajlearn saved"),
        ({"header": header(names={"states": ["x"]})}, "state_names"),
        ({"header": header(context=[])}, "context0"),
        ({"header": header(params_per_step=False)}, "params has shape"),
        ({"header": np.frombuffer(b"{", dtype=np.uint8)}, "damaged"),
    ],
)
def test_contents_that_were_changed_go_through_validation(ds, tmp_path, changes, match):
    path = saved(ds, tmp_path, ".npz")
    repack(path, **changes)
    with pytest.raises(UnknownFileError, match=match):
        load_dataset(path)


def rewrite(path, change):
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(path)
    pyarrow.parquet.write_table(change(table), path)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: t.slice(1), "rows are missing"),
        (lambda t: t.take([0, 2, 1, *range(3, 11)]), "rows are missing"),
        (lambda t: t.drop_columns(["x"]), "x"),
        (lambda t: t.set_column(3, "x", [[float("nan")] * 11]), "states is nan"),
        (lambda t: t.set_column(2, "time", [[0.0] * 11]), "times must increase"),
        (lambda t: t.set_column(1, "step", [[0] * 11]), "has 1 row"),
        (lambda t: t.set_column(0, "episode", [[None] * 11]), "missing"),
        (lambda t: t.replace_schema_metadata({}), "not saved by trajlearn.*from_frame"),
        (lambda t: t.replace_schema_metadata({"trajlearn": "{"}), "damaged"),
        (lambda t: t.replace_schema_metadata({"trajlearn": '{"format": 1}'}), "not a dataset"),
        (lambda t: t.slice(0, 0), "no rows"),
        (lambda t: t.slice(0, 10), "checksum"),
        (lambda t: t.set_column(3, "x", [[0.5] * 11]), "checksum"),
    ],
)
def test_parquet_tables_that_were_changed_are_refused(ds, tmp_path, change, match):
    path = saved(ds, tmp_path, ".parquet")
    rewrite(path, change)
    with pytest.raises(UnknownFileError, match=match):
        load_dataset(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
@given(keep=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_is_refused(ds, tmp_path_factory, suffix, keep):
    path = saved(ds, tmp_path_factory.mktemp("files"), suffix)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(UnknownFileError, match=r"damaged|not a dataset"):
        load_dataset(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=100)
@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_never_gives_other_data(tmp_path_factory, suffix, where, bit):
    rng = np.random.default_rng(0)
    ds = TrajectoryDataset.from_arrays(rng.normal(size=(2, 200, 3)), params=rng.normal(size=(2, 1)))
    path = saved(ds, tmp_path_factory.mktemp("files"), suffix)
    data = bytearray(path.read_bytes())
    data[int(where * len(data))] ^= 1 << bit
    path.write_bytes(data)
    try:
        back = load_dataset(path)
    except UnknownFileError:
        return
    assert back == ds


def test_one_episode_can_be_saved_as_a_dataset(tmp_path):
    episode = Trajectory(np.arange(6.0).reshape(3, 2), context={"task": "reach"}, id="only")
    path = saved(TrajectoryDataset([episode]), tmp_path, ".npz")
    np.testing.assert_equal(load_dataset(path)[0].to_dict(), episode.to_dict())
