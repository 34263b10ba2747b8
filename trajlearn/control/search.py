"""Searching good parameters of a controller by trials: ask for them, run them, tell."""

from abc import abstractmethod
from dataclasses import replace
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.utils import check_random_state, check_scalar

from trajlearn._sklearn import Interval
from trajlearn.control._history import history_of
from trajlearn.control._optimizers import checked_bounds
from trajlearn.control._search_file import read_search, taken_up, write_search
from trajlearn.control._trial_returns import check_same_reward, measured
from trajlearn.control._trials import Proposal, Trials, joined
from trajlearn.trajectories import Trajectory, TrajectoryDataset, as_dataset
from trajlearn.trajectories.rewards import Reward

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Proposal", "Search"]

Floats = NDArray[np.float64]
# what the random streams of one search are for
_PROPOSAL, _TRIAL = (), (1,)


class Search(BaseEstimator):
    """What all searches share: asking, telling, running a simulator, files.

    A subclass implements `_propose` and may narrow `_ready`.
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "bounds": ["array-like"],
        "reward": [callable, None],
        "horizon": [Interval(Integral, 1, None, closed="left")],
        "terminal_reward": [Interval(Real, None, None, closed="neither"), None],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

    # of those searches that begin with Sobol points
    n_initial: int
    _state: Trials | None = None

    def __init__(
        self,
        *,
        bounds: ArrayLike,
        reward: Reward | None = None,
        horizon: int,
        terminal_reward: float | None = None,
        random_state: Any = None,
        verbose: int = 0,
    ) -> None:
        self.bounds = bounds
        self.reward = reward
        self.horizon = horizon
        self.terminal_reward = terminal_reward
        self.random_state = random_state
        self.verbose = verbose

    # -- what a search defines ------------------------------------------------------------

    @abstractmethod
    def _propose(self, rng: np.random.Generator) -> Proposal:
        """Parameters to try next, from the trials so far; may change nothing but caches."""

    def _ready(self) -> bool:
        """Whether there are trials enough for `_propose`; until then Sobol points are asked for."""
        return len(self._tried()[1]) >= self.n_initial

    def _check_trials(self, ds: TrajectoryDataset) -> None:
        """Raise ValueError if new trials do not fit the search; they fit one another."""

    # -- asking and telling ---------------------------------------------------------------

    def ask(self) -> Floats:
        """Parameters to run next.

        Asking again without a `tell` in between gives the same ones.

        Returns
        -------
        ndarray of shape (p,)

        Raises
        ------
        ValueError
            If the search was built with something impossible.
        UnsafeProposalError
            If no parameters are likely enough to keep the constraint.
        """
        state = self._begun()
        if state.pending is None:
            proposal = self._propose_safely(state)
            state = replace(state, pending=proposal, n_asked=state.n_asked + 1)
            self._state = state
        assert state.pending is not None
        return state.pending.params.copy()

    def tell(
        self,
        trajectory: Trajectory | TrajectoryDataset | list[Trajectory],
        reward: ArrayLike | None = None,
    ) -> Self:
        """Report one trial, or several.

        The return of a trial is the sum of its step rewards over the first `horizon` steps;
        what was logged beyond is data for a model only. A trial that terminated earlier is
        charged `terminal_reward` for each missing step.

        Parameters
        ----------
        trajectory : Trajectory, TrajectoryDataset or list of Trajectory
            Trials as they were run, with the params that were in force; those without params
            ran the proposal of the last `ask`. Params outside the bounds, or other ones than
            proposed, are welcome: it is the logged trial that counts. A trial whose params
            change before the horizon serves the model only and has no return (NaN).
        reward : float or array-like of shape (n,), optional
            Returns, if they are known by other means than the reward function.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If a trial has another number of params or states or another time step than the
            trials before, is shorter than the horizon without having terminated, or has no
            finite return. The search is then as before.
        """
        state = self._begun()
        new, data = joined(state, as_dataset(trajectory))
        records = measured(state, new, self.reward, reward)
        self._check_trials(new)
        self._state = state.told(data, records, len(new))
        return self

    def _begun(self) -> Trials:
        """The state, after checking that the constructor's parameters (still) make sense."""
        self._validate_params()
        bounds = checked_bounds(self.bounds)
        state = self._state
        if state is None:
            rng = check_random_state(self.random_state)
            state = self._state = Trials(int(rng.randint(2**31)), bounds, int(self.horizon))
        self._agree(state, "the search began")
        return state

    def _agree(self, state: Trials, when: str) -> None:
        """Raise if bounds or horizon are not those of a state."""
        differing = state.differing(checked_bounds(self.bounds), self.horizon)
        if differing:
            raise ValueError(
                f"{type(self).__name__} differs from when {when}: {'; '.join(differing)}. Build a "
                "new search and tell it the trials (trials_) instead."
            )

    def _propose_safely(self, state: Trials) -> Proposal:
        """A proposal inside the bounds, from the model or, at first, from a Sobol sequence."""
        if not self._ready():
            return Proposal(self._sobol(state), source="sobol")
        proposal = self._propose(self._rng(state.n_asked, *_PROPOSAL))
        params = np.array(proposal.params, dtype=np.float64)
        if params.shape != (len(state.bounds),) or not np.isfinite(params).all():
            raise ValueError(f"the search found no parameters: {params}.")
        # an optimiser may leave the bounds by round-off
        return replace(proposal, params=np.clip(params, *state.bounds.T))

    def _sobol(self, state: Trials) -> Floats:
        """Point number `n_asked` of the scrambled Sobol sequence of this seed (p,)."""
        from scipy.stats import qmc

        sequence = qmc.Sobol(len(state.bounds), rng=np.random.default_rng(state.seed))
        if state.n_asked:
            sequence.fast_forward(state.n_asked)
        low, high = state.bounds.T
        return low + (high - low) * sequence.random(1)[0]

    def _rng(self, *key: int) -> np.random.Generator:
        """Random numbers of a key, the same in a search that was resumed."""
        return np.random.default_rng([self.seed_, *key])

    def _tried(self) -> tuple[Floats, Floats]:
        """Params (n, p) and returns (n,) of the trials that have one theta."""
        state = self._state
        if state is None or state.data is None:
            return np.empty((0, len(checked_bounds(self.bounds)))), np.empty(0)
        returns = state.returns(self.terminal_reward)
        known = ~np.isnan(returns)
        return state.records["params"][known], returns[known]

    # -- what came out --------------------------------------------------------------------

    @property
    def seed_(self) -> int:
        """Seed of all that is random, drawn once from `random_state`."""
        return self._told().seed

    @property
    def trials_(self) -> TrajectoryDataset:
        """All trials told, in order, called 0, 1, ..."""
        data = self._told().data
        if data is None:
            raise AttributeError("no trial was told yet: run the params of ask(), then tell().")
        return data

    @property
    def returns_(self) -> Floats:
        """Return of each trial (n,); NaN where theta changed on the way."""
        return self._told().returns(self.terminal_reward)

    @property
    def best_params_(self) -> Floats:
        """Params of the trial of greatest return (p,).

        Where trials begin in unlike states, the greatest return may be that of a good start;
        `predict_return` of a `PolicySearch` judges all params from the same states.
        """
        params, returns = self._best()
        return params[int(np.argmax(returns))].copy()

    @property
    def best_reward_(self) -> float:
        """Greatest return of any trial."""
        return float(self._best()[1].max())

    def _told(self) -> Trials:
        if self._state is None:
            raise AttributeError("the search has not begun: ask() or tell() first.")
        return self._state

    def _best(self) -> tuple[Floats, Floats]:
        params, returns = self._tried()
        if not len(returns):
            raise AttributeError("no trial with a return was told yet.")
        return params, returns

    def history(self) -> "pd.DataFrame":
        """One row a trial.

        Returns
        -------
        DataFrame
            ``trial``; the params by name; ``return``; ``best`` so far; ``predicted``,
            ``expected``, ``predicted_std`` and ``violation`` of the proposal, averaged over the
            initial states that the model was asked about, so that a single trial scatters more
            (NaN where nothing was predicted); ``n_steps``; ``terminated``; ``source``
            (``"sobol"``, ``"model"``, ..., ``"logged"`` if the trial did not follow the
            proposal). ``predicted_std`` is about ``expected``, the mean return; ``predicted`` may
            be the return of the mean trajectory.
        """
        return history_of(self._told(), self.terminal_reward, self.trials_)

    def _candidates(self, params: ArrayLike) -> Floats:
        """Params (m, p) that a model is asked about."""
        n_params = len(self._begun().bounds)
        candidates = np.atleast_2d(np.asarray(params, dtype=np.float64))
        if candidates.ndim != 2 or candidates.shape[1] != n_params:
            raise ValueError(
                f"params has shape {np.shape(params)}; expected (m, {n_params}), as bounds= says."
            )
        if not np.isfinite(candidates).all():
            raise ValueError("params has NaN or infinite values.")
        return candidates

    # -- a simulator ----------------------------------------------------------------------

    def run(
        self,
        env: Any,
        n_trials: int,
        *,
        initial_states: ArrayLike | None = None,
        policy: Any = None,
        path: str | Path | None = None,
    ) -> Self:
        """Run trials in a simulator: ask, roll out, tell.

        Parameters
        ----------
        env : Environment
            What has ``reset(1, random_state)`` and ``rollout(initial_states, params, length,
            policy, random_state=...)``, such as `trajlearn.envs.Cartpole`.
        n_trials : int
            How many more trials.
        initial_states : array-like of shape (d_s,) or (m, d_s), optional
            Where trials start: the k-th asked for in row k, and from the first again after the
            last. Default: drawn by ``env.reset`` with a seed from (`seed_`, k), so that all
            searches of a seed meet the same.
        policy : callable, optional
            Controller of the trials. Default: the search's own `policy`, or the system's.
        path : str or Path, optional
            Where the search is saved after each ask and tell. If the file exists, the search
            goes on from it, and the trials it finds there count among `n_trials`: a script that
            was killed is simply started again.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If the file holds another search than this one.
        Exception
            What the simulator or the model raises, with a note on the trial. The search is as
            before the trial, and the proposal still waits.
        """
        from tqdm.auto import tqdm

        check_scalar(n_trials, "n_trials", Integral, min_val=1)
        self._begun()
        n_found = 0 if path is None else self._take_up(path)
        policy = getattr(self, "policy", None) if policy is None else policy
        bar = tqdm(total=int(n_trials), initial=n_found, unit="trial", disable=not self.verbose)
        with bar:
            for _ in range(int(n_trials) - n_found):
                self._run_one(env, initial_states, policy, path)
                bar.update()
                _, returns = self._tried()
                if len(returns):
                    bar.set_postfix(best=f"{returns.max():.4g}")
        return self

    def _run_one(self, env: Any, initial_states: Any, policy: Any, path: Any) -> None:
        try:
            params = self.ask()
            if path is not None:
                self.save(path)
            k = self._told().n_asked - 1
            seed = int(self._rng(k, *_TRIAL).integers(2**31))
            if initial_states is None:
                starts = env.reset(1, random_state=seed)
            else:
                given = np.atleast_2d(np.asarray(initial_states, dtype=np.float64))
                starts = given[[k % len(given)]]
            self.tell(env.rollout(starts, params[None], self.horizon, policy, random_state=seed))
        except Exception as error:
            state = self._told()
            text = "" if state.pending is None else f" with params {state.pending.params.tolist()}"
            error.add_note(f"This was in trial {len(state)}{text}; the search is as before it.")
            raise
        if path is not None:
            self.save(path)

    def _take_up(self, path: str | Path) -> int:
        """Go on from a file, if it is there; how many proposals it is ahead."""
        if not Path(path).is_file():
            return 0
        state, n_ahead = taken_up(self._told(), self._read(path), path)
        self._go_on(state)
        return n_ahead

    # -- files ----------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write trials, returns, the waiting proposal and the seed to one file, or nothing.

        Neither the model nor any function is in the file; both come from the constructor.

        Parameters
        ----------
        path : str or Path
            Conventionally ``.npz``. A file of that name is replaced.
        """
        write_search(path, type(self).__name__, self._begun())

    def resume(self, path: str | Path) -> Self:
        """Go on from a file that `save` wrote, with the same proposals as if never stopped.

        Parameters
        ----------
        path : str or Path

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If the file is of a search of another class, bounds or horizon, or of another reward:
            one that sums up to other returns than those of its trials.
        UnknownFileError
            If it is truncated, changed, or of another kind.
        """
        self._validate_params()
        self._go_on(self._read(path))
        return self

    def _go_on(self, state: Trials) -> None:
        """Go on from another state."""
        self._state = state

    def _read(self, path: str | Path) -> Trials:
        name, state = read_search(path)
        if name != type(self).__name__:
            raise ValueError(f"{path} holds a {name}, not a {type(self).__name__}.")
        self._agree(state, f"{path} was saved")
        try:
            check_same_reward(state, self.reward)
        except Exception as error:
            error.add_note(f"This was in summing up the trials of {path} again.")
            raise
        return state
