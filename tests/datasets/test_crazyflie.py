"""Flights with gains: from synthetic logs of known content, and the real tables."""

import hashlib
import lzma
import time
import tracemalloc

import numpy as np
import pandas as pd
import pytest

from tests.datasets.usd_files import usd_log
from trajlearn.datasets import crazyflie, load_crazyflie_gains
from trajlearn.datasets._crazyflie_logs import GAINS, _facts, decode_flight
from trajlearn.exceptions import UnknownFileError

INTEGERS = [
    f"{group}.{axis}"
    for group in ("stateEstimateZ", "ctrltargetZ")
    for axis in ("x", "y", "z", "vx", "vy", "vz")
]
FLOATS = [f"ctrlLee.{name}{axis}" for name in ("rpy", "omega", "torque") for axis in "xyz"]
FLOATS += ["ctrlLee.thrustSI"]
VARIABLES = [(name, "h") for name in INTEGERS] + [(name, "f") for name in FLOATS]


def bump(time):
    """Out and back by a metre in 3.6 s, smooth."""
    phase = np.clip(time / 3.6, 0, 1)
    return 64 * (phase * (1 - phase)) ** 3


def signals(t, *, start, kind="line_y", scale=1.0, height=1000, rate=0.0):
    """The variables of a flight at the times t [s], in the units of the log."""
    out, step = {name: np.zeros(len(t)) for name in (*INTEGERS, *FLOATS)}, 1e-5
    at = (t - start) / scale
    for axis in {"line_x": "x", "line_y": "y", "figure8": "xy", "hover": ""}[kind]:
        out[f"ctrltargetZ.{axis}"] = 1e3 * bump(at)
        out[f"ctrltargetZ.v{axis}"] = 1e3 * (bump(at + step) - bump(at - step)) / 2 / step / scale
        out[f"stateEstimateZ.{axis}"] = 1e3 * bump(at - 0.1)
    out["ctrltargetZ.z"] += height
    for i, axis in enumerate("xyz"):
        out[f"stateEstimateZ.v{axis}"] = 100 * (i + 1) + 10 * np.sin(t + i)
        out[f"ctrlLee.rpy{axis}"] = 0.1 * (i + 1) + 0.01 * t
        out[f"ctrlLee.omega{axis}"] = rate + 0.2 * (i + 1) + 0.01 * t
        out[f"ctrlLee.torque{axis}"] = 1e-4 * (i + 1) + 1e-5 * t
    out["ctrlLee.thrustSI"] = 0.24 + 0.01 * t
    return out


def write_log(path, values, t, *, variables=VARIABLES):
    """A log whose card stalls for 0.3 s before t = 0, as the real ones do."""
    kinds = [(0, "fixedFrequency", variables), (1, "other", [("pm.vbat", "f")])]
    ticks = np.concatenate([-0.316 + 0.004 * np.arange(4), t]) + 10.0
    events = [(1, 9_000_000, [3.7])]
    for i, tick in enumerate(ticks):
        row = [values[name][i - 4] if i >= 4 else -1 for name, _ in variables]
        row = [int(x) if letter == "h" else float(x) for x, (_, letter) in zip(row, variables)]
        events.append((0, round(tick * 1e6), row))
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_bytes(usd_log(kinds, events))


def write_gains(folder, number, mass=0.0375):
    """Gains that differ from each other and from flight to flight."""
    gains = {name: 1.0 + i + 0.001 * int(number) for i, name in enumerate(GAINS)}
    lines = ["trajectory: translation_x.csv", "timescale: 0.75", "motors: some motors (CF)"]
    lines += [f"{name}: {value}" for name, value in gains.items()] + [f"mass: {mass}"]
    (folder / "info").mkdir(exist_ok=True)
    (folder / "info" / f"info{number}.yaml").write_text("\n".join(lines) + "\n")
    return [*gains.values(), mass]


T = np.arange(0, 5, 0.004)
FLIGHTS = {
    "log09": {"start": 0.5},
    "log10": {"start": 0.6137},
    "log10_2": {"start": -0.4},
    "log101": {"start": 0.3, "scale": 0.75},
    "log99": {"start": 0.7, "kind": "line_x"},
    "log98": {"start": 0.7, "kind": "figure8", "rate": 4.0},
    "log97": {"start": 0.7, "kind": "hover"},
    "log146": {"start": 0.52, "rate": 9.0},
    "log150": {"start": 0.43, "height": 0},
    "log150_y": {"start": 0.47},
    "log201": {"start": 0.5},
}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A checkout with eleven short flights."""
    folder = tmp_path_factory.mktemp("source")
    for name, settings in FLIGHTS.items():
        write_log(folder / "logs" / name, signals(T, **settings), T)
        write_gains(folder, name.removeprefix("log").split("_")[0])
    (folder / "logs" / "notes.txt").write_text("not a log")
    return folder


def test_which_flights_come_and_in_which_order(source):
    names = ["log09", "log10", "log10_2", "log98", "log99", "log150_y"]
    assert load_crazyflie_gains(source).ids.tolist() == [*names[:3], "log97", *names[3:]]
    lines = load_crazyflie_gains(source, kinds=["line_x", "line_y"])
    assert lines.ids.tolist() == ["log09", "log10", "log10_2", "log99", "log150_y"]
    assert load_crazyflie_gains(source, kinds="figure8").ids.tolist() == ["log98"]
    everything = load_crazyflie_gains(source, clean=False, other_time_scales=True)
    assert everything.ids.tolist() == [
        *("log09", "log10", "log10_2", "log97", "log98", "log99", "log101"),
        *("log146", "log150", "log150_y"),
    ]
    assert everything.group.tolist() == [9, 10, 10, 97, 98, 99, 101, 146, 150, 150]


def test_values_are_in_si_units_on_the_grid_after_the_stall(source):
    ds = load_crazyflie_gains(source, kinds="line_y")
    episode = ds[1]
    t = 0.02 * np.arange(250)
    np.testing.assert_allclose(episode.times, t, atol=1e-9)
    state = dict(zip(ds.state_names, episode.states.T, strict=True))
    np.testing.assert_allclose(state["y"], bump(t - 0.6137 - 0.1), atol=1.001e-3)
    np.testing.assert_array_equal(state["x"], 0)
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(
            state[f"v{axis}"], 0.1 * (i + 1) + 0.01 * np.sin(t + i), atol=1.001e-3
        )
        np.testing.assert_allclose(state[f"w{axis}"], 0.2 * (i + 1) + 0.01 * t, atol=1e-6)
        angle = ("roll", "pitch", "yaw")[i]
        np.testing.assert_allclose(state[angle], 0.1 * (i + 1) + 0.01 * t, atol=1e-6)
    action = dict(zip(ds.action_names, episode.actions.T, strict=True))
    assert len(action["thrust"]) == 249
    np.testing.assert_allclose(action["thrust"], 0.24 + 0.01 * t[:-1], atol=1e-6)
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(action[f"t{axis}"], 1e-4 * (i + 1) + 1e-5 * t[:-1], atol=1e-8)
    reference = dict(zip(ds.reference_names, episode.references.T, strict=True))
    np.testing.assert_allclose(reference["ry"], bump(t - 0.6137), atol=1.001e-3)
    np.testing.assert_allclose(reference["rvy"], np.gradient(bump(t - 0.6137), t), atol=0.02)
    np.testing.assert_array_equal(reference["rz"], 1.0)


def test_gains_mass_and_context(source):
    ds = load_crazyflie_gains(source, clean=False)
    assert ds.param_names == (*GAINS, "mass")
    assert GAINS[:4] == ("Kpos_Px", "Kpos_Py", "Kpos_Pz", "Kpos_Ix")
    gains = dict(zip(ds.param_names, ds.params[ds.ids.tolist().index("log146")]))
    expected = {name: 1.0 + i + 0.146 for i, name in enumerate(GAINS)} | {"mass": 0.0375}
    assert gains == pytest.approx(expected)
    kinds, motors = ds.context["kind"], ds.context["motors"]
    for name, kind, motor in zip(ds.ids, kinds, motors, strict=True):
        assert kind == FLIGHTS[name].get("kind", "line_y")
        assert motor == ("standard" if int(name[3:].split("_")[0]) > 145 else "upgraded")


def test_the_facts_of_each_flight(source):
    ds, info = load_crazyflie_gains(source, clean=False, other_time_scales=True, return_info=True)
    assert info.index.tolist() == ds.ids.tolist()
    assert info.index[info["suspect"]].tolist() == ["log146"]
    assert info.index[~info["airborne_only"]].tolist() == ["log150"]
    assert info.index[info["violent"]].tolist() == ["log98", "log146"]
    assert info.index[~info["start_logged"]].tolist() == ["log10_2", "log97"]
    assert info["time_scale"]["log101"] == pytest.approx(0.75, abs=1e-3)
    others = info.drop("log101")
    assert (others["time_scale"] == 1).tolist() == [kind != "hover" for kind in others["kind"]]
    np.testing.assert_array_equal(info["time_origin"], ds.time_origin)
    lines = others.query("kind == 'line_y'")
    starts = [FLIGHTS[name]["start"] for name in lines.index]
    assert np.ptp(lines["time_origin"] - starts) < 1e-3
    assert np.isnan(info["time_origin"]["log97"])
    rates = np.array([0.2, 0.4, 0.6]) + 0.01 * 0.02 * np.arange(250)[:, None]
    expected = np.sqrt(np.mean(np.sum(rates**2, axis=1)))
    assert info["rate_rms"]["log09"] == pytest.approx(expected, rel=1e-5)


def test_a_log_that_lacks_a_variable_is_left_out_and_named(source, tmp_path):
    few = [(name, letter) for name, letter in VARIABLES if name != "ctrlLee.omegay"]
    values = signals(T, start=0.5)
    write_log(tmp_path / "logs" / "log20", values, T, variables=few)
    write_gains(tmp_path, "20")
    message = r"log20 lacks the variables \['ctrlLee.omegay'\]; it has .*'ctrlLee.omegax'"
    with pytest.raises(UnknownFileError, match=message):
        load_crazyflie_gains(tmp_path)
    write_log(tmp_path / "logs" / "log21", values, T)
    write_gains(tmp_path, "21")
    write_log(tmp_path / "logs" / "log22", values, T)
    with pytest.warns(
        UserWarning, match=rf"2 of 3 logs are left out \(log20, log22\); .*{message}"
    ):
        ds = load_crazyflie_gains(tmp_path)
    assert ds.ids.tolist() == ["log21"]


def test_gains_that_are_missing_or_no_numbers_are_named(tmp_path):
    write_log(tmp_path / "logs" / "log20", signals(T, start=0.5), T)
    (tmp_path / "info").mkdir()
    with pytest.raises(UnknownFileError, match=r"info20.yaml is missing"):
        load_crazyflie_gains(tmp_path)
    write_gains(tmp_path, "20", mass="heavy")
    with pytest.raises(UnknownFileError, match=r"info20.yaml lacks a gain .*heavy"):
        load_crazyflie_gains(tmp_path)


def test_other_events_and_times_that_go_back_are_refused(tmp_path):
    path = tmp_path / "log20"
    path.write_bytes(usd_log([(0, "estPosition", [("a", "f")])], []))
    with pytest.raises(
        UnknownFileError, match=r"no event 'fixedFrequency'; it has \['estPosition'\]"
    ):
        decode_flight(path, 0.02)
    back = np.where(np.arange(len(T)) == 700, T - 1, T)
    write_log(path, signals(T, start=0.5), back)
    with pytest.raises(UnknownFileError, match="times that go back"):
        decode_flight(path, 0.02)


@pytest.fixture
def three(tmp_path):
    """A folder with three sound flights, of which a test spoils log21."""
    for name, start in (("20", 0.5), ("21", 0.6), ("22", 0.7)):
        write_log(tmp_path / "logs" / f"log{name}", signals(T, start=start), T)
        write_gains(tmp_path, name)
    return tmp_path


def flip_a_bit(folder):
    path = folder / "logs" / "log21"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x40
    path.write_bytes(content)


def lose_a_value(folder):
    values = signals(T, start=0.6)
    values["ctrlLee.torquex"][500] = np.nan
    write_log(folder / "logs" / "log21", values, T)


def stall(folder, seconds=1.0):
    keep = (T < 2) | (2 + seconds <= T)
    values = {name: x[keep] for name, x in signals(T, start=0.6).items()}
    write_log(folder / "logs" / "log21", values, T[keep])


def garble_the_gains(folder):
    (folder / "info" / "info21.yaml").write_bytes(b"\xff\xfe\x00bad")


def make_a_gain_infinite(folder):
    path = folder / "info" / "info21.yaml"
    path.write_text(path.read_text() + "KR_x: inf\nKw_z: nan\n")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (flip_a_bit, r"log21, byte \d+: .*damaged"),
        (lose_a_value, "log21 has missing or infinite values of ctrlLee.torquex"),
        (stall, r"log21 has no samples for 1\.0\d s after (1\.99|2\.00) s of flight"),
        (garble_the_gains, r"info21\.yaml is not UTF-8 text"),
        (make_a_gain_infinite, r"info21\.yaml has no finite number for KR_x, Kw_z"),
    ],
    ids=["bit", "nan", "stall", "text", "gain"],
)
def test_a_bad_flight_is_left_out_and_named(three, spoil, message):
    spoil(three)
    with pytest.warns(
        UserWarning, match=rf"1 of 3 logs are left out \(log21\); the first: .*{message}"
    ):
        ds = load_crazyflie_gains(three)
    assert ds.ids.tolist() == ["log20", "log22"]


def test_a_log_whose_end_was_lost_and_a_short_gap_are_read(three):
    path = three / "logs" / "log20"
    path.write_bytes(path.read_bytes()[:-1000])
    stall(three, 0.08)
    with pytest.warns(UserWarning, match="log20 has no valid checksum: reading") as caught:
        ds = load_crazyflie_gains(three)
    assert len(caught) == 1
    assert ds.ids.tolist() == ["log20", "log21", "log22"]
    assert ds.lengths[0] < ds.lengths[1] == ds.lengths[2]


def test_only_kinds_that_were_asked_for_must_log_the_whole_motion(three):
    write_log(three / "logs" / "log21", signals(T, start=-0.5, kind="figure8"), T)
    assert load_crazyflie_gains(three, kinds="line_y").ids.tolist() == ["log20", "log22"]
    with pytest.raises(ValueError, match=r"flights of kind 'figure8' cannot .* the whole motion"):
        load_crazyflie_gains(three)


@pytest.fixture
def tables(source, tmp_path, monkeypatch):
    """The derived tables of the synthetic flights, which the loader takes for the real ones."""
    from trajlearn.datasets._crazyflie_logs import read_crazyflie_logs

    hashes = {}
    for name, table in zip(crazyflie._SHA256, read_crazyflie_logs(source, 0.02)):
        table.to_csv(tmp_path / name, index=False)
        hashes[name] = hashlib.sha256(table.to_csv(index=False).encode()).hexdigest()
    monkeypatch.setattr(crazyflie, "_SHA256", hashes)
    return tmp_path


def test_tables_and_logs_give_the_same(tables, source):
    a, b = (load_crazyflie_gains(folder, clean=False) for folder in (tables, source))
    assert a.ids.tolist() == b.ids.tolist()
    np.testing.assert_allclose(a.states, b.states, atol=1e-12)
    np.testing.assert_allclose(a.time_origin, b.time_origin, atol=1e-9)
    np.testing.assert_array_equal(a.params, b.params)


@pytest.mark.parametrize("name", list(crazyflie._SHA256))
def test_a_changed_table_is_refused(tables, name):
    path = tables / name
    data = path.read_bytes()
    if path.suffix == ".xz":
        path.write_bytes(data[:-40])
    else:
        path.write_bytes(data.replace(b"0.0375", b"0.0376", 1))
    with pytest.raises(UnknownFileError, match=f"{name} (was changed|is not a sound .xz)"):
        load_crazyflie_gains(tables)


@pytest.mark.parametrize("name", list(crazyflie._SHA256))
def test_a_table_is_unpacked_up_to_a_bound_only(tables, name, monkeypatch):
    monkeypatch.setattr(crazyflie, "_MAX_BYTES", 2_000_000)
    load_crazyflie_gains(tables)
    monkeypatch.setattr(crazyflie, "_MAX_BYTES", 1000 if name == "flights.csv" else 500_000)
    if name == "flights.csv":
        with (tables / name).open("r+b") as handle:
            handle.truncate(100_000_000)
    else:
        bomb = lzma.compress(bytes(100_000_000), preset=0)
        assert len(bomb) < 500_000
        (tables / name).write_bytes(bomb)
    tracemalloc.start()
    with pytest.raises(UnknownFileError, match=f"{name} is another file: .* more than"):
        load_crazyflie_gains(tables)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10_000_000


def test_downloads_come_from_the_fixed_commit(source, tmp_path, monkeypatch):
    asked = []

    def fetch_archive(url, folder, **settings):
        asked.append((url, folder, settings))
        return source

    monkeypatch.setattr(crazyflie, "fetch_archive", fetch_archive)
    ds = load_crazyflie_gains(data_home=tmp_path, verbose=1)
    assert ds == load_crazyflie_gains(source)
    ((url, folder, settings),) = asked
    assert url == (
        "https://github.com/IMRCLab/crazyswarm2-tools/archive/"
        "847605ab2d2d7ed5040ab0c7d2c7116c047b4de5.tar.gz"
    )
    assert folder.parent == tmp_path
    assert settings == {"download_if_missing": True, "verbose": 1}


def test_missing_folders_and_unknown_kinds_are_named(tmp_path):
    with pytest.raises(OSError, match="download_if_missing=False"):
        load_crazyflie_gains(data_home=tmp_path, download_if_missing=False)
    with pytest.raises(ValueError, match="nowhere' is not a folder"):
        load_crazyflie_gains(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"neither the derived tables .* nor the folders logs"):
        load_crazyflie_gains(tmp_path)
    with pytest.raises(ValueError, match=r"kinds='spiral' must be among .*figure8"):
        load_crazyflie_gains(tmp_path, kinds="spiral")
    with pytest.raises(ValueError, match="must be among"):
        load_crazyflie_gains(tmp_path, kinds=[])


def test_nothing_left_is_an_error(tables, monkeypatch):
    frame = pd.read_csv(tables / "flights.csv").assign(suspect=True)
    frame.to_csv(tables / "flights.csv", index=False)
    content = (tables / "flights.csv").read_bytes()
    monkeypatch.setitem(crazyflie._SHA256, "flights.csv", hashlib.sha256(content).hexdigest())
    with pytest.raises(ValueError, match=r"no flight .*clean=False"):
        load_crazyflie_gains(tables)


# -- the real tables ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(data_folder):
    return data_folder("crazyflie_lee_gains")


@pytest.fixture(scope="module")
def real(folder):
    return load_crazyflie_gains(folder, return_info=True)


@pytest.mark.data
def test_real_counts(folder, real):
    ds, info = real
    assert repr(ds).startswith("TrajectoryDataset(n=161,")
    assert repr(ds).endswith("d_s=12, d_a=4, p=19, d_r=6, groups=127)")
    assert info.groupby(["kind", "motors"]).size().to_dict() == {
        ("figure8", "upgraded"): 26,
        ("line_x", "upgraded"): 26,
        ("line_y", "standard"): 25,
        ("line_y", "upgraded"): 84,
    }
    every, facts = load_crazyflie_gains(
        folder, clean=False, other_time_scales=True, return_info=True
    )
    assert len(every) == 176
    clean = facts[facts["airborne_only"] & ~facts["suspect"]]
    assert len(clean) == 166
    odd = clean["time_scale"][clean["time_scale"] != 1]
    assert odd.round(2).to_dict() == {
        "log66": 1.33,
        "log67": 1.33,
        "log70_y": 1.33,
        "log75": 0.75,
        "log76": 0.67,
    }
    assert {"log149", "log113", "log78", "log115"} < set(info.index[info["violent"]])
    assert info["violent"].sum() == 7
    assert info["start_logged"].sum() == 102


@pytest.mark.data
def test_real_tables_are_taken_over(folder, real):
    ds, _ = real
    flights = pd.read_csv(folder / "flights.csv").set_index("flight").loc[ds.ids]
    np.testing.assert_array_equal(ds.params, flights[list(ds.param_names)])
    np.testing.assert_array_equal(ds.group, flights["experiment"])
    assert (np.diff(ds.group) >= 0).all()
    np.testing.assert_array_equal(ds.context["kind"], flights["kind"])
    # A motor set and the gains belong to an experiment.
    for experiment in np.unique(ds.group):
        rows = ds.group == experiment
        assert len(np.unique(ds.params[rows], axis=0)) == 1
        assert len(np.unique(ds.context["motors"][rows])) == 1


@pytest.mark.data
def test_what_is_judged_from_logs_agrees_with_the_tables(folder):
    flights = pd.read_csv(folder / "flights.csv").set_index("flight")
    samples = pd.read_csv(folder / "flights_50hz.csv.xz")
    judged = pd.DataFrame(
        {name: _facts(table) for name, table in samples.groupby("flight", sort=False)}
    ).T
    for name in ("kind", "airborne_only", "suspect"):
        assert judged[name].tolist() == flights[name].tolist()


@pytest.mark.data
def test_real_references_match_their_path(real):
    _, info = real
    assert info["residual"].max() < 3e-3
    assert (info.groupby("kind")["residual"].median() < 2e-3).all()
    assert np.isfinite(info["time_origin"]).all()


@pytest.mark.data
def test_origins_are_right_where_the_tables_are_wrong(folder, real):
    ds, info = real
    flights = pd.read_csv(folder / "flights.csv").set_index("flight").loc[ds.ids]
    lag = flights["ref_off_s"] - info["time_origin"]
    lag -= lag.groupby(info["kind"]).transform("median")
    wrong = {"log08", "log10", "log12", "log13", "log15", "log16", "log18", "log21", "log29"}
    assert set(lag.index[lag.abs() > 0.5]) == (wrong | {"log73"}) & set(ds.ids)
    assert lag[lag.abs() <= 0.5].abs().max() < 0.06
    # Independently: at one phase all references of a kind are at one place.
    for kind, column, phase in (("figure8", 0, 1.0), ("line_x", 0, 1.5), ("line_y", 1, 1.3)):
        places = [
            np.interp(phase + e.time_origin, e.times, e.references[:, column])
            for e in ds[info["kind"].to_numpy() == kind]
        ]
        assert np.ptp(places) < 0.012, kind


@pytest.mark.data
def test_aligned_flights_are_close_to_their_mean(real):
    ds, info = real
    chosen = (info["kind"] == "line_y") & (info["motors"] == "upgraded")
    ds = ds[chosen.to_numpy()]

    def rmse(origins, phase):
        curves = [
            np.interp(phase + o, e.times, e.states[:, 1], left=np.nan, right=np.nan)
            for e, o in zip(ds, origins)
        ]
        return np.sqrt(np.nanmean((curves - np.nanmean(curves, axis=0)) ** 2))

    assert rmse(ds.time_origin, np.arange(0, 4.0, 0.02)) < 0.026
    assert rmse(np.zeros(len(ds)), np.arange(0, 4.0, 0.02)) > 0.12


@pytest.mark.data
def test_real_states_are_consistent(real):
    ds, _ = real
    for position, speed in (("x", "vx"), ("y", "vy"), ("roll", "wx"), ("pitch", "wy")):
        i, j = ds.state_names.index(position), ds.state_names.index(speed)
        slope = np.concatenate([np.gradient(e.states[:, i], 0.02)[1:-1] for e in ds])
        logged = np.concatenate([e.states[1:-1, j] for e in ds])
        assert np.corrcoef(slope, logged)[0, 1] > 0.99, (position, speed)


@pytest.mark.data
def test_loading_takes_seconds(folder):
    begin = time.process_time()
    load_crazyflie_gains(folder)
    assert time.process_time() - begin < 5
