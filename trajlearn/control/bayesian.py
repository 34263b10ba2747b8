"""Bayesian optimisation: a model of the return instead of one of the dynamics."""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn._sklearn import StrOptions
from trajlearn.control._optimizers import checked_bounds
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
    extra ``search``).

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
        self.bounds = bounds
        self.reward = reward
        self.horizon = horizon
        self.n_initial = n_initial
        self.terminal_reward = terminal_reward
        self.acquisition = acquisition
        self.noisy = noisy
        self.random_state = random_state
        self.verbose = verbose

    def ask(self) -> Floats:
        """Parameters to run next.

        Asking again without a `tell` in between gives the same ones.

        Returns
        -------
        ndarray of shape (p,)

        Raises
        ------
        ImportError
            If BoTorch is missing; at the first call already, before any trial was run.
        ValueError
            If the search was built with something impossible.
        """
        import_extra("botorch", "search", by=type(self).__name__)
        return super().ask()

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
        self._begun()
        self._best()
        theta = np.atleast_2d(np.asarray(params, dtype=np.float64))
        p = len(checked_bounds(self.bounds))
        if theta.ndim != 2 or theta.shape[1] != p or not np.isfinite(theta).all():
            raise ValueError(
                f"params of shape {theta.shape} must be finite and of shape (m, {p}), as bounds= "
                "says."
            )
        with same_bits(self.seed_):
            mean, std = self._fitted().moments(self._in_cube(theta), noise=True)
        return Assessment(mean, mean, std, None)

    def _propose(self, rng: np.random.Generator) -> Proposal:
        seed = int(rng.integers(2**31))
        low, high = checked_bounds(self.bounds).T
        with same_bits(seed):
            gp = self._fitted()
            point = propose(gp, self.acquisition, seed)
            mean, std = gp.moments(point[None], noise=True)
        return Proposal(low + (high - low) * point, float(mean[0]), float(std[0]))

    def _fitted(self) -> ReturnGP:
        params, returns = self._tried()
        return fit_return_gp(self._in_cube(params), returns, noisy=self.noisy)

    def _in_cube(self, params: Floats) -> Floats:
        low, high = checked_bounds(self.bounds).T
        return (params - low) / (high - low)
