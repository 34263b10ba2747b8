"""What a fitted selector tells of its members."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn.dynamics._selection.diagnosis import diagnosis
from trajlearn.dynamics._selection.losses import HorizonLosses, horizon_losses
from trajlearn.dynamics._selection.report import Evidence, by_horizon, by_member, errors_by_horizon

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ReportsSelection"]

Floats = NDArray[np.float64]


class ReportsSelection:
    """Tables and words on the held-out errors that a choice rests on."""

    _bandwidth: float
    names_: tuple[str, ...]
    estimators_: list[Any]
    weights_: Floats
    state_names_: tuple[str, ...]
    state_range_: Floats
    fit_seconds_: dict[str, float]
    predict_seconds_: dict[str, float]
    _errors: Floats
    _units: NDArray[np.intp]

    @property
    def cv_errors_(self) -> "pd.DataFrame":
        """Errors of each member on held-out episodes, by horizon."""
        return errors_by_horizon(self._evidence())

    def report(self, by: str = "horizon") -> "pd.DataFrame":
        """Who wins where, by how much and how surely, and what each member costs.

        Parameters
        ----------
        by : {"horizon", "member"}, default="horizon"

        Returns
        -------
        DataFrame
            By horizon, one row a block of steps with the same winner: ``from``, ``to``,
            ``winner``, its ``error`` (median over held-out episodes of the squared error in
            training ranges, averaged over the block), the ``second``, the ``ratio`` of its error
            to the winner's, and by how many ``standard_errors`` of the paired difference its loss
            is greater: below 1 the two are as good as equal. Negative: the second is better
            there, but not surely enough to be preferred to the member that is best overall.

            By member: ``steps`` that it wins, ``n_episodes`` that it was judged by (fewer if it
            left the race), its ``error``, ``loss`` and ``n_diverged`` over all steps of these,
            ``fit_seconds`` (all its fits), ``predict_seconds`` (all these episodes) and the
            ``measurement_noise`` that it found, in percent of the training range.
        """
        if by not in ("horizon", "member"):
            raise ValueError(f'by = {by!r}; choose "horizon" or "member".')
        return (by_horizon if by == "horizon" else by_member)(self._evidence())

    def diagnosis(self) -> str:
        """What the held-out errors say of the data, in a few sentences with their numbers.

        Returns
        -------
        str
            Whether the states look noisy, partial or divergent, and how far ahead they can be
            predicted. Hints, not tests.
        """
        return diagnosis(self._evidence())

    def _evidence(self) -> Evidence:
        check_is_fitted(self, "weights_")
        return Evidence(
            self.names_,
            self.estimators_,
            self._errors,
            self._losses(),
            self.weights_,
            self.state_names_,
            self.state_range_,
            self.fit_seconds_,
            self.predict_seconds_,
        )

    def _losses(self) -> HorizonLosses:
        return horizon_losses(self._errors, self._units, self._bandwidth)
