"""Which members may still be chosen once the first folds have judged them."""

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._selection.losses import HorizonLosses, paired

__all__ = ["enough_to_race", "in_the_race"]

# held-out units before members may leave
_ENOUGH = 5
# standard errors by which a member has to be behind over all horizons; those by which it may turn
# out better at one horizon, where it would have to be better by one to be chosen
_SURE, _LIKELY = 2.0, 1.0
# of the loss: what may be missed at a horizon, about a tenth of the error where it is typical
_SLIGHT = 0.05


def enough_to_race(units: NDArray[np.intp]) -> bool:
    """Whether the units of held-out episodes are enough to tell who is surely behind."""
    return len(np.unique(units)) >= _ENOUGH


def in_the_race(losses: HorizonLosses, n_kept: int) -> NDArray[np.bool_]:
    """Members that are not surely behind one other, and the best few (M,).

    A member is behind another if its loss over all horizons is surely greater, and at no horizon
    it is likely to be more than slightly better: it would not be chosen at any.

    Parameters
    ----------
    losses : HorizonLosses
        On the folds so far.
    n_kept : int
        Members that stay in any case, the best over all horizons.
    """
    members = range(len(losses.values))
    behind = np.array([[_is_behind(losses, i, j) for j in members] for i in members])
    ahead = ~behind.any(axis=1)
    # who is behind those only that leave themselves stays
    stays: NDArray[np.bool_] = ~np.any(behind[:, ahead], axis=1)
    stays[losses.ranking()[:n_kept]] = True
    return stays


def _is_behind(losses: HorizonLosses, one: int, other: int) -> bool:
    asked = losses.eligible[one]
    if one == other or (asked & ~losses.eligible[other]).any():
        return False
    total, unsure = losses.over(slice(None), other, one)
    if not total > _SURE * unsure:
        return False
    gain, error = paired(losses.values[other] - losses.values[one], losses.units)
    # where nobody has been judged all may happen: the error is infinite
    asked = asked | ~losses.eligible.any(axis=0)
    return bool((gain[asked] + _LIKELY * error[asked] < _SLIGHT).all())
