"""Real flights of a Crazyflie while the gains of its controller were tuned."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

import numpy as np

from trajlearn.datasets._crazyflie_logs import GAINS, read_crazyflie_logs
from trajlearn.datasets._fetch import fetch_archive, get_data_home
from trajlearn.datasets._local import read_checked, require_folder
from trajlearn.datasets.alignment import align_references
from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories.dataset import TrajectoryDataset

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["load_crazyflie_gains"]

_COMMIT = "847605ab2d2d7ed5040ab0c7d2c7116c047b4de5"
_ARCHIVE = f"https://github.com/IMRCLab/crazyswarm2-tools/archive/{_COMMIT}.tar.gz"
# SHA-256 of the derived tables, uncompressed
_SHA256 = {
    "flights.csv": "a4741b05816bb9a2f730085fe1c7f083ba0214828413ea2c306c1ba254c2f99b",
    "flights_50hz.csv.xz": "df37e65b2603c7f75770f5994c63ffaab3692b745de0debce53cd5fa06cc720f",
}
# unpacked; the larger table has 10 MB
_MAX_BYTES = 40 << 20
_KINDS = ("line_x", "line_y", "figure8", "hover")
_STATES = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "wx", "wy", "wz")
_ACTIONS = ("thrust", "tx", "ty", "tz")
_REFERENCES = ("rx", "ry", "rz", "rvx", "rvy", "rvz")
_PARAMS = (*GAINS, "mass")
_DT = 0.02
_VIOLENT = 1.0  # rad/s
# In that time from its beginning the reference moves by a millimetre, the resolution of the log.
_START_S = 0.06


@overload
def load_crazyflie_gains(
    path: str | Path | None = ...,
    *,
    data_home: str | Path | None = ...,
    download_if_missing: bool = ...,
    kinds: str | Sequence[str] | None = ...,
    clean: bool = ...,
    other_time_scales: bool = ...,
    return_info: Literal[False] = ...,
    verbose: int = ...,
) -> TrajectoryDataset: ...
@overload
def load_crazyflie_gains(
    path: str | Path | None = ...,
    *,
    data_home: str | Path | None = ...,
    download_if_missing: bool = ...,
    kinds: str | Sequence[str] | None = ...,
    clean: bool = ...,
    other_time_scales: bool = ...,
    return_info: Literal[True],
    verbose: int = ...,
) -> tuple[TrajectoryDataset, "pd.DataFrame"]: ...
def load_crazyflie_gains(
    path: str | Path | None = None,
    *,
    data_home: str | Path | None = None,
    download_if_missing: bool = True,
    kinds: str | Sequence[str] | None = None,
    clean: bool = True,
    other_time_scales: bool = False,
    return_info: bool = False,
    verbose: int = 0,
) -> "TrajectoryDataset | tuple[TrajectoryDataset, pd.DataFrame]":
    """Load real flights of a Crazyflie, each under gains of its own, 50 Hz.

    The gains of a geometric ("Lee") position and attitude controller were tuned by hand, flight
    after flight; each flies a line of 1 m out and back, or a figure of eight. Episodes come in
    the order in which they were flown: neighbours share gains, battery and wear, so that a split
    into blocks is harder, and more honest, than a random one. Split by ``ds.group``.

    Parameters
    ----------
    path : str or Path, optional
        A folder with the derived tables ``flights.csv`` and ``flights_50hz.csv.xz``, or a checkout
        of the source with its folders ``logs`` and ``info``. By default the source is downloaded.
    data_home : str or Path, optional
        Where the download is kept; see `get_data_home`.
    download_if_missing : bool, default=True
        With False, an error instead of a download.
    kinds : str or sequence of str, optional
        What was flown: "line_x", "line_y", "figure8", "hover"; default all.
    clean : bool, default=True
        Leave out flights that were logged with take-off and landing, and those that crashed,
        tumbled, turned faster than 5 rad/s or strayed more than 0.6 m. The latter selects by the
        outcome: what is left are the survivors, and what is learned from them is silent about
        gains that crash. Pass False to see all, with the facts of each in `info`.
    other_time_scales : bool, default=False
        Keep the few flights that flew the path of their kind at another speed.
    return_info : bool, default=False
        Also return the facts of each flight.
    verbose : int, default=0
        With 1, progress of the download.

    Returns
    -------
    dataset : TrajectoryDataset
        - states (12): x y z [m], vx vy vz [m/s], roll pitch yaw [rad], wx wy wz [rad/s], the
          estimates of the on-board filter: smoothing them again gains nothing;
        - actions (4): thrust [N] and torques tx ty tz [N m], as commanded, not calibrated;
        - references (6): rx ry rz [m], rvx rvy rvz [m/s], the set-point;
        - params (19): 18 gains and the mass [kg];
        - context: ``kind`` and ``motors`` ("upgraded" or "standard");
        - group: the experiment (repeats share their gains); ids: the log, such as ``log104_2``;
        - times [s] since the first sample; time_origin: when the reference begins to move, to
          about a millisecond, from the whole reference (`align_references`). It lies before the
          first sample where the log begins in the middle of the motion.
    info : DataFrame
        Only with ``return_info=True``: one row an episode, indexed by its id, with experiment,
        kind, motors, airborne_only, suspect; time_origin, start_logged (at most 60 ms of the
        motion are missing), time_scale (duration of the motion over the usual one of its kind),
        residual [m] (RMS distance of the reference from the path of its kind); rate_rms [rad/s]
        (RMS length of wx wy wz) and violent (rate_rms above 1: nearly unstable flights, which
        dominate every mean). time_origin and time_scale are NaN where the reference does not
        follow the path of its kind (hovering, broken off).

    Raises
    ------
    UnknownFileError
        A derived table was changed, or no log can be read.
    ValueError
        `path` has neither tables nor logs, a kind is unknown, no flight is left, or no flight of a
        kind asked for logs the whole motion (in parts of the source only).
    OSError
        If the source cannot be downloaded.

    Notes
    -----
    Source: Intelligent Multi-Robot Coordination Lab, TU Berlin,
    https://github.com/IMRCLab/crazyswarm2-tools, MIT licence, commit 847605a. From its binary logs
    everything up to the stall of the card at their beginning is dropped and the rest interpolated
    linearly; logs that were damaged, lack values, or stall again for more than 0.1 s are left out
    with a warning. The derived tables hold four fifths of the experiments, those of the source all.
    Kinds are judged by the logged reference: the labels of the source are wrong for many flights.
    The names and units of the logged variables are those of the source's plot settings; this
    package's decoding is tested on logs of known content, not on those of the source.

    Examples
    --------
    >>> ds, info = load_crazyflie_gains(path, kinds="line_y", return_info=True)  # doctest: +SKIP
    >>> ds[~info["violent"].to_numpy()]  # doctest: +SKIP
    """
    import pandas as pd

    wanted = _KINDS if kinds is None else (kinds,) if isinstance(kinds, str) else tuple(kinds)
    unknown = [kind for kind in wanted if kind not in _KINDS]
    if unknown or not wanted:
        raise ValueError(f"kinds={kinds!r} must be among {list(_KINDS)}.")
    if path is None:
        path = fetch_archive(
            _ARCHIVE,
            get_data_home(data_home) / "crazyflie_lee_gains",
            download_if_missing=download_if_missing,
            verbose=verbose,
        )
    flights, samples = _read_tables(require_folder(path))
    flights = flights.set_index("flight").sort_values("experiment", kind="stable")
    flights = flights[flights["kind"].isin(wanted)]
    rows = {str(flight): table for flight, table in samples.groupby("flight", sort=False)}
    info = _describe(flights, rows)
    keep = pd.Series(True, index=info.index)
    if clean:
        keep &= info["airborne_only"] & ~info["suspect"]
    if not other_time_scales:
        keep &= info["time_scale"].isna() | (info["time_scale"] == 1.0)
    if not keep.any():
        raise ValueError(
            f"no flight of {list(wanted)} is left; with clean=False there may be some."
        )
    info, flights = info[keep], flights[keep]
    parts = [rows[flight] for flight in info.index]
    ds = TrajectoryDataset.from_arrays(
        [part[list(_STATES)].to_numpy() for part in parts],
        actions=[part[list(_ACTIONS)].to_numpy()[:-1] for part in parts],
        references=[part[list(_REFERENCES)].to_numpy() for part in parts],
        params=flights[list(_PARAMS)].to_numpy(dtype=np.float64),
        times=[part["t"].to_numpy() for part in parts],
        time_origin=info["time_origin"].to_numpy(),
        context={name: info[name].tolist() for name in ("kind", "motors")},
        group=info["experiment"].tolist(),
        ids=info.index.tolist(),
        state_names=_STATES,
        action_names=_ACTIONS,
        param_names=_PARAMS,
        reference_names=_REFERENCES,
    )
    return (ds, info) if return_info else ds


def _read_tables(folder: Path) -> tuple["pd.DataFrame", "pd.DataFrame"]:
    """One row a flight and one row a sample, of all flights."""
    import pandas as pd

    if (folder / "flights.csv").is_file():
        flights, samples = (
            pd.read_csv(io.BytesIO(read_checked(folder / name, sha256, _MAX_BYTES)))
            for name, sha256 in _SHA256.items()
        )
        return flights, samples
    if (folder / "logs").is_dir() and (folder / "info").is_dir():
        return read_crazyflie_logs(folder, _DT)
    raise ValueError(
        f"{folder} holds neither the derived tables ({', '.join(_SHA256)}) nor the folders logs "
        "and info of the source. Name such a folder, or leave path out to download the source."
    )


def _describe(flights: "pd.DataFrame", rows: dict[str, "pd.DataFrame"]) -> "pd.DataFrame":
    """The facts of each flight, alignment included."""
    info = flights[["experiment", "kind", "motors", "airborne_only", "suspect"]].copy()
    for name in ("time_origin", "time_scale", "residual"):
        info[name] = np.nan
    for kind, names in info.groupby("kind").groups.items():
        if kind == "hover":
            continue
        parts = [rows[name] for name in names]
        try:
            found = align_references(
                [part["t"].to_numpy() for part in parts],
                [part[["rx", "ry"]].to_numpy() for part in parts],
                [part[["rvx", "rvy"]].to_numpy() for part in parts],
            )
        except InvalidEpisodeError as error:
            raise InvalidEpisodeError(
                f"flights of kind {kind!r} cannot be aligned: {error} Or leave this kind out of "
                "kinds."
            ) from None
        info.loc[names, "time_origin"] = found.time_origin
        info.loc[names, "time_scale"] = found.time_scale
        info.loc[names, "residual"] = found.residual
    info["start_logged"] = info["time_origin"] >= -_START_S
    rates = [rows[name][["wx", "wy", "wz"]].to_numpy() for name in info.index]
    info["rate_rms"] = [np.sqrt(np.mean(np.sum(rate**2, axis=1))) for rate in rates]
    info["violent"] = info["rate_rms"] > _VIOLENT
    return info
