"""Ensembles of multilayer perceptrons, deterministic or Gaussian, trained as one network."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import RegressorMixin
from sklearn.utils import Tags, check_random_state
from sklearn.utils.validation import _check_sample_weight, validate_data

from trajlearn._sklearn import Interval, StrOptions, fit_context
from trajlearn.regressors._batches import (
    Batch,
    Draw,
    checked_draw,
    row_batches,
    stream_batches,
)
from trajlearn.regressors._network import ACTIVATIONS
from trajlearn.regressors._samples import (
    Rows,
    bootstrap_counts,
    check_groups,
    held_out,
    standardisation,
)
from trajlearn.regressors._trained import REFERENCE_ROWS, TrainedEnsemble, Training
from trajlearn.regressors._training import default_steps
from trajlearn.regressors._variance import out_of_bag

__all__ = ["MLPEnsembleRegressor"]

Floats = NDArray[np.float64]


class MLPEnsembleRegressor(RegressorMixin, TrainedEnsemble):
    """Ensemble of E multilayer perceptrons, one batched network, for one or several targets.

    Targets are standardised inside; inputs are taken as they are, so scale them before (the
    dynamics estimators do; elsewhere put a `StandardScaler` in front).

    Parameters
    ----------
    hidden_layer_sizes : sequence of int, default=(250, 250)
    n_members : int, default=1
        Networks E with their own initial weights and order of rows.
    probabilistic : bool or "separate", default=False
        False: train on the squared error; the variance is that of the training residuals, the
        same for every row. True: predict a mean and a variance and train both on the Gaussian
        likelihood. "separate": the mean is that of False, to the bit; afterwards a smaller
        network learns the variance of each member's residuals (in about a sixth more time), with
        `bootstrap` on rows that the member has not seen. Other training residuals tell too small
        a variance where the mean overfits.
    activation : {"silu", "relu", "tanh"}, default="silu"
    learning_rate : float, default=3e-3
        Peak rate of the schedule.
    schedule : {"one-cycle", "constant"}, default="one-cycle"
        "one-cycle": a tenth of the steps warm-up, then a cosine down to zero.
    batch_size : int, default=256
        With no more different rows than this, every step sees all of them. For each member.
    max_steps : int or None, default=None
        Gradient steps. None: ``15 * rows ** 0.55``, between 100 and 4,000.
    max_epochs : int or None, default=None
        Budget in passes over the rows instead of steps; not for streams.
    weight_decay : float, default=0.0
        Decoupled (AdamW), on weights only.
    bootstrap : {False, "row", "group"}, default=False
        Train each member on rows, or on whole groups, drawn with replacement.
    early_stopping : bool, default=False
        Hold out `validation_fraction` of the rows (of the groups, where `groups` is given) and
        keep each member's best weights there.
    validation_fraction : float, default=0.1
    patience : int, default=20
        Evaluations (a hundredth of the steps apart) without improvement in any member before
        training ends.
    nll_beta : float, default=0.5
        Exponent of beta-NLL for ``probabilistic=True``; 0 is the plain likelihood, 1 weights the
        mean as the squared error does.
    device : str, default="cpu"
    warm_start : bool, default=False
        Go on from the weights of the last fit.
    random_state : int, RandomState or None, default=None
    verbose : int, default=0
        1 shows a progress bar.

    Attributes
    ----------
    n_features_in_ : int
    n_steps_ : int
        Gradient steps that the last fit took.
    loss_curve_ : ndarray of shape (about 100, E)
        Training loss on standardised targets at regular steps.
    validation_loss_curve_ : ndarray of shape (evaluations, E)
    residual_std_ : ndarray of shape (E, n_targets)
        Standard deviation of the training residuals, in target units.
    coefs_, intercepts_ : list of ndarray of shape (E, in, out), (E, 1, out)
    logvar_bounds_ : ndarray of shape (2, E, 1, n_targets)
        Bounds of the log variance of standardised targets, if `probabilistic`: trained, or by the
        range of the residuals if "separate".
    variance_coefs_, variance_intercepts_, variance_loss_curve_
        As `coefs_`, `intercepts_` and `loss_curve_`, of the networks of a "separate" variance.
    target_mean_, target_scale_ : ndarray of shape (n_targets,)

    See Also
    --------
    GPRegressor : Gaussian processes, for up to a few thousand rows.

    References
    ----------
    K. Chua et al., "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
    Dynamics Models", NeurIPS 2018 (trained variance bounds).
    M. Seitzer et al., "On the Pitfalls of Heteroscedastic Uncertainty Estimation with
    Probabilistic Neural Networks", ICLR 2022 (beta-NLL).

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import MLPEnsembleRegressor
    >>> X = np.linspace(-1, 1, 200)[:, None]
    >>> model = MLPEnsembleRegressor(hidden_layer_sizes=(64, 64), random_state=0)
    >>> model.fit(X, np.sin(3 * X[:, 0])).score(X, np.sin(3 * X[:, 0])) > 0.98
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "hidden_layer_sizes": ["array-like"],
        "n_members": [Interval(Integral, 1, None, closed="left")],
        "probabilistic": ["boolean", StrOptions({"separate"})],
        "activation": [StrOptions(set(ACTIVATIONS))],
        "learning_rate": [Interval(Real, 0, None, closed="neither")],
        "schedule": [StrOptions({"one-cycle", "constant"})],
        "batch_size": [Interval(Integral, 1, None, closed="left")],
        "max_steps": [Interval(Integral, 1, None, closed="left"), None],
        "max_epochs": [Interval(Integral, 1, None, closed="left"), None],
        "weight_decay": [Interval(Real, 0, None, closed="left")],
        "bootstrap": [StrOptions({"row", "group"}), "boolean"],
        "early_stopping": ["boolean"],
        "validation_fraction": [Interval(Real, 0, 1, closed="neither")],
        "patience": [Interval(Integral, 1, None, closed="left")],
        "nll_beta": [Interval(Real, 0, 1, closed="both")],
        "device": [str],
        "warm_start": ["boolean"],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        *,
        hidden_layer_sizes: Sequence[int] = (250, 250),
        n_members: int = 1,
        probabilistic: bool | Literal["separate"] = False,
        activation: str = "silu",
        learning_rate: float = 3e-3,
        schedule: str = "one-cycle",
        batch_size: int = 256,
        max_steps: int | None = None,
        max_epochs: int | None = None,
        weight_decay: float = 0.0,
        bootstrap: Literal[False, "row", "group"] = False,
        early_stopping: bool = False,
        validation_fraction: float = 0.1,
        patience: int = 20,
        nll_beta: float = 0.5,
        device: str = "cpu",
        warm_start: bool = False,
        random_state: Any = None,
        verbose: int = 0,
    ) -> None:
        self.hidden_layer_sizes = hidden_layer_sizes
        self.n_members = n_members
        self.probabilistic = probabilistic
        self.activation = activation
        self.learning_rate = learning_rate
        self.schedule = schedule
        self.batch_size = batch_size
        self.max_steps = max_steps
        self.max_epochs = max_epochs
        self.weight_decay = weight_decay
        self.bootstrap = bootstrap
        self.early_stopping = early_stopping
        self.validation_fraction = validation_fraction
        self.patience = patience
        self.nll_beta = nll_beta
        self.device = device
        self.warm_start = warm_start
        self.random_state = random_state
        self.verbose = verbose

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
    ) -> Self:
        """Train on rows.

        Parameters
        ----------
        X : array-like of shape (n, n_features)
        y : array-like of shape (n,) or (n, n_targets)
        sample_weight : array-like of shape (n,), optional
            A row of weight k counts as k rows: exactly so up to `batch_size` different rows;
            with more, rows are drawn in proportion.
        groups : array-like of shape (n,), optional
            Labels (such as the episode of a row) that early stopping and the group bootstrap
            keep together.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            For invalid or non-finite input, weights that are negative or all zero, groups that
            are needed and missing, an absent device, training that diverges.
        """
        self._train(self._on_rows(X, y, sample_weight, groups))
        return self

    @fit_context(prefer_skip_nested_validation=True)
    def fit_stream(
        self, draw: Draw, *, random_state: Any = None, n_rows: int | None = None
    ) -> Self:
        """Train on fresh rows at every step.

        Parameters
        ----------
        draw : callable
            ``draw(n, rng) -> (X, y, weight)``: n fresh rows, their targets and None or their
            weights in the loss.
        random_state : int, RandomState or None
            None takes the constructor's.
        n_rows : int, optional
            How many different rows there are, for ``max_steps=None``.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            As in `fit`; for draws of other shapes; with `early_stopping`, `bootstrap` or
            `max_epochs`, which need fixed rows.
        """
        self._train(self._on_stream(draw, random_state, n_rows))
        return self

    @fit_context(prefer_skip_nested_validation=True)
    def partial_fit(
        self, X: ArrayLike, y: ArrayLike, *, sample_weight: ArrayLike | None = None
    ) -> Self:
        """One pass over the rows at the constant rate, from the weights and moments so far.

        The first call fixes the scale of the targets.

        Parameters
        ----------
        X : array-like of shape (n, n_features)
        y : array-like of shape (n,) or (n, n_targets)
        sample_weight : array-like of shape (n,), optional
            As in `fit`.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            As in `fit`; with `early_stopping` or `bootstrap`, which need all rows at once; for
            another number of features or targets than at first.
        """
        self._refuse("early_stopping", "bootstrap", why="all rows at once, in fit")
        first = not hasattr(self, "coefs_")
        rows = self._validated(X, y, sample_weight, reset=first)
        # the same seed must not give every pass the same order of rows
        passed = [] if first else [int(self._moments[0])]
        rng = np.random.default_rng(self._seed() + passed)
        self._set_target_scale(rows, keep=not first)
        batches = row_batches(rows, None, self._to_tensors(), self.n_members, self.batch_size, rng)
        n_steps = -(-len(rows) // self.batch_size)
        self._train(Training(batches, rows, n_steps, rng, goes_on=not first, one_pass=True))
        return self

    def _on_rows(self, X: Any, y: Any, sample_weight: Any, groups: Any) -> Training:
        """Training on rows, as `fit` is given them."""
        goes_on = self._goes_on()
        rows = self._validated(X, y, sample_weight, groups, reset=not goes_on)
        rng = np.random.default_rng(self._seed())
        validation = None
        if self.early_stopping:
            rows, validation = held_out(rows, self.validation_fraction, rng)
        self._set_target_scale(rows, keep=goes_on)
        counts = None
        if self.bootstrap:
            by = rows.groups if self.bootstrap == "group" else None
            counts = bootstrap_counts(len(rows), by, self.n_members, rng)
        to_tensors = self._to_tensors()
        batches = row_batches(rows, counts, to_tensors, self.n_members, self.batch_size, rng)
        unseen = None
        if counts is not None:
            left_out = out_of_bag(counts)
            unseen = row_batches(rows, left_out, to_tensors, self.n_members, self.batch_size, rng)
        n_steps = self._budget(len(rows))
        return Training(batches, rows, n_steps, rng, validation, unseen, goes_on)

    def _on_stream(self, draw: Draw, random_state: Any, n_rows: int | None) -> Training:
        """Training on fresh rows at every step, as `fit_stream` is given them."""
        goes_on = self._goes_on()
        self._refuse("early_stopping", "bootstrap", "max_epochs", why="fixed rows, not a stream")
        rng = np.random.default_rng(self._seed(random_state))
        reference = checked_draw(draw, REFERENCE_ROWS, rng)
        rows = self._validated(*reference, reset=not goes_on)
        self._set_target_scale(rows, keep=goes_on)
        widths, to_tensors = (self.n_features_in_, rows.y.shape[1]), self._to_tensors()

        def pool(n: int) -> Batch:
            return to_tensors(*checked_draw(draw, n, rng, widths))

        batches = stream_batches(pool, self.n_members, self.batch_size)
        return Training(batches, rows, self._budget(n_rows or 10**9), rng, goes_on=goes_on)

    def _validated(
        self, X: Any, y: Any, sample_weight: Any, groups: Any = None, *, reset: bool
    ) -> Rows:
        """Rows of positive weight, repeated ones merged if all fit into one batch."""
        X, y = validate_data(
            self, X, y, multi_output=True, y_numeric=True, dtype=np.float64, reset=reset
        )
        y = np.asarray(y, dtype=np.float64)
        columns = y[:, None] if y.ndim == 1 else y
        if not reset and columns.shape[1] != len(self.target_mean_):
            raise ValueError(f"y has {columns.shape[1]} targets; fitted: {len(self.target_mean_)}.")
        self._y_ndim = y.ndim
        if sample_weight is not None:
            sample_weight = _check_sample_weight(sample_weight, X, dtype=np.float64)
        if self.bootstrap == "group" and groups is None:
            raise ValueError('bootstrap="group" needs groups= in fit, one label a row.')
        used = groups is not None and (self.early_stopping or self.bootstrap == "group")
        groups = check_groups(groups, len(X)) if used else None
        return Rows(X, columns, sample_weight, groups).without_weightless().merged(self.batch_size)

    def _seed(self, random_state: Any = None) -> list[int]:
        state = self.random_state if random_state is None else random_state
        return check_random_state(state).randint(2**31, size=4).tolist()

    def _goes_on(self) -> bool:
        return self.warm_start and hasattr(self, "coefs_")

    def _refuse(self, *names: str, why: str) -> None:
        for name in names:
            if getattr(self, name):
                raise ValueError(f"{name}={getattr(self, name)!r} needs {why}.")

    def _budget(self, n_rows: int) -> int:
        if self.max_epochs is not None:
            return self.max_epochs * -(-n_rows // self.batch_size)
        if self.max_steps is not None:
            return self.max_steps
        return default_steps(n_rows)

    def _set_target_scale(self, rows: Rows, *, keep: bool) -> None:
        if not keep:
            self.target_mean_, self.target_scale_ = standardisation(rows.y, rows.weight)
