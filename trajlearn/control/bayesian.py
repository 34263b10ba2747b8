"""Bayesian optimisation: a model of the return instead of one of the dynamics."""

from numbers import Integral
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.control._return_gp import (
    ACQUISITIONS,
    ReturnGP,
    fit_return_gp,
    propose,
    same_bits,
)
from trajlearn.control.objective import Assessment
from trajlearn.control.search import Proposal, Search
from trajlearn.trajectories._extras import import_extra
from trajlearn.trajectories.rewards import Reward

__all__ = ["BayesianSearch"]

Floats = NDArray[np.float64]


class BayesianSearch(Search):
    """Bayesian optimisation of the return over theta, without a model of the dynamics.

    A Gaussian process is fitted to (theta, return) of the trials, theta scaled to the unit cube
    and returns standardised, and asked where a trial promises the most. It needs no states, and
    learns one number from a trial; `PolicySearch` learns from every step. Needs BoTorch (the
    extra ``search``); the first `ask` says so if it is missing, before any trial is run.

    Parameters
    ----------
    bounds : array-like of shape (p, 2)
        Lowest and highest value of each parameter.
    reward : callable or None, default=None
        ``reward(states)`` of the states each step leads into (it may also name `actions`,
        `references`, `times`); None takes the logged rewards.
    horizon : int
        Steps of a trial.
    n_initial : int, default=1
        Trials before the first that the process proposes. Their params are the Sobol points that
        `RandomSearch` and `PolicySearch` ask for with the same seed.
    terminal_reward : float or None, default=None
        What each step after an early termination is worth. None: the least step reward in any
        trial told, so that crashing never pays.
    acquisition : {"logei", "ucb"}, default="logei"
        "logei": logarithm of the expected improvement over the best trial so far [1]_. "ucb":
        mean + 2 standard deviations.
    noisy : bool, default=True
        Whether a repeated trial would have another return, as on a robot or with drawn start
        states. True: the process also fits the variance of that noise, and the best trial so far
        is the one of the greatest *posterior mean*, since the greatest return may have been
        luck. False: returns are exact, and the best is the greatest; wrong where there is noise.
    random_state : int, RandomState or None, default=None
    verbose : int, default=0
        A progress bar in `run`.

    Attributes
    ----------
    trials_ : TrajectoryDataset
    returns_ : ndarray of shape (n,)
    best_params_ : ndarray of shape (p,)
    best_reward_ : float
    seed_ : int

    See Also
    --------
    PolicySearch : lets a model of the dynamics propose.
    RandomSearch : lets nothing propose.

    Notes
    -----
    The process is BoTorch's `SingleTaskGP` with its priors on length scales and noise, so that it
    can be fitted to one trial: it then prefers to be far from it. The same seed and trials give
    the same proposals to the bit, on one thread; torch's generators and threads are left as they
    were.

    A proposal is where the acquisition is greatest, and that follows from the trials: told the
    same ones, searches of other seeds propose the same, unless their optimisers end in other
    maxima. The seed decides the Sobol points, and where the optimiser begins.

    References
    ----------
    .. [1] S. Ament et al., "Unexpected Improvements to Expected Improvement for Bayesian
       Optimization", NeurIPS 2023.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import Trajectory
    >>> from trajlearn.control import BayesianSearch
    >>> search = BayesianSearch(
    ...     bounds=[[0.0, 1.0]], reward=lambda states: -states[..., 0] ** 2, horizon=5,
    ...     noisy=False, random_state=0,
    ... )
    >>> for _ in range(6):
    ...     gain = search.ask()
    ...     search = search.tell(Trajectory((1 - gain) ** np.arange(6)[:, None], params=gain))
    >>> bool(search.best_reward_ > -1e-3)
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **Search._parameter_constraints,
        "n_initial": [Interval(Integral, 1, None, closed="left")],
        "acquisition": [StrOptions(set(ACQUISITIONS))],
        "noisy": ["boolean"],
    }

    def __init__(
        self,
        *,
        bounds: ArrayLike,
        reward: Reward | None = None,
        horizon: int,
        n_initial: int = 1,
        terminal_reward: float | None = None,
        acquisition: str = "logei",
        noisy: bool = True,
        random_state: Any = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(
            bounds=bounds,
            reward=reward,
            horizon=horizon,
            terminal_reward=terminal_reward,
            random_state=random_state,
            verbose=verbose,
        )
        self.n_initial = n_initial
        self.acquisition = acquisition
        self.noisy = noisy

    def predict_return(self, params: ArrayLike) -> Assessment:
        """Return of a trial as the process predicts it.

        Parameters
        ----------
        params : array-like of shape (m, p)

        Returns
        -------
        Assessment
            ``reward`` and ``std`` (m,) of one trial, noise included; ``value`` is the mean.

        Raises
        ------
        ImportError
            If BoTorch is missing.
        AttributeError
            If no trial with a return was told yet.
        """
        import_extra("botorch", "search", by=type(self).__name__)
        candidates = self._candidates(params)
        self._best()  # raises without any
        with same_bits(self.seed_):
            mean, std = self._fitted().moments(self._in_cube(candidates), noise=True)
        return Assessment(mean, mean, std, None, expected=mean)

    def _ready(self) -> bool:
        # said before any trial is run
        import_extra("botorch", "search", by=type(self).__name__)
        return super()._ready()

    def _propose(self, rng: np.random.Generator) -> Proposal:
        seed = int(rng.integers(2**31))
        low, high = self._told().bounds.T
        with same_bits(seed):
            gp = self._fitted()
            point = propose(gp, self.acquisition, seed)
            mean, std = gp.moments(point[None], noise=True)
        expected = float(mean[0])
        return Proposal(
            low + (high - low) * point, reward=expected, std=float(std[0]), expected=expected
        )

    def _fitted(self) -> ReturnGP:
        params, returns = self._tried()
        return fit_return_gp(self._in_cube(params), returns, noisy=self.noisy)

    def _in_cube(self, params: Floats) -> Floats:
        low, high = self._told().bounds.T
        return (params - low) / (high - low)
