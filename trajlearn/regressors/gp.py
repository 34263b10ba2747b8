"""Gaussian process regression with a length scale for every input and every output."""

import warnings
from numbers import Integral
from typing import Any, ClassVar, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import Tags, check_array, check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data
from threadpoolctl import threadpool_limits

from trajlearn._sklearn import Interval, StrOptions, fit_context
from trajlearn.regressors._gp_fit import Draws, Minimum, Search, fit_exact, fit_sparse
from trajlearn.regressors._gp_models import Floats, Hyperparameters
from trajlearn.regressors._gp_posterior import (
    Posterior,
    exact_posterior,
    predict_rows,
    sparse_posterior,
)
from trajlearn.regressors._samples import standardisation
from trajlearn.regressors._threads import threads_for

__all__ = ["GPRegressor"]

# An input whose spread is below this share of its magnitude is a constant plus round-off.
_CONSTANT = 1e-9


class GPRegressor(RegressorMixin, BaseEstimator):
    """Gaussian process regression, exact for up to a few thousand rows, sparse beyond.

    Inputs and targets are standardised inside. Every target has a GP of its own, with mean
    zero (the mean of the training targets), a length scale for each input (ARD), a signal and a
    noise variance. These are found by L-BFGS on the marginal likelihood times weak log-normal
    priors [1]_, in float64. Above `max_exact` rows the marginal likelihood is replaced by
    Titsias' variational bound [2]_, whose inducing points are moved along with the rest.

    Parameters
    ----------
    kernel : {"rbf", "matern12", "matern32", "matern52"}, default="rbf"
        Covariance function; the digits of Matern's are twice its smoothness (nu 1/2, 3/2, 5/2).
    n_restarts : int, default=2
        Starts of L-BFGS drawn from the priors, beside the one at the priors' medians. With more
        than 200 rows the starts compete on 200 of them and the best goes on with all.
    max_iter : int, default=100
        Iterations of L-BFGS for every start. Exact fits rarely need 60; a sparse fit, which
        moves its inducing points, usually spends them all.
    max_exact : int, default=2000
        Most rows for which the GP is exact: a fit takes time in proportion to rows cubed.
    n_inducing : int, default=200
        Inducing points of the sparse GP.
    max_fit_rows : int, default=5000
        Hyper-parameters and inducing points of the sparse GP are found on at most this many
        rows, drawn at random; its posterior then takes in all rows.
    random_state : int, RandomState or None, default=None
        Seed of the starts, of drawn rows and of the first inducing points.
    verbose : int, default=0
        1 prints a line for every target.

    Attributes
    ----------
    n_features_in_ : int
    length_scales_ : ndarray of shape (n_targets, n_features)
        In input units; long for an input that does not matter.
    signal_std_ : ndarray of shape (n_targets,)
        Prior standard deviation of the noise-free function, in target units.
    noise_std_ : ndarray of shape (n_targets,)
        Standard deviation of the noise, in target units.
    log_marginal_likelihood_ : ndarray of shape (n_targets,)
        Log density of the training targets (in their units) at the fitted hyper-parameters,
        without the priors; for a sparse GP its lower bound.
    n_iter_ : ndarray of int of shape (n_targets,)
        Iterations of the last run of L-BFGS for each target.
    is_sparse_ : bool
        Whether there were more than `max_exact` rows.
    input_offset_, input_scale_ : ndarray of shape (n_features,)
    target_mean_, target_scale_ : ndarray of shape (n_targets,)
        The standardisation. A constant input (also one with a spread from round-off only) is
        divided by its magnitude; a constant target has scale 1.
    basis_ : ndarray of shape (1 or n_targets, m, n_features)
        Standardised training inputs (exact, shared by all targets) or inducing points (sparse).
    weights_ : ndarray of shape (n_targets, m)
    root_ : ndarray of shape (n_targets, m, m)
        The mean is ``k @ weights_``, the variance ``signal - |root_ @ k|**2``, k the covariances
        with the basis.

    See Also
    --------
    MLPEnsembleRegressor : Neural networks, for many rows.

    Notes
    -----
    Fitting takes O(n^3) time for every evaluation, the fitted state O(n_targets m^2) memory.
    Fitting and predicting run on one thread. The prediction of a row does not depend on the
    other rows, to the last bit. Sample weights are not supported.

    References
    ----------
    .. [1] C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006,
       chapters 2 and 5.
    .. [2] M. Titsias, "Variational Learning of Inducing Variables in Sparse Gaussian Processes",
       AISTATS 2009.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import GPRegressor
    >>> rng = np.random.default_rng(0)
    >>> X = rng.uniform(-2, 2, size=(80, 2))
    >>> y = np.sin(2 * X[:, 0]) + 0.1 * rng.normal(size=80)
    >>> gp = GPRegressor(random_state=0).fit(X, y)
    >>> mean, std = gp.predict([[0.5, 0.0]], return_std=True)
    >>> bool(abs(mean[0] - np.sin(1.0)) < 0.1)
    True
    >>> bool(gp.length_scales_[0, 1] > 5 * gp.length_scales_[0, 0])
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "kernel": [StrOptions({"rbf", "matern12", "matern32", "matern52"})],
        "n_restarts": [Interval(Integral, 0, None, closed="left")],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "max_exact": [Interval(Integral, 0, None, closed="left")],
        "n_inducing": [Interval(Integral, 1, None, closed="left")],
        "max_fit_rows": [Interval(Integral, 1, None, closed="left")],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        *,
        kernel: str = "rbf",
        n_restarts: int = 2,
        max_iter: int = 100,
        max_exact: int = 2000,
        n_inducing: int = 200,
        max_fit_rows: int = 5000,
        random_state: int | np.random.RandomState | None = None,
        verbose: int = 0,
    ) -> None:
        self.kernel = kernel
        self.n_restarts = n_restarts
        self.max_iter = max_iter
        self.max_exact = max_exact
        self.n_inducing = n_inducing
        self.max_fit_rows = max_fit_rows
        self.random_state = random_state
        self.verbose = verbose

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Find the hyper-parameters and condition on the rows.

        Parameters
        ----------
        X : array-like of shape (n, n_features)
        y : array-like of shape (n,) or (n, n_targets)

        Returns
        -------
        self

        Raises
        ------
        ValueError
            For NaN or infinite values, wrong shapes, or a column whose spread overflows.

        Warns
        -----
        ConvergenceWarning
            If an exact fit used up `max_iter`.
        """
        # C order, and targets one by one: the bits of a sum depend on how its terms lie in memory
        rows, y = validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64, order="C"
        )
        values: Floats = check_array(y, dtype=np.float64, ensure_2d=False, input_name="y")
        self._y_ndim = values.ndim
        targets = np.ascontiguousarray(values.reshape(len(rows), -1).T)
        self.input_offset_, self.input_scale_ = _input_standardisation(rows)
        self.target_mean_, self.target_scale_ = _target_standardisation(targets)
        self.is_sparse_ = len(rows) > self.max_exact
        inputs = (rows - self.input_offset_) / self.input_scale_
        targets = (targets - self.target_mean_[:, None]) / self.target_scale_[:, None]

        draws = Draws.make(check_random_state(self.random_state), inputs.shape, self.n_restarts)
        # torch first: its own BLAS is out of threadpoolctl's sight, but its thread count is not
        with threads_for(0.0), threadpool_limits(1):
            found = [self._search(inputs, target, draws) for target in targets]
            self._set_hyperparameters([minimum for minimum, _ in found])
            self.basis_ = np.stack([basis for _, basis in found[: None if self.is_sparse_ else 1]])
            posteriors = [self._condition(i, inputs, target) for i, target in enumerate(targets)]
        self.weights_ = np.stack([p.weights for p in posteriors])
        self.root_ = np.stack([p.root for p in posteriors])
        log_likelihood = np.array([p.log_likelihood for p in posteriors])
        self.log_marginal_likelihood_ = log_likelihood - len(rows) * np.log(self.target_scale_)
        return self

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Floats: ...

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Floats, Floats]: ...

    @overload
    def predict(self, X: ArrayLike, return_std: bool) -> Floats | tuple[Floats, Floats]: ...

    def predict(self, X: ArrayLike, return_std: bool = False) -> Floats | tuple[Floats, Floats]:
        """Mean and, on request, standard deviation of a new observation.

        Parameters
        ----------
        X : array-like of shape (n, n_features)
        return_std : bool, default=False
            Also give the total predictive standard deviation: the uncertainty about the
            function and the noise of an observation together, ``sqrt(var f + noise_std_**2)``.

        Returns
        -------
        mean : ndarray of shape (n,) or (n, n_targets)
        std : ndarray of the same shape, in target units
            Only if `return_std`.
        """
        check_is_fitted(self)
        rows = validate_data(self, X, dtype=np.float64, reset=False)
        with np.errstate(over="ignore"):
            rows = (rows - self.input_offset_) / self.input_scale_
        shape = len(rows), len(self.weights_)
        mean, std = np.empty(shape), np.empty(shape)
        for i, scale in enumerate(self.target_scale_):
            h = self._hyperparameters(i)
            basis = self.basis_[i if self.is_sparse_ else 0]
            root = self.root_[i] if return_std else None
            values, variance = predict_rows(self.kernel, rows, basis, h, self.weights_[i], root)
            mean[:, i] = self.target_mean_[i] + scale * values
            if variance is not None:
                std[:, i] = scale * np.sqrt(variance + h.noise_variance)
        if self._y_ndim == 1:
            mean, std = mean[:, 0], std[:, 0]
        return (mean, std) if return_std else mean

    def _search(self, inputs: Floats, target: Floats, draws: Draws) -> tuple[Minimum, Floats]:
        """Hyper-parameters of one target, and its basis."""
        search = Search(self.kernel, self.max_iter, self.max_fit_rows, self.n_inducing)
        if self.is_sparse_:
            found, basis = fit_sparse(inputs, target, search, draws)
        else:
            found, basis = fit_exact(inputs, target, search, draws), inputs
            if not found.converged:
                warnings.warn(
                    f"GPRegressor stopped after max_iter={self.max_iter} iterations of L-BFGS, "
                    "before the marginal likelihood had settled. Increase max_iter.",
                    ConvergenceWarning,
                    stacklevel=5,
                )
        if self.verbose:
            kind = f"sparse, {len(basis)} points" if self.is_sparse_ else "exact"
            h = Hyperparameters.from_theta(found.point)
            print(
                f"GPRegressor ({kind}): {found.n_iter} iterations; in standardised units noise "
                f"{h.noise_variance**0.5:.3g}, signal {h.signal_variance**0.5:.3g}, length scales "
                f"{np.array2string(h.length_scales, precision=3)}"
            )
        return found, basis

    def _condition(self, i: int, inputs: Floats, target: Floats) -> Posterior:
        """Posterior of target i at the fitted attributes."""
        h = self._hyperparameters(i)
        if self.is_sparse_:
            return sparse_posterior(self.kernel, self.basis_[i], inputs, target, h)
        return exact_posterior(self.kernel, inputs, target, h)

    def _set_hyperparameters(self, found: list[Minimum]) -> None:
        """Keep them in the units of the data."""
        h = [Hyperparameters.from_theta(minimum.point) for minimum in found]
        scale = self.target_scale_
        self.length_scales_ = np.stack([each.length_scales for each in h]) * self.input_scale_
        self.signal_std_ = scale * np.sqrt([each.signal_variance for each in h])
        self.noise_std_ = scale * np.sqrt([each.noise_variance for each in h])
        self.n_iter_ = np.array([minimum.n_iter for minimum in found])

    def _hyperparameters(self, i: int) -> Hyperparameters:
        """Those of target i in standardised units."""
        scale = self.target_scale_[i]
        return Hyperparameters(
            self.length_scales_[i] / self.input_scale_,
            float(self.signal_std_[i] / scale) ** 2,
            float(self.noise_std_[i] / scale) ** 2,
        )


def _input_standardisation(X: Floats) -> tuple[Floats, Floats]:
    """Offset and scale of every column.

    A constant is left where it is and divided by its magnitude: standardising round-off would
    put a value that differs by a tenth at 1e11.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        magnitude = np.abs(X).max(axis=0)
        constant = np.ptp(X, axis=0) <= _CONSTANT * magnitude
        offset = np.where(constant, 0.0, X.mean(axis=0))
        scale = np.where(constant, np.where(magnitude > 0, magnitude, 1.0), X.std(axis=0))
    _check_finite(scale, "X")
    return offset, scale


def _target_standardisation(targets: Floats) -> tuple[Floats, Floats]:
    """Mean and scale of every target (a row each)."""
    with np.errstate(over="ignore", invalid="ignore"):
        mean, scale = np.array([standardisation(target, None) for target in targets]).T
    _check_finite(scale, "y")
    return mean, scale


def _check_finite(scale: Floats, name: str) -> None:
    if not np.isfinite(scale).all():
        column = int(np.flatnonzero(~np.isfinite(scale))[0])
        raise ValueError(
            f"Column {column} of {name} spreads so widely that its variance overflows; "
            "give it in larger units."
        )
