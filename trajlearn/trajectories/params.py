"""Another description of the control parameters, as a transformer from dataset to dataset."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import fit_context
from trajlearn.trajectories._transformer import DatasetTransformer
from trajlearn.trajectories.coerce import as_dataset
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["ParamsTransformer"]


class ParamsTransformer(DatasetTransformer):
    """Replace the control parameters of every episode by a function of them.

    A model that stands behind it in a `Pipeline` sees the new description, while episodes,
    policies and searches keep the old one: sixty weights of a network can go into a model as its
    actions at a few states (`NetworkPolicy.responses`), gains as their logarithms. Everything
    else of the episodes stays.

    Parameters
    ----------
    func : callable
        ``func(params (n, p)) -> (n, k)``, row by row. A lambda cannot be pickled.
    names : sequence of k str or None, default=None
        What to call the new parameters; None: ``theta0, theta1, ...``.

    Attributes
    ----------
    param_names_ : tuple of str
        Parameters in training.

    See Also
    --------
    NetworkPolicy.responses

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset
    >>> from trajlearn.trajectories import ParamsTransformer
    >>> ds = TrajectoryDataset.from_arrays(np.zeros((2, 5, 1)), params=[[1.0], [100.0]])
    >>> ParamsTransformer(np.log10, names=["log_gain"]).fit_transform(ds).params
    array([[0.],
           [2.]])
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "func": [callable],
        "names": ["array-like", None],
    }

    def __init__(
        self,
        func: Callable[[NDArray[np.float64]], ArrayLike],
        *,
        names: Sequence[str] | None = None,
    ) -> None:
        self.func = func
        self.names = names

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: Any, y: None = None) -> Self:
        """Remember the parameters of training; `func` itself learns nothing.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None

        Returns
        -------
        self

        Raises
        ------
        MissingFieldError
            If the episodes have no params.
        """
        ds = as_dataset(X)
        ds.require("params", by="ParamsTransformer")
        self.param_names_ = ds.param_names
        return self

    def transform(self, X: Any) -> TrajectoryDataset:
        """Replace the parameters, of each episode or of each step where they change on the way.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
            With as many parameters as in training.

        Returns
        -------
        TrajectoryDataset

        Raises
        ------
        MissingFieldError
            If the episodes have no params.
        ValueError
            If they have another number of them, or `func` returns another shape than (n, k) or
            numbers that are not finite.
        """
        check_is_fitted(self, "param_names_")
        ds = as_dataset(X)
        ds.require("params", by="ParamsTransformer")
        if len(ds.param_names) != len(self.param_names_):
            raise ValueError(
                f"the episodes have {len(ds.param_names)} params, ParamsTransformer was fitted on "
                f"{len(self.param_names_)} ({', '.join(self.param_names_)})."
            )
        new = self._described(ds._columns.params)
        names = self._names(new.shape[1])
        columns = replace(ds._columns, params=new).canonical().freeze()
        return TrajectoryDataset._of(columns, ds._names | {"params": names})

    def _described(self, params: Any) -> NDArray[np.float64]:
        # a copy: datasets are read-only, a function may work in place
        new = np.array(self.func(params.copy()), dtype=np.float64)
        if new.ndim != 2 or len(new) != len(params) or not new.shape[1]:
            raise ValueError(
                f"func returned shape {new.shape} for params of shape {params.shape}; expected "
                f"({len(params)}, k), one row each."
            )
        if not np.isfinite(new).all():
            row = int(np.argwhere(~np.isfinite(new))[0, 0])
            raise ValueError(
                f"func returned NaN or infinity for the params {params[row].tolist()}."
            )
        return new

    def _names(self, k: int) -> tuple[str, ...]:
        if self.names is None:
            return tuple(f"theta{i}" for i in range(k))
        names = tuple(str(name) for name in self.names)
        if len(names) != k or len(set(names)) < k:
            raise ValueError(f"names = {list(names)}: func returned {k} columns, name each once.")
        return names
