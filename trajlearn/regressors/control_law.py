"""A learner of control laws: short polynomials through the saturation, or a network."""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import Tags, check_random_state
from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data

from trajlearn._sklearn import Interval, fit_context
from trajlearn.regressors._rows_in_folds import RowsInFolds, dealt, spread_of
from trajlearn.regressors._saturated import (
    Floats,
    Term,
    forward_errors,
    forward_order,
    held_out_error,
    monomials,
    saturated_fit,
    sum_of,
    terms_of,
)
from trajlearn.regressors.mlp import MLPEnsembleRegressor

__all__ = ["ControlLawRegressor"]

_RIDGE = 1e-12
# ridges of the bilinear law, shares of the mean square of a column
_RIDGES = (1e-12, 1e-6, 1e-4, 1e-2)
# a law that misses no training row by more, in standard deviations, is the law
_EXACT = 1e-5
# rows that terms are chosen on, evenly spaced
_FOR_CHOICE = 8000
# monomials to choose from
_MOST_CANDIDATES = 800
# inputs of the first choice that are tried in the third degree
_MOST_INPUTS = 10


class ControlLawRegressor(RegressorMixin, BaseEstimator):
    """Regressor of what a controller does: outputs are limited, and mostly a short formula.

    First the bilinear law is tried, which a linear feedback with gains among the inputs is: if it
    reproduces every target, saturation included, it is taken, and holds from few gains on (p + 1
    of p gains). Otherwise each output is the best on held-out groups of the bilinear law with some
    ridge, and of a sum of monomials of the inputs of degree one and two, or of degree three in the
    inputs that were found to matter, chosen one by one. All are fitted through the saturation.
    Where that leaves more than `tolerance` of the standard deviation, a network is tried, and kept
    if it is better on held-out groups. Predictions are clipped to the range of the targets.

    Parameters
    ----------
    degree : {1, 2, 3}, default=3
    max_terms : int, default=60
        Monomials of an output that are chosen one by one, at most.
    tolerance : float, default=0.02
        Held-out error, in standard deviations of the output, that no network is tried for.
    hidden_layer_sizes : sequence of int, default=(64, 64)
        Of the network.
    max_steps : int or None, default=None
        Of the network, see `MLPEnsembleRegressor`.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    terms_ : list of lists of tuples
        Monomials of each output, as tuples of columns.
    coefficients_ : list of ndarray
    ridges_ : list of float
    exact_ : ndarray of bool of shape (n_targets,)
        Which targets the bilinear law reproduces.
    held_out_ : ndarray of shape (n_targets,)
        Held-out error of each output (rms), in its standard deviations; 0 where exact.
    by_network_ : ndarray of bool of shape (n_targets,)
    network_ : MLPEnsembleRegressor or None
    limits_ : ndarray of shape (2, n_targets)
    n_features_in_ : int

    Notes
    -----
    Where an output is at its limit, only a bound is known of what it would have been without, so
    that such a row counts only while the fit is inside the limits there. Least squares on the
    clipped outputs finds neither the slope nor the corner.

    Examples
    --------
    A feedback ``-k s`` with another gain k in each episode, limited to 1:

    >>> import numpy as np
    >>> from trajlearn.regressors.control_law import ControlLawRegressor
    >>> s, k = np.random.default_rng(0).normal(size=200), np.repeat([1.0, 2.0, 3.0, 4.0], 50)
    >>> X, y = np.column_stack([s, k]), np.clip(-k * s, -1, 1)
    >>> model = ControlLawRegressor().fit(X, y, gains=[1])
    >>> bool(np.allclose(model.predict([[0.2, 2.5], [9.0, 2.5]]), [-0.5, -1.0]))
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "degree": [Interval(Integral, 1, 3, closed="both")],
        "max_terms": [Interval(Integral, 1, None, closed="left")],
        "tolerance": [Interval(Real, 0, None, closed="left")],
        "hidden_layer_sizes": ["array-like"],
        "max_steps": [Interval(Integral, 1, None, closed="left"), None],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        *,
        degree: int = 3,
        max_terms: int = 60,
        tolerance: float = 0.02,
        hidden_layer_sizes: Sequence[int] = (64, 64),
        max_steps: int | None = None,
        random_state: Any = None,
    ) -> None:
        self.degree = degree
        self.max_terms = max_terms
        self.tolerance = tolerance
        self.hidden_layer_sizes = hidden_layer_sizes
        self.max_steps = max_steps
        self.random_state = random_state

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    @fit_context(prefer_skip_nested_validation=True)
    def fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        *,
        sample_weight: ArrayLike | None = None,
        groups: ArrayLike | None = None,
        gains: ArrayLike | None = None,
    ) -> Self:
        """Choose terms and fit them.

        Parameters
        ----------
        X : array-like of shape (n, k)
            Scaled to about unit size.
        y : array-like of shape (n,) or (n, n_targets)
        sample_weight : array-like of shape (n,), optional
        groups : array-like of shape (n,), optional
            Labels of rows that are held out together; without them, equal rows are.
        gains : array-like of int, optional
            Columns of X that hold control parameters, which multiply the others in the bilinear
            law; without them it is linear.

        Returns
        -------
        self
        """
        rows, targets = validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64
        )
        weight = _check_sample_weight(
            sample_weight, rows, dtype=np.float64, ensure_non_negative=True
        )
        keep = weight > 0
        labels = None if groups is None else _labels(groups, len(rows))[keep]
        self._y_ndim = targets.ndim
        rows, targets = rows[keep], np.asarray(targets, dtype=np.float64)[keep]
        targets = targets.reshape(len(rows), -1)
        fold = dealt(np.concatenate([rows, targets], axis=1), labels)
        data = RowsInFolds(rows, targets, weight[keep], fold)
        self.limits_ = np.stack([targets.min(axis=0), targets.max(axis=0)])
        product = _bilinear(rows.shape[1], _columns(gains, rows.shape[1]))
        laws = [self._law(data, j, product) for j in range(targets.shape[1])]
        self.terms_ = [law.terms for law in laws]
        self.ridges_ = [law.ridge for law in laws]
        self.exact_ = np.array([law.exact for law in laws])
        self.coefficients_ = [self._fitted(data, j, law) for j, law in enumerate(laws)]
        self._judge(data, laws, product)
        return self

    def _law(self, data: RowsInFolds, j: int, product: list[Term]) -> "_Law":
        """The bilinear law if it reproduces the target, else what predicts held-out rows best."""
        law, y = _Law(product, _RIDGE, exact=True), data.y[:, j]
        if len(product) <= min(data.weight.sum() / 2, _MOST_CANDIDATES):
            fitted = monomials(data.X, product) @ self._fitted(data, j, law)
            off = np.abs(np.clip(fitted, *self.limits_[:, j]) - y)
            if (off <= _EXACT * spread_of(y, data.weight)).all():
                return law
        # what a saturated output would have been is not known yet
        inside = np.flatnonzero((y > y.min()) & (y < y.max()))
        if not len(inside):
            return _Law([()], _RIDGE)
        return self._chosen(data.at(inside[:: -(-len(inside) // _FOR_CHOICE)]), j, product)

    def _fitted(self, data: RowsInFolds, j: int, law: "_Law") -> Floats:
        low, high = self.limits_[:, j]
        Z = monomials(data.X, law.terms)
        return saturated_fit(Z, data.y[:, j], data.weight, (low, high), law.ridge)

    def _chosen(self, data: RowsInFolds, j: int, product: list[Term]) -> "_Law":
        columns = list(range(data.X.shape[1]))
        candidates = terms_of(columns, min(self.degree, 2))
        if len(candidates) > _MOST_CANDIDATES:
            candidates = terms_of(columns, 1)
        terms, error = self._forward(data, j, candidates)
        if self.degree == 3:
            used = list(dict.fromkeys(column for term in terms for column in term))
            third = terms_of(sorted(used[:_MOST_INPUTS]), 3)
            bent, its = self._forward(data, j, third)
            if its < error:
                terms, error = bent, its
        if len(product) > _MOST_CANDIDATES:
            return _Law(terms, _RIDGE)
        folds = data.sums(product, j)
        errors = [held_out_error(folds, ridge) for ridge in _RIDGES]
        best = int(np.argmin(errors))
        return _Law(product, _RIDGES[best]) if errors[best] < error else _Law(terms, _RIDGE)

    def _forward(
        self, data: RowsInFolds, j: int, candidates: list[Term]
    ) -> tuple[list[Term], float]:
        """Terms in the order of their choice, and the held-out sum of squares."""
        folds = data.sums(candidates, j)
        most = min(self.max_terms, len(candidates), max(int(data.weight.sum() / 10), 1))
        total = sum_of(folds)
        if len(folds) == 1:
            return [candidates[i] for i in forward_order(total, most)], total.square
        errors = forward_errors(folds, most, _RIDGE)
        # round-off aside, no term that does not help
        enough = int(np.argmax(errors <= errors.min() + 1e-12 * errors[0]))
        order = forward_order(total, max(enough, 1))
        return [candidates[i] for i in order], float(errors[enough])

    def _judge(self, data: RowsInFolds, laws: list["_Law"], product: list[Term]) -> None:
        """Held-out errors; a network takes over the outputs that it is better at."""
        spread = spread_of(data.y, data.weight)
        self.by_network_, self.network_ = np.zeros(len(laws), dtype=bool), None
        splits = data.splits()

        def missed(predictions: list[Floats]) -> Floats:
            """Root mean squared error in standard deviations."""
            rest = [out for _, out in splits]
            y = np.concatenate([out.y for out in rest])
            weight = np.concatenate([out.weight for out in rest])
            error = np.clip(np.concatenate(predictions), *self.limits_) - y
            rms: Floats = np.sqrt(np.average(error**2, axis=0, weights=weight))
            return rms / np.where(spread > 0, spread, 1.0)

        self.held_out_ = np.where(
            self.exact_, 0.0, missed([self._unseen(*split, laws, product) for split in splits])
        )
        if (self.held_out_ <= self.tolerance).all():
            return
        network = MLPEnsembleRegressor(
            hidden_layer_sizes=self.hidden_layer_sizes,
            max_steps=self.max_steps,
            random_state=check_random_state(self.random_state).randint(2**31),
        )
        width, predictions = data.y.shape[1], []
        for own, out in splits:
            network.fit(own.X, own.y, sample_weight=own.weight)
            predictions.append(network.predict(out.X).reshape(-1, width))
        error = missed(predictions)
        self.by_network_ = error < self.held_out_
        self.held_out_ = np.minimum(error, self.held_out_)
        if self.by_network_.any():
            self.network_ = network.fit(data.X, data.y, sample_weight=data.weight)

    def _unseen(
        self, own: RowsInFolds, out: RowsInFolds, laws: list["_Law"], product: list[Term]
    ) -> Floats:
        """Predictions of rows by laws that were fitted on others."""
        predicted = np.empty(out.y.shape)
        for j, law in enumerate(laws):
            if own.is_small:
                # with few rows, what was chosen with the held-out ones tells little
                law = self._law(own, j, product)
            predicted[:, j] = monomials(out.X, law.terms) @ self._fitted(own, j, law)
        return predicted

    def predict(self, X: ArrayLike) -> Floats:
        """Predict, within the range of the targets.

        Parameters
        ----------
        X : array-like of shape (n, k)

        Returns
        -------
        ndarray of shape (n,) or (n, n_targets)
        """
        check_is_fitted(self)
        rows: Floats = validate_data(self, X, reset=False, dtype=np.float64)
        values = np.zeros((len(rows), len(self.terms_)))
        for j, terms in enumerate(self.terms_):
            # term by term: a matrix product may round differently with the number of rows
            for term, coefficient in zip(terms, self.coefficients_[j], strict=True):
                values[:, j] += monomials(rows, [term])[:, 0] * coefficient
        if self.network_ is not None:
            values = np.where(self.by_network_, self.network_.predict(rows), values)
        values = np.clip(values, *self.limits_)
        return values[:, 0] if self._y_ndim == 1 else values


@dataclass(frozen=True)
class _Law:
    """Terms of an output, and the ridge they are fitted with."""

    terms: list[Term]
    ridge: float
    exact: bool = False


def _labels(groups: ArrayLike, n: int) -> NDArray[Any]:
    labels = np.asarray(groups)
    if labels.shape != (n,):
        raise ValueError(f"groups has shape {labels.shape}; give one label a row ({n}).")
    return labels


def _columns(gains: ArrayLike | None, width: int) -> list[int]:
    """Columns that hold gains, each once."""
    if gains is None:
        return []
    columns = np.asarray(gains)
    if not columns.size:
        return []
    if columns.ndim != 1 or columns.dtype.kind not in "iu":
        raise ValueError(f"gains = {gains!r} must be a list of columns of X, whole numbers.")
    if columns.min() < 0 or columns.max() >= width:
        raise ValueError(f"gains = {columns.tolist()}: X has the columns 0 to {width - 1}.")
    return sorted(set(columns.tolist()))


def _bilinear(width: int, gains: list[int]) -> list[Term]:
    """Monomials of the products of one gain, or none, and one other input, or none."""
    others = [column for column in range(width) if column not in gains]
    single: list[Term] = [(), *((column,) for column in range(width))]
    return single + [(other, gain) for other in others for gain in gains]
