"""Trefoil flights: what is kept of a log, where it may lie, and the real files."""

import hashlib
import lzma
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from trajlearn.datasets import load_nanobench_trefoil, nanobench
from trajlearn.exceptions import UnknownFileError

NAMES = [(c, f"B9_trefoil_slow_rep{i}.csv") for c in ("pid", "mellinger") for i in (1, 2, 3)]


def log(seed):
    """A log of 8 s whose columns all differ, with the columns that nobody asked for."""
    rng = np.random.default_rng(seed)
    columns = [
        *("px", "py", "pz", "vx", "vy", "vz", "roll", "pitch", "yaw"),
        *("wx_vicon", "wy_vicon", "wz_vicon", "imu_acc_x", "est_stateEstimate_x"),
        *(f"motor_motor_m{i}" for i in range(1, 5)),
        *(f"sp_ctrltarget_{axis}" for axis in ("x", "y", "z", "yaw")),
    ]
    table = pd.DataFrame(rng.normal(size=(801, len(columns))), columns=columns)
    table.insert(0, "t", 1.77e9 + 0.01 * np.arange(801))
    table["yaw"] = (np.linspace(3.0, 3.5, 801) + np.pi) % (2 * np.pi) - np.pi
    return table


@pytest.fixture
def logs(monkeypatch):
    """Six logs by name, which the loader takes for the real ones."""
    logs = {name: log(seed) for seed, name in enumerate(NAMES)}
    hashes = {}
    for (controller, _), table in logs.items():
        content = table.to_csv(index=False).encode()
        hashes.setdefault(controller, []).append(hashlib.sha256(content).hexdigest())
    monkeypatch.setattr(nanobench, "_SHA256", hashes)
    return logs


def place(logs, layout, folder):
    for (controller, file), table in logs.items():
        path = folder / layout.format(controller=controller, file=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = table.to_csv(index=False).encode()
        path.write_bytes(lzma.compress(content, preset=0) if path.suffix == ".xz" else content)


def test_each_column_reaches_its_place_and_the_ends_are_cut(logs, tmp_path):
    place(logs, "{controller}/{file}", tmp_path)
    ds = load_nanobench_trefoil(tmp_path, window=None)
    assert len(ds) == 3
    table = logs["pid", "B9_trefoil_slow_rep2.csv"].iloc[400:551]
    episode = ds[1]
    np.testing.assert_allclose(episode.times, np.arange(400, 551) / 100, atol=1e-6)
    expected = ["px", "py", "pz", "vx", "vy", "vz", "roll", "pitch", None]
    expected += ["wx_vicon", "wy_vicon", "wz_vicon"]
    for name, column, values in zip(ds.state_names, expected, episode.states.T, strict=True):
        if name == "yaw":
            # Past pi, where the log jumps to -pi.
            np.testing.assert_allclose(values, np.linspace(3.0, 3.5, 801)[400:551], atol=1e-9)
            assert values[-1] > np.pi
        else:
            np.testing.assert_array_equal(values, table[column], err_msg=name)
    motors = [f"motor_motor_m{i}" for i in range(1, 5)]
    np.testing.assert_array_equal(episode.actions, table[motors].to_numpy()[:-1])
    targets = [f"sp_ctrltarget_{axis}" for axis in ("x", "y", "z", "yaw")]
    expected = table[targets].to_numpy() * [1, 1, 1, np.pi / 180]
    np.testing.assert_allclose(episode.references, expected, rtol=1e-12)
    assert ds.reference_names == ("rx", "ry", "rz", "ryaw")
    assert ds.ids.tolist() == ds.group.tolist() == ["pid_rep1", "pid_rep2", "pid_rep3"]
    assert ds.time_origin.tolist() == [0, 0, 0]
    assert not ds.has_params


def test_windows_and_controllers(logs, tmp_path):
    place(logs, "{controller}/{file}", tmp_path)
    both = load_nanobench_trefoil(tmp_path, controller=None, window=70)
    assert both.lengths.tolist() == [70] * 12
    assert both.context["controller"].tolist() == ["pid"] * 6 + ["mellinger"] * 6
    assert len(set(both.group)) == 6
    one = load_nanobench_trefoil(tmp_path, controller="mellinger", window=70)
    assert one == both[6:]


@pytest.mark.parametrize("layout", nanobench._LAYOUTS)
def test_every_layout_gives_the_same(logs, tmp_path, layout):
    place(logs, layout, tmp_path / "a")
    place(logs, nanobench._LAYOUTS[0], tmp_path / "b")
    a, b = (load_nanobench_trefoil(tmp_path / name, window=None) for name in "ab")
    assert a == b


def test_downloads_go_to_the_data_home_and_come_from_the_fixed_commit(logs, tmp_path, monkeypatch):
    asked = []

    def fetch(files, folder, **settings):
        asked.extend(files)
        place(logs, "{controller}/{file}", Path(folder))
        return folder

    monkeypatch.setattr(nanobench, "fetch", fetch)
    ds = load_nanobench_trefoil(data_home=tmp_path, window=None)
    assert ds == load_nanobench_trefoil(tmp_path / "nanobench_trefoil", window=None)
    assert [file.name for file in asked] == [f"{c}/{name}" for c, name in NAMES[:3]]
    assert asked[0].url == (
        "https://raw.githubusercontent.com/syediu/nanobench-iros2026/"
        "0ae7d689749db174dc779ab2f7c416cc12e14e2b/"
        "benchmarks/task3_stateEst/pid_trefoil/B9_trefoil_slow_rep1.csv"
    )
    assert [file.sha256 for file in asked] == nanobench._SHA256["pid"]


def test_without_leave_nothing_is_downloaded(tmp_path):
    with pytest.raises(OSError, match="download_if_missing=False"):
        load_nanobench_trefoil(data_home=tmp_path, download_if_missing=False)


@pytest.mark.parametrize("suffix", ["", ".xz"])
def test_a_changed_file_is_refused(logs, tmp_path, suffix):
    logs["pid", "B9_trefoil_slow_rep3.csv"].loc[500, "px"] += 1e-3
    place(logs, "{controller}/{file}" + suffix, tmp_path)
    with pytest.raises(UnknownFileError, match=r"slow_rep3.csv.* was changed .* SHA-256"):
        load_nanobench_trefoil(tmp_path)


def test_a_damaged_archive_is_refused(logs, tmp_path):
    place(logs, "{controller}/{file}.xz", tmp_path)
    path = tmp_path / "pid" / "B9_trefoil_slow_rep1.csv.xz"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(UnknownFileError, match=r"not a sound \.xz file"):
        load_nanobench_trefoil(tmp_path)


def test_missing_folders_and_files_are_named(tmp_path):
    with pytest.raises(ValueError, match="nowhere' is not a folder"):
        load_nanobench_trefoil(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"has no flight B9_trefoil_slow_rep1.csv .*'pid'.* raw/"):
        load_nanobench_trefoil(tmp_path)
    with pytest.raises(ValueError, match="controller='lee' must be one of"):
        load_nanobench_trefoil(tmp_path, controller="lee")


@pytest.mark.data
def test_real_flights(data_folder):
    folder = data_folder("nanobench_trefoil")
    ds = load_nanobench_trefoil(folder)
    assert repr(ds) == "TrajectoryDataset(n=3, steps=1000, d_s=12, d_a=4, d_r=4, groups=3)"
    whole = load_nanobench_trefoil(folder, controller=None, window=None)
    assert len(whole) == 6
    assert whole.lengths.min() > 1330
    pairs = [("x", "vx", 0.99), ("y", "vy", 0.99), ("z", "vz", 0.99), ("roll", "wx", 0.85)]
    for episode in whole:
        # The setpoint jumps where the trefoil begins and where it ends.
        assert np.abs(np.diff(episode.references[:, :3], axis=0)).max() < 0.1
        assert np.diff(episode.times) == pytest.approx(0.01, abs=1e-5)
        state = dict(zip(whole.state_names, episode.states.T))
        for position, speed, least in pairs:
            slope = np.gradient(state[position], episode.times)[1:-1]
            assert np.corrcoef(slope, state[speed][1:-1])[0, 1] > least, (episode.id, position)
        # In flight, in radians, actions in the range of a 16-bit PWM.
        assert state["z"].min() > 0.6
        assert np.abs([state[name] for name in ("roll", "pitch", "yaw")]).max() < 0.4
        assert 4e4 < episode.actions.min() < episode.actions.max() < 2**16


@pytest.mark.data
def test_times_since_take_off_are_a_phase(data_folder):
    """Flights of one controller agree at the same time; a second apart they do not."""
    ds = load_nanobench_trefoil(data_folder("nanobench_trefoil"))

    def spread(shifts):
        paths = [
            np.stack(
                [np.interp(np.arange(6, 12, 0.05) + s, e.times, e.states[:, j]) for j in (0, 1)]
            )
            for e, s in zip(ds, shifts)
        ]
        return np.std(paths, axis=0).mean()

    assert spread([0, 0, 0]) < 0.02 < 0.1 < spread([0, 0.5, 1.0])
