"""Scaling rows block by block."""

from collections.abc import Callable
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.preprocessing import (
    FunctionTransformer,
    MaxAbsScaler,
    MinMaxScaler,
    RobustScaler,
    StandardScaler,
)
from sklearn.utils.validation import check_is_fitted, has_fit_parameter, validate_data

from trajlearn._sklearn import HasMethods, StrOptions
from trajlearn.dynamics.horizon import HorizonFeatures
from trajlearn.dynamics.phase import PhaseFeatures
from trajlearn.trajectories._layout import Layout

__all__ = ["BlockScaler"]

Floats = NDArray[np.float64]

# scikit-learn's scalers that map each column x to a * x + b
_AFFINE = (StandardScaler, MinMaxScaler, MaxAbsScaler, RobustScaler)
# a spread below this share of the largest magnitude is round-off
_CONSTANT = 1e-6
# blocks that share the slot of another
_SLOT_OF = {"references": "state", "dt": "action", "previous": "action"} | {
    "past_states": "state",
    "past_actions": "action",
}


class BlockScaler(TransformerMixin, BaseEstimator):
    """Scale each block of a row by a transformer of its own.

    Each slot is a scikit-learn transformer, ``"passthrough"``, or None for the default: states,
    actions, references and phases to mean 0 and variance 1, params and horizons to [-1, 1], the
    one-hot context as it is. A column that is constant up to round-off is divided by its
    magnitude instead, so that a later change of a tenth stays a tenth.

    Parameters
    ----------
    state, action, horizon, params, phase : transformer, "passthrough" or None, default=None
        What each block is scaled by.
    param_bounds : array-like of shape (p, 2) or None, default=None
        Lower and upper bound of each parameter, mapped to -1 and 1 whatever the data hold. With
        few theta in the log, or one, theta elsewhere in the bounds is then within the range of
        the inputs. None scales params by the data (or by `params`).
    features : callable or None, default=None
        ``features(states (n, d_s), params (n, p)) -> (n, k)``: what is known to matter, such as
        the control error, computed from the unscaled rows. The k columns follow all blocks,
        scaled to mean 0 and variance 1. Row i may depend on row i only; p = 0 where rows hold no
        params. It is called for predicted states, too, and has to be finite there. Under an
        estimator with a `baseline` states are relative to it.

    Attributes
    ----------
    parts_ : list of (columns, transformer)
        Columns of the input, followed by the features, and the fitted transformer (None:
        division by `magnitude_`).
    block_columns_ : dict from block to ndarray
        Columns of the output; those of the features under ``"features"``.

    See Also
    --------
    HorizonFeatures, PhaseFeatures : the choice of `TrajectoryRegressor` for horizon and phase.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import BlockScaler
    >>> rows = np.array([[0.0, 1.0, 5.0], [2.0, 3.0, 15.0]])  # two states, one parameter
    >>> layout = {"state": slice(0, 2), "params": slice(2, 3)}
    >>> BlockScaler().fit(rows, layout=layout).transform(rows)
    array([[-1., -1., -1.],
           [ 1.,  1.,  1.]])

    The parameter is the set-point of the second state, and the error drives the system:

    >>> def error(states, params):
    ...     return params - states[:, 1:]
    >>> BlockScaler(features=error).fit(rows, layout=layout).transform(rows)
    array([[-1., -1., -1., -1.],
           [ 1.,  1.,  1.,  1.]])
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        slot: [HasMethods(["fit", "transform"]), StrOptions({"passthrough"}), None]
        for slot in ("state", "action", "horizon", "params", "phase")
    } | {"param_bounds": ["array-like", None], "features": [callable, None]}

    def __init__(
        self,
        *,
        state: Any = None,
        action: Any = None,
        horizon: Any = None,
        params: Any = None,
        phase: Any = None,
        param_bounds: ArrayLike | None = None,
        features: Callable[[Floats, Floats], Any] | None = None,
    ) -> None:
        self.state = state
        self.action = action
        self.horizon = horizon
        self.params = params
        self.phase = phase
        self.param_bounds = param_bounds
        self.features = features

    def fit(
        self,
        X: ArrayLike,
        y: None = None,
        *,
        layout: Layout | None = None,
        sample_weight: Floats | None = None,
    ) -> Self:
        """Fit the transformer of each block.

        Parameters
        ----------
        X : array-like of shape (n, n_features)
        y : None
        layout : mapping from block to slice, optional
            Default: all columns are states.
        sample_weight : ndarray of shape (n,), optional
            Passed to the transformers that take it.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If `features` is given and the layout has no states, or it returns something else
            than a finite (n, k); if `param_bounds` are no bounds of the params in the rows.
        """
        self._validate_params()
        rows: Floats = validate_data(self, X, dtype=np.float64)
        if layout is None:
            layout = Layout.of_rows(rows.shape[1], rows.shape[1], ("params",))
        blocks = dict(layout.items())
        if self.features is not None:
            self.arguments_ = self._argument_columns(blocks)
            computed = self._computed(rows)
            blocks["features"] = slice(rows.shape[1], rows.shape[1] + computed.shape[1])
            rows = np.concatenate([rows, computed], axis=1)
        largest = np.abs(rows).max(axis=0)
        constant = np.ptp(rows, axis=0) <= _CONSTANT * largest
        if self.param_bounds is not None:
            bounded = self._scaler_of_bounds(blocks)
            constant[blocks["params"]] = False
        self.magnitude_ = np.where(largest > 0, largest, 1.0)
        self.parts_: list[tuple[NDArray[np.intp], Any]] = []
        self.block_columns_: dict[str, NDArray[np.intp]] = {}
        width = 0
        for block, where in blocks.items():
            columns = np.arange(rows.shape[1])[where]
            varying = columns[~constant[columns]]
            begin = width
            if block == "params" and self.param_bounds is not None:
                self.parts_.append((varying, bounded))
                width += len(varying)
            elif len(varying):
                transformer = self._transformer(block)
                values = rows[:, varying]
                if sample_weight is not None and has_fit_parameter(transformer, "sample_weight"):
                    transformer.fit(values, sample_weight=sample_weight)
                else:
                    transformer.fit(values)
                self.parts_.append((varying, transformer))
                width += np.shape(transformer.transform(values[:1]))[1]
            if constant[columns].any():
                self.parts_.append((columns[constant[columns]], None))
                width += int(constant[columns].sum())
            self.block_columns_[block] = np.arange(begin, width)
        self._set_affine()
        return self

    def _scaler_of_bounds(self, blocks: dict[str, slice]) -> MinMaxScaler:
        """What maps `param_bounds` to -1 and 1."""
        if self.params is not None:
            raise ValueError("params= and param_bounds= both say how to scale params: give one.")
        where = blocks.get("params", slice(0))
        p = len(range(self.n_features_in_)[where])
        bounds = np.asarray(self.param_bounds, dtype=np.float64)
        if not p or bounds.shape != (p, 2):
            raise ValueError(
                f"param_bounds has shape {bounds.shape}, and the rows hold {p} params (blocks "
                f"{list(blocks)}): give (p, 2), the lower and the upper bound of each"
                + ("." if p else ", to a model that has params among its inputs.")
            )
        if not (np.isfinite(bounds).all() and (bounds[:, 0] < bounds[:, 1]).all()):
            raise ValueError(
                "param_bounds must be finite, with each lower bound below the upper one; got "
                f"{bounds.tolist()}."
            )
        return MinMaxScaler((-1, 1)).fit(bounds.T)

    def _argument_columns(
        self, blocks: dict[str, slice]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns of the input that hold the arguments of `features`."""
        if "state" not in blocks:
            raise ValueError(
                f"{self._features_name} computes from states, but the rows have no block 'state' "
                f"(they have {list(blocks)}). Add it to inputs= or the layout, or leave features= "
                "out."
            )
        columns = np.arange(self.n_features_in_)
        return columns[blocks["state"]], columns[blocks.get("params", slice(0))]

    @property
    def _features_name(self) -> str:
        return f"features={getattr(self.features, '__name__', type(self.features).__name__)}"

    def _computed(self, rows: Floats, width: int | None = None) -> Floats:
        """Features of unscaled rows (n, k); k = `width` if that is known."""
        assert self.features is not None  # callers have checked
        # take() copies, always in C order: the callable may overwrite its arguments, and finds
        # the same memory layout for one row as for many
        states, params = (rows.take(columns, axis=1) for columns in self.arguments_)
        values = np.asarray(self.features(states, params), dtype=np.float64)
        k = values.shape[1] if values.ndim == 2 else 0
        if not k or values.shape != (len(rows), width or k):
            hint = " (inputs= decides whether rows hold params)" if not params.size else ""
            raise ValueError(
                f"{self._features_name} returned shape {values.shape} for states of shape "
                f"{states.shape} and params of shape {params.shape}{hint}; expected "
                f"({len(rows)}, {width or 'k'}), a row for each row of states and at least one "
                "column, always as many."
            )
        finite = np.isfinite(values).all(axis=1)
        if not finite.all():
            states, params = (rows[~finite][0, columns] for columns in self.arguments_)
            raise ValueError(
                f"{self._features_name} returned NaN or infinite values, first for states {states} "
                f"and params {params}. Make it finite for all states and params, for instance by "
                "clipping them: a forecast asks for it at states that no episode has visited."
            )
        return values

    def _transformer(self, block: str) -> Any:
        slot = _SLOT_OF.get(block, block)
        if slot == "features":
            return StandardScaler()
        chosen = "passthrough" if slot == "context" else getattr(self, slot)
        if chosen == "passthrough":
            return FunctionTransformer()
        if chosen is not None:
            return clone(chosen)
        return StandardScaler() if slot in ("state", "action", "phase") else MinMaxScaler((-1, 1))

    def _set_affine(self) -> None:
        """Scale and shift of all outputs, where every part is affine: one fused operation."""
        self.affine_: tuple[NDArray[np.intp], Floats, Floats] | None = None
        maps = [self.affine_part(*part) for part in self.parts_]
        if all(part is not None for part in maps):
            columns = np.concatenate([columns for columns, _ in self.parts_])
            scale, shift = (np.concatenate(parts) for parts in zip(*maps))
            self.affine_ = columns, scale, shift

    def affine_part(
        self, columns: NDArray[np.intp], transformer: Any
    ) -> tuple[Floats, Floats] | None:
        """Scale and shift of one of `parts_`, or None if it does more than that."""
        if transformer is None:
            return 1 / self.magnitude_[columns], np.zeros(len(columns))
        return _affine(transformer, len(columns))

    def transform(self, X: ArrayLike) -> Floats:
        """Scaled rows, blocks in order.

        Parameters
        ----------
        X : array-like of shape (n, n_features)

        Returns
        -------
        ndarray of shape (n, width)
        """
        check_is_fitted(self)
        return self.scaled(validate_data(self, X, dtype=np.float64, reset=False))

    def scaled(self, X: Floats) -> Floats:
        """`transform` without validation of X, for hot loops."""
        if self.features is not None:
            width = len(self.magnitude_) - self.n_features_in_
            X = np.concatenate([X, self._computed(X, width)], axis=1)
        if self.affine_ is not None:
            columns, scale, shift = self.affine_
            return X[:, columns] * scale + shift
        parts = []
        for columns, transformer in self.parts_:
            values = X[:, columns]
            if transformer is None:
                parts.append(values / self.magnitude_[columns])
            elif isinstance(transformer, (HorizonFeatures, PhaseFeatures)):
                parts.append(transformer.features(values))
            elif (affine := _affine(transformer, len(columns))) is not None:
                parts.append(values * affine[0] + affine[1])
            else:
                parts.append(np.asarray(transformer.transform(values)))
        return np.concatenate(parts, axis=1)


def _affine(transformer: Any, width: int) -> tuple[Floats, Floats] | None:
    """Scale and shift of a fitted transformer that maps each column x to a * x + b."""
    if isinstance(transformer, FunctionTransformer) and transformer.func is None:
        return np.ones(width), np.zeros(width)
    if not isinstance(transformer, _AFFINE) or getattr(transformer, "clip", False):
        return None
    if isinstance(transformer, MinMaxScaler):
        return transformer.scale_, transformer.min_
    scale = np.ones(width) if getattr(transformer, "scale_", None) is None else transformer.scale_
    centre = getattr(transformer, "mean_", None)
    if isinstance(transformer, RobustScaler):
        centre = transformer.center_
    if isinstance(transformer, StandardScaler) and not transformer.with_mean:
        centre = None
    return 1 / scale, np.zeros(width) if centre is None else -centre / scale
