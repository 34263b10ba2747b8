"""Other libraries in a regime: one-step models, tuned on training folds, rolled out as ours are."""

import json
import os
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product
from math import comb
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning

from benchmarks.regimes._environments import ROOT, interpreter
from benchmarks.regimes._episodes import Episodes, episodes
from benchmarks.regimes._members import folds_of
from benchmarks.regimes._peer_messages import receive, send
from benchmarks.regimes._regimes import REGIMES
from benchmarks.regimes._scores import errors_of, scores
from trajlearn import TrajectoryDataset
from trajlearn.dynamics._selection.default_members import clipped_to

Floats = NDArray[np.float64]
Settings = dict[str, Any]

#: Names in tables and legends, and the environment that each runs in; None is ours.
ENVIRONMENT = {"PySINDy": "pysindy", "pykoop": "pykoop", "mbrl-lib": "mbrl", "sklearn-GP": None}
#: Rows that a GP is fitted on.
GP_ROWS = 800
# a library of functions has at most this many terms, as our polynomials
_MOST_TERMS = 1000
# folds of many episodes that candidates are compared on
_TUNING_FOLDS = 1


class OneStep(Protocol):
    """What a peer is to the roll-out."""

    def fit(self, rows: "Rows") -> None:
        """Learn the next states."""

    def step(self, states: Floats, inputs: Floats) -> Floats:
        """States one step later."""


class Rows:
    """Transitions of episodes: ``states``, ``inputs``, ``after``, and ``offsets`` of episodes."""

    def __init__(self, ds: TrajectoryDataset, policy: Any) -> None:
        self.states = np.concatenate([e.states[:-1] for e in ds])
        self.after = np.concatenate([e.states[1:] for e in ds])
        self.inputs = np.concatenate([_logged_inputs(e, policy) for e in ds])
        self.offsets = np.r_[0, np.cumsum(ds.lengths)]


def _logged_inputs(episode: Any, policy: Any) -> Floats:
    """Actions where the policy is known; else what a closed loop depends on beside its state."""
    if policy is not None:
        return np.asarray(episode.actions)
    return _signals(episode)


def _signals(episode: Any) -> Floats:
    """Parameters and references at each step (T, k)."""
    parts = [np.tile(episode.params, (episode.length, 1))]
    if episode.references is not None:
        # a peer would take the same column twice for two
        moving = episode.references[:-1]
        parts.append(moving)
    return np.concatenate(parts, axis=1)


# -- roll-outs ----------------------------------------------------------------------------


def roll_out(model: OneStep, ds: TrajectoryDataset, limits: Floats, policy: Any) -> Floats:
    """States (n, H, d_s) from the first states of episodes on, with recomputed actions.

    Parameters
    ----------
    model : fitted peer
    ds : TrajectoryDataset
        Of the states the first is read.
    limits : ndarray of shape (2, d_s)
        States are kept within.
    policy : callable or None
        None: the inputs are parameters and references.
    """
    n_steps = int(ds.lengths.max())
    states = np.stack([episode.states[0] for episode in ds])
    theta = np.stack([episode.params for episode in ds])
    signals = [_signals(e) for e in ds] if policy is None else []
    dt = float(np.diff(ds[0].times[:2])[0])
    found = np.empty((len(ds), n_steps, states.shape[1]))
    for t in range(n_steps):
        if policy is None:
            inputs = np.stack([some[min(t, len(some) - 1)] for some in signals])
        else:
            inputs = policy(states, theta, np.full(len(ds), t * dt))
        after = model.step(states, inputs)
        # what is not finite would not be clipped
        states = np.clip(np.nan_to_num(after, nan=np.inf), *limits)
        found[:, t] = states
    return found


def limits_of(ds: TrajectoryDataset) -> Floats:
    """Multiples of the training range about its centre (2, d_s), as our members' roll-outs have."""
    low, high = ds.states.min(axis=0), ds.states.max(axis=0)
    centre, half = (low + high) / 2, clipped_to(len(ds)) * (high - low) / 2
    return np.stack([centre - half, centre + half])


# -- the peers ----------------------------------------------------------------------------


class Remote:
    """A peer that runs in another process and environment.

    Parameters
    ----------
    process : Popen
        A worker, see `_peer_worker`.
    settings : dict
        Arguments of the peer there.
    """

    def __init__(self, process: "subprocess.Popen[bytes]", settings: Settings) -> None:
        self.process = process
        self.settings = settings

    def fit(self, rows: Rows) -> None:
        self._ask(f"fit {json.dumps(self.settings)}", **vars(rows))

    def step(self, states: Floats, inputs: Floats) -> Floats:
        return self._ask("step", states=states, inputs=inputs)["after"]

    def _ask(self, command: str, **arrays: Any) -> dict[str, Floats]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        send(self.process.stdin, command, arrays)
        answer = receive(self.process.stdout)
        if answer is None:
            raise RuntimeError(f"the worker {self.process.args} ended before it answered.")
        if answer[0].startswith("failed"):
            raise RuntimeError(answer[0])
        return answer[1]


class GaussianProcess:
    """scikit-learn's exact GP of the change in a step, one kernel for all states, on some rows."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def fit(self, rows: Rows) -> None:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
        from sklearn.preprocessing import StandardScaler

        x = np.concatenate([rows.states, rows.inputs], axis=1)
        change = rows.after - rows.states
        self.inputs, self.targets = StandardScaler().fit(x), StandardScaler().fit(change)
        some = np.random.default_rng(self.seed).permutation(len(x))[:GP_ROWS]
        lengths = RBF(np.full(x.shape[1], 3.0), (1e-2, 1e3))
        kernel = ConstantKernel(10.0, (1e-2, 1e5)) * lengths + WhiteKernel(1e-3, (1e-9, 10.0))
        with warnings.catch_warnings():
            # an input that does not matter has a length beyond all bounds
            warnings.simplefilter("ignore", ConvergenceWarning)
            self.model = GaussianProcessRegressor(kernel, random_state=self.seed)
            self.model.fit(self.inputs.transform(x[some]), self.targets.transform(change[some]))

    def step(self, states: Floats, inputs: Floats) -> Floats:
        x = self.inputs.transform(np.concatenate([states, inputs], axis=1))
        change = self.targets.inverse_transform(self.model.predict(x).reshape(len(x), -1))
        return states + np.asarray(change)


@contextmanager
def maker(peer: str, seed: int) -> Iterator[Callable[[Settings], OneStep]]:
    """What makes an unfitted peer from settings; ends the worker it needed."""
    environment = ENVIRONMENT[peer]
    if environment is None:
        yield lambda settings: GaussianProcess(seed, **settings)
        return
    threads = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    process = subprocess.Popen(
        [interpreter(environment), "-m", "benchmarks.regimes._peer_worker", environment],
        cwd=ROOT,
        env=os.environ | dict.fromkeys(threads, "1"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        yield lambda settings: Remote(process, settings)
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait(timeout=30)


def candidates(peer: str, width: int, seed: int, mode: str) -> list[Settings]:
    """Settings of a peer that are compared, for so many columns of state and input."""
    degrees = [k for k in (1, 2, 3) if comb(width + k, k) <= _MOST_TERMS]
    if peer == "PySINDy":
        thresholds = (0.0, 1e-3, 1e-2)
        return [{"degree": k, "threshold": c} for k, c in product(degrees, thresholds)]
    if peer == "pykoop":
        return [{"degree": k, "alpha": a} for k, a in product(degrees, (0.0, 1.0, 100.0))]
    if peer == "mbrl-lib":
        epochs = 2 if mode == "quick" else 20
        # a probabilistic ensemble was 5 times worse on the development seed, and takes minutes
        return [{"hidden": 200, "epochs": epochs, "deterministic": True, "seed": seed}]
    return [{}]


def choose(
    make: Callable[[Settings], OneStep],
    tried: list[Settings],
    data: Episodes,
    policy: Any,
    seed: int,
) -> tuple[Settings, list[float]]:
    """The candidate with the least error on held-out training episodes, and the errors of all.

    As our selector does it, by a logarithm: of the squared error over all horizons, averaged over
    episodes.
    """
    if len(tried) == 1:
        return tried[0], []
    ds = data.train
    folds = folds_of(ds, seed)
    folds = folds if len(folds) == len(ds) else folds[:_TUNING_FOLDS]
    losses = np.zeros(len(tried))
    for i, settings in enumerate(tried):
        for train, test in folds:
            model = make(settings)
            model.fit(Rows(ds[train], policy))
            predicted = roll_out(model, ds[test], limits_of(ds[train]), policy)
            errors = errors_of(predicted, ds[test], data.span)
            losses[i] += np.log(np.nanmean(errors, axis=1)).mean() / len(folds)
    return tried[int(losses.argmin())], losses.tolist()


def cell(system: str, regime: str, policy: str, peer: str, mode: str, seed: int) -> dict[str, Any]:
    """Tune a peer on training episodes, fit it on all, and judge it on the test episodes.

    Returns
    -------
    dict
        ``scores`` (see there), or ``failure``, a text; ``settings`` chosen, ``seconds`` of
        tuning and of the fit.
    """
    what = REGIMES[system, regime]
    data = episodes(what, seed, mode)
    law = data.policy if policy == "known" else None
    rows = Rows(data.train, law)
    width = rows.states.shape[1] + rows.inputs.shape[1]
    tried = candidates(peer, width, seed, mode)
    began = time.perf_counter()
    try:
        with maker(peer, seed) as make:
            settings, losses = choose(make, tried, data, law, seed)
            tuned = time.perf_counter()
            model = make(settings)
            model.fit(rows)
            fitted = time.perf_counter()
            predicted = roll_out(model, data.test, limits_of(data.train), law)
    except RuntimeError as error:
        # of the peer, on these episodes: said in the report
        return {"failure": str(error), "seconds": time.perf_counter() - began}
    return {
        "scores": scores(predicted, data),
        "settings": settings,
        "losses": losses,
        "seconds": {"tuning": tuned - began, "fit": fitted - tuned},
    }
