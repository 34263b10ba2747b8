"""Polynomial least squares: the honest baseline on smooth plants, fitted in milliseconds."""

from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import PolynomialFeatures

__all__ = ["polynomial", "polynomial_predictor"]

Floats = NDArray[np.float64]


def polynomial(degree: int = 3, *, alpha: float = 1e-6) -> Pipeline:
    """Least squares on all monomials of the inputs up to a degree.

    A Pipeline of scikit-learn's own parts, so that ``features__degree`` and ``linear__alpha`` can
    be searched. Inputs should be scaled (the dynamics estimators do so; elsewhere put a
    `StandardScaler` in front). Of d inputs there are (d + degree)! / (d! degree!) monomials, and
    the fit takes their square times the rows: 56 for a cartpole with its force (0.05 s for 20,000
    rows), 969 for a state of 12 with four actions.

    Parameters
    ----------
    degree : int, default=3
        At least 1, which is linear least squares.
    alpha : float, default=1e-6
        Penalty on the sum of the squared coefficients, beside the sum of the squared errors. The
        default only decides between coefficients that explain the rows equally well: of inputs
        such as a sine and a cosine some monomials are sums of others. 0: `LinearRegression`,
        which takes longer.

    Returns
    -------
    Pipeline
        Unfitted; for one or several targets.

    Raises
    ------
    ValueError
        If `degree` is no whole number of at least 1, or `alpha` is negative or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import OneStepRegressor, TrajectoryDataset
    >>> from trajlearn.regressors import polynomial
    >>> states = np.empty((3, 31, 1))
    >>> states[:, 0, 0] = 0.2, 0.5, 0.9
    >>> for t in range(30):  # logistic growth
    ...     states[:, t + 1] = states[:, t] + 0.3 * states[:, t] * (1.5 - states[:, t])
    >>> ds = TrajectoryDataset.from_arrays(states, params=np.zeros((3, 1)))
    >>> model = OneStepRegressor(polynomial(2), inputs="params").fit(ds)
    >>> float(np.abs(model.predict(ds).mean - states[:, 1:]).max()) < 1e-6
    True
    """
    if not _is_number(degree) or degree < 1 or degree % 1:
        raise ValueError(f"degree = {degree!r} must be a whole number of at least 1.")
    if not _is_number(alpha) or not 0 <= alpha < np.inf:
        raise ValueError(f"alpha = {alpha!r} must be finite and not negative.")
    linear = Ridge(alpha=float(alpha)) if alpha else LinearRegression()
    features = PolynomialFeatures(int(degree), include_bias=False)
    return Pipeline([("features", features), ("linear", linear)])


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def polynomial_predictor(learner: Any) -> Callable[[Floats], Floats] | None:
    """Fast evaluation without validation, for roll-outs; None if it is not such a Pipeline.

    scikit-learn's checks of every step of the Pipeline take several times as long as the few
    products for some hundred rows.

    Parameters
    ----------
    learner : Pipeline
        Fitted.

    Returns
    -------
    callable or None
        Rows (n, k) to targets (n, d).
    """
    if not isinstance(learner, Pipeline) or len(learner.steps) != 2:
        return None
    features, linear = (step for _, step in learner.steps)
    # a class made from one of them may predict otherwise
    if type(features) is not PolynomialFeatures or type(linear) not in (Ridge, LinearRegression):
        return None
    coef = np.atleast_2d(linear.coef_)
    shift = np.broadcast_to(np.asarray(linear.intercept_, dtype=np.float64), len(coef))
    blocks = _products(features.powers_)
    if blocks is None:
        return None
    n_constant, blocks_of_powers = blocks

    def predict(rows: Floats) -> Floats:
        x = np.ascontiguousarray(rows.T)
        values = [np.ones((n_constant, len(rows)))]
        for lower, column in blocks_of_powers:
            values.append(x[column] if lower is None else values[-1][lower] * x[column])
        return (coef @ np.concatenate(values)).T + shift

    return predict


# of the monomials of a degree: which of the degree below, and which column, each is the product of
_Products = list[tuple[NDArray[np.intp] | None, NDArray[np.intp]]]


def _products(powers: NDArray[np.intp]) -> tuple[int, _Products] | None:
    """How monomials (m, k) arise from those before; None if one of their factors is missing.

    Also how many are constants. They are in the order of their degree.
    """
    degrees = powers.sum(axis=1)
    blocks: _Products = []
    for degree in range(1, int(degrees.max()) + 1):
        block, below = powers[degrees == degree], powers[degrees == degree - 1]
        column = (block > 0).argmax(axis=1)
        if degree == 1:
            blocks.append((None, column))
            continue
        place = {tuple(row): i for i, row in enumerate(below)}
        factors = block.copy()
        factors[np.arange(len(block)), column] -= 1
        if any(tuple(row) not in place for row in factors):
            return None
        blocks.append((np.array([place[tuple(row)] for row in factors]), column))
    return int((degrees == 0).sum()), blocks
