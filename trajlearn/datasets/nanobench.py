"""Trefoil flights of a Crazyflie under its default PID and under the Mellinger controller."""

import io
from pathlib import Path
from typing import Literal

import numpy as np

from trajlearn.datasets._fetch import RemoteFile, fetch, get_data_home
from trajlearn.datasets._local import read_checked, require_folder
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["load_nanobench_trefoil"]

_SOURCE = (
    "https://raw.githubusercontent.com/syediu/nanobench-iros2026/"
    "0ae7d689749db174dc779ab2f7c416cc12e14e2b/"
)
_IN_SOURCE = "benchmarks/task3_stateEst/{controller}_trefoil/{file}"
# Where a file may lie in the folder that the user names: as we keep it, packed beside the
# repository, and in a checkout of the source.
_LAYOUTS = (
    "{controller}/{file}",
    "{controller}/{file}.xz",
    "raw/{controller}/{file}.xz",
    _IN_SOURCE,
)
_SHA256 = {
    "pid": (
        "db2d70b006a8469bce4b7ba26ce84d0ba7b944d5a75389f18b13f473a66b0c7a",
        "755c754c75eb3f9b8d6a7bcfda9210052b23e93bb25a6341289b8e55e821de49",
        "b0a9b6e1837eb17f2bf79ac57bfc08baa81097ef7d0edf009e8a5c3b5e2c9567",
    ),
    "mellinger": (
        "286cddc222807ec2c4528aab1180d25a12a06cdf98a706a0ae6adfb8d406c3b1",
        "691d9a27322413ab12486752dd9160f4727fdad19118bedfb19d67859ebce917",
        "405768be217cd69a6c4b5728a2e7e6a17d0018c0ed813aaba7cfe20a93a1f22d",
    ),
}
# of a file, unpacked; each has 1.3 MB
_MAX_BYTES = 8 << 20
_STATES = {
    "x": "px",
    "y": "py",
    "z": "pz",
    "vx": "vx",
    "vy": "vy",
    "vz": "vz",
    "roll": "roll",
    "pitch": "pitch",
    "yaw": "yaw",
    "wx": "wx_vicon",
    "wy": "wy_vicon",
    "wz": "wz_vicon",
}
_ACTIONS = {f"m{i}": f"motor_motor_m{i}" for i in range(1, 5)}
_REFERENCES = {f"r{name}": f"sp_ctrltarget_{name}" for name in ("x", "y", "z", "yaw")}
# Take-off and the way to the trefoil; the jump of the reference at its end, and the landing.
_CUT_START_S, _CUT_END_S = 4.0, 2.5


def load_nanobench_trefoil(
    path: str | Path | None = None,
    *,
    data_home: str | Path | None = None,
    download_if_missing: bool = True,
    controller: Literal["pid", "mellinger"] | None = "pid",
    window: int | None = 1000,
    verbose: int = 0,
) -> TrajectoryDataset:
    """Load six real flights of a Crazyflie 2.1 along a trefoil, 100 Hz, motion capture.

    The nearest public data to the paper's hardware test: a quadrotor under its default PID,
    windows of 1,000 steps. The factory gains do not change, so there is no theta, and six flights
    are for smoke tests, not for learning curves. The first 4 s (take-off) and the last
    2.5 s (landing) are left out.

    Parameters
    ----------
    path : str or Path, optional
        A folder with the files: ``<controller>/<file>.csv`` or ``.csv.xz``, also below ``raw/``,
        or a checkout of the source. By default they are downloaded.
    data_home : str or Path, optional
        Where downloads are kept; see `get_data_home`.
    download_if_missing : bool, default=True
        With False, an error instead of a download.
    controller : {"pid", "mellinger"} or None, default="pid"
        None for both, three flights each.
    window : int or None, default=1000
        Steps of an episode; flights are tiled with windows and the rest is left out. None for
        whole flights, about 1,350 steps each.
    verbose : int, default=0
        With 1, progress of downloads.

    Returns
    -------
    TrajectoryDataset
        - states (12): x y z [m], vx vy vz [m/s], roll pitch yaw [rad, yaw without jumps],
          wx wy wz [rad/s], all from motion capture (smoothed by the source);
        - actions (4): m1 ... m4, PWM of the motors, 0 to 65535;
        - references (4): rx ry rz [m] and ryaw [rad], the set-point, as the radio brought it: it
          lags and jumps by some samples, differently in each flight;
        - context ``controller``; group and ids: the flight (windows: ``<flight>:<start>``);
        - times [s] and time_origin: since the log began, at take-off.

    Raises
    ------
    UnknownFileError
        A file's SHA-256 is not that of the source.
    ValueError
        A folder without the files, or an unknown controller.
    OSError
        If a file cannot be downloaded.

    Notes
    -----
    Source: S. I. Ullah and J. Baca, NanoBench, arXiv:2603.09908,
    https://github.com/syediu/nanobench-iros2026, BSD 3-Clause licence. Angles of the motion
    capture are in radians there, against what the source says; the yaw of the set-point is in
    degrees, and is converted.

    Examples
    --------
    >>> ds = load_nanobench_trefoil(path)  # doctest: +SKIP
    >>> ds  # doctest: +SKIP
    TrajectoryDataset(n=3, steps=1000, d_s=12, d_a=4, d_r=4, groups=3)
    """
    if controller not in (*_SHA256, None):
        raise ValueError(f"controller={controller!r} must be one of {list(_SHA256)} or None.")
    controllers = list(_SHA256) if controller is None else [controller]
    files = {
        (name, f"B9_trefoil_slow_rep{i}.csv"): sha256
        for name in controllers
        for i, sha256 in enumerate(_SHA256[name], start=1)
    }
    if path is None:
        remote = [
            RemoteFile(
                f"{name}/{file}", _SOURCE + _IN_SOURCE.format(controller=name, file=file), sha256
            )
            for (name, file), sha256 in files.items()
        ]
        folder = fetch(
            remote,
            get_data_home(data_home) / "nanobench_trefoil",
            download_if_missing=download_if_missing,
            verbose=verbose,
        )
    else:
        folder = require_folder(path)
    flights = [_read(_find(folder, name, file), sha256) for (name, file), sha256 in files.items()]
    names = [name for name, _ in files]
    ids = [f"{name}_{file.removesuffix('.csv').split('_')[-1]}" for name, file in files]
    ds = TrajectoryDataset.from_arrays(
        [flight["states"] for flight in flights],
        actions=[flight["actions"][:-1] for flight in flights],
        references=[flight["references"] for flight in flights],
        times=[flight["times"] for flight in flights],
        time_origin=np.zeros(len(flights)),
        context={"controller": names},
        group=ids,
        ids=ids,
        state_names=list(_STATES),
        action_names=list(_ACTIONS),
        reference_names=list(_REFERENCES),
    )
    return ds if window is None else ds.window(window)


def _find(folder: Path, controller: str, file: str) -> Path:
    places = [folder / layout.format(controller=controller, file=file) for layout in _LAYOUTS]
    for place in places:
        if place.is_file():
            return place
    raise ValueError(
        f"{folder} has no flight {file} of the controller {controller!r}; looked for "
        f"{', '.join(str(place.relative_to(folder)) for place in places)}."
    )


def _read(path: Path, sha256: str) -> dict[str, np.ndarray]:
    import pandas as pd

    table = pd.read_csv(io.BytesIO(read_checked(path, sha256, _MAX_BYTES)))
    # Unix times leave 0.2 us of round-off.
    times = np.round((table["t"] - table["t"].iloc[0]).to_numpy(), 6)
    keep = (times >= _CUT_START_S) & (times <= times[-1] - _CUT_END_S)
    table["yaw"] = np.unwrap(table["yaw"])
    table[_REFERENCES["ryaw"]] = np.deg2rad(table[_REFERENCES["ryaw"]])
    columns = {"states": _STATES, "actions": _ACTIONS, "references": _REFERENCES}
    return {
        "times": times[keep],
        **{
            field: table.loc[keep, list(names.values())].to_numpy(dtype=np.float64)
            for field, names in columns.items()
        },
    }
