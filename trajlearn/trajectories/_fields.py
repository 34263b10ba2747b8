"""The fields of a dataset, read only: one array each, with names and offsets."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.exceptions import MissingFieldError
from trajlearn.trajectories._columns import VECTOR_FIELDS, Columns

__all__ = ["Fields"]


class Fields:
    """Read access to the columns of a `TrajectoryDataset` and their names."""

    _columns: Columns
    _names: dict[str, tuple[str, ...]]

    def __len__(self) -> int:
        return self._columns.n_episodes

    @property
    def offsets(self) -> NDArray[np.intp]:
        """First row of each episode in `states`, `times`, `references` (n + 1,)."""
        return self._columns.offsets

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Steps T in each episode (n,)."""
        return self._columns.lengths

    @property
    def states(self) -> NDArray[np.float64]:
        """All states, episode after episode (sum of T + 1, d_s)."""
        return self._columns.states

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of all states (sum of T + 1,)."""
        return self._columns.times

    @property
    def actions(self) -> NDArray[np.float64] | None:
        """All actions (sum of T, d_a), or None."""
        return self._columns.actions

    @property
    def rewards(self) -> NDArray[np.float64] | None:
        """All rewards (sum of T,), or None."""
        return self._columns.rewards

    @property
    def references(self) -> NDArray[np.float64] | None:
        """All references (sum of T + 1, d_r), or None."""
        return self._columns.references

    @property
    def observed(self) -> NDArray[np.float64] | None:
        """States as logged (sum of T + 1, d_o) where a transformer estimated `states`, or None.

        Scores compare forecasts with these.
        """
        return self._columns.observed

    @property
    def hindsight(self) -> bool:
        """Whether `states` were estimated from whole episodes, each also from what follows it.

        Such states (of a smoother) are for training: a forecast from them is no fair test, and
        warns.
        """
        return self._columns.hindsight

    @property
    def has_params(self) -> bool:
        """Whether the episodes carry controller parameters (p > 0)."""
        return self._columns.params is not None

    @property
    def params_vary(self) -> bool:
        """Whether theta changes inside some episode."""
        return self._columns.params_per_step

    @property
    def params(self) -> NDArray[np.float64] | None:
        """Controller parameters by episode (n, p), or None.

        Raises
        ------
        ValueError
            If theta changes inside an episode: use `step_params` or `params_at`.
        """
        if self.params_vary:
            raise ValueError(
                "theta changes inside some episodes, so there is no one row an episode: use "
                "ds.step_params (one row a step) or ds.params_at(start)."
            )
        return self._columns.params

    @property
    def step_params(self) -> NDArray[np.float64] | None:
        """Controller parameters by step (sum of T, p), or None."""
        if self._columns.params is None or self.params_vary:
            return self._columns.params
        return np.repeat(self._columns.params, self.lengths, axis=0)

    def params_at(self, start: ArrayLike = 0) -> NDArray[np.float64]:
        """Theta in force from the state `start` of each episode on (n, p); p may be 0.

        Raises
        ------
        IndexError
            If an episode has no such state.
        """
        columns = self._columns
        if columns.params is None:
            return np.empty((len(self), 0))
        if not columns.params_per_step:
            return columns.params
        # No step begins at the last state: the theta that led there stays in force.
        index = np.minimum(self.state_rows(start) - self.offsets[:-1], self.lengths - 1)
        return columns.params[columns.step_offsets[:-1] + index]

    @property
    def time_origin(self) -> NDArray[np.float64]:
        """Time at which each episode's motion begins (n,), NaN where unknown."""
        return self._columns.time_origin

    @property
    def context(self) -> dict[str, NDArray[Any]]:
        """Discrete facts, one array (n,) a name."""
        return dict(self._columns.context)

    @property
    def group(self) -> NDArray[Any] | None:
        """Label for group splits (n,), or None."""
        return self._columns.group

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """Whether each episode ended by itself (n,)."""
        return self._columns.terminated

    @property
    def ids(self) -> NDArray[Any]:
        """What tables and messages call each episode (n,)."""
        return self._columns.ids

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state columns."""
        return self._names["states"]

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the action columns."""
        return self._names["actions"]

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the controller parameters."""
        return self._names["params"]

    @property
    def reference_names(self) -> tuple[str, ...]:
        """Names of the reference columns."""
        return self._names["references"]

    @property
    def observed_names(self) -> tuple[str, ...]:
        """Names of the columns of `observed`."""
        return self._names.get("observed", ())

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """All names that the constructors take, as their keyword arguments."""
        given = {field: names for field, names in self._names.items() if field in VECTOR_FIELDS}
        return {f"{field[:-1]}_names": names for field, names in given.items() if names}

    def state_rows(self, start: ArrayLike = 0) -> NDArray[np.intp]:
        """Row in `states` of the state `start` of each episode (n,).

        Raises
        ------
        IndexError
            If an episode has no such state.
        """
        index = np.broadcast_to(np.asarray(start, dtype=np.intp), (len(self),))
        bad = (index < 0) | (index > self.lengths)
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            raise IndexError(
                f"start {index[i]} is outside episode {self.ids[i]}, whose states are "
                f"0..{self.lengths[i]}."
            )
        return self.offsets[:-1] + index

    def require(self, *fields: str, by: str) -> None:
        """Raise a clear error if a field is missing.

        Raises
        ------
        MissingFieldError
            Naming the field and who needs it.
        """
        for field in fields:
            absent = not self.has_params if field == "params" else getattr(self, field) is None
            if absent:
                raise MissingFieldError(
                    f"{by} needs {field}, but the episodes have none. Give {field}= when the "
                    "dataset is built, or choose a formulation that does without."
                )
