"""The search without a model."""

import numpy as np

from trajlearn.control.search import Proposal, Search

__all__ = ["RandomSearch"]


class RandomSearch(Search):
    """Points of a scrambled Sobol sequence: the search that any other has to beat.

    Parameters
    ----------
    bounds : array-like of shape (p, 2)
        Lowest and highest value of each parameter.
    reward : callable or None, default=None
        ``reward(states)`` of the states each step leads into (it may also name `actions`,
        `references`, `times`); None takes the logged rewards.
    horizon : int
        Steps of a trial.
    terminal_reward : float or None, default=None
        What each step after an early termination is worth. None: the least step reward in any
        trial told, so that crashing never pays.
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
    BayesianSearch : lets a model of the return propose.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import Trajectory
    >>> from trajlearn.control import RandomSearch
    >>> search = RandomSearch(
    ...     bounds=[[0.0, 1.0]], reward=lambda states: -states[..., 0] ** 2, horizon=5,
    ...     random_state=0,
    ... )
    >>> for _ in range(8):
    ...     gain = search.ask()
    ...     search = search.tell(Trajectory((1 - gain) ** np.arange(6)[:, None], params=gain))
    >>> bool(search.best_reward_ > -0.1)
    True
    """

    def _ready(self) -> bool:
        return False

    def _propose(self, rng: np.random.Generator) -> Proposal:
        raise NotImplementedError("all points come from the Sobol sequence.")
