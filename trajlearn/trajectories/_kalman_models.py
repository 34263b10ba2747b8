"""Linear models of motion: how a hidden state moves on in time, and what of it is measured."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Kinematic", "Motion", "StateSpaceModel"]

Floats = NDArray[np.float64]


class Motion(Protocol):
    """What the filters need to know of a model."""

    @property
    def measurement(self) -> Floats:
        """H (d, m)."""

    def matrices(self, dt: Floats) -> tuple[Floats, Floats]:
        """F and Q of time steps of any shape: (..., m, m) each."""

    def natural(self, change: Floats, dt: float) -> tuple[Floats, float, Floats]:
        """Variances (d,), process noise and hidden variances (m,) of one magnitude.

        `change` (d,) is what the measured numbers change by in a time step `dt`.
        """


@dataclass(frozen=True)
class Kinematic:
    """Position whose derivative of order `order` (1: velocity, 2: acceleration) drifts.

    The drift is white noise of some spectral density, which is the intensity of Q. Measured are
    the position and, if `pair`, the velocity.
    """

    order: int
    pair: bool = False

    @property
    def measurement(self) -> Floats:
        return np.eye(2 if self.pair else 1, self.order + 1)

    def matrices(self, dt: Floats) -> tuple[Floats, Floats]:
        from filterpy.common import Q_continuous_white_noise, kinematic_state_transition

        m = self.order + 1
        powers = [np.ones_like(dt)]
        for _ in range(2 * m - 1):
            powers.append(powers[-1] * dt)
        # Entries are powers of dt times what they are for dt = 1.
        unit_f = np.asarray(kinematic_state_transition(self.order, 1.0), dtype=np.float64)
        unit_q = np.asarray(Q_continuous_white_noise(m, 1.0), dtype=np.float64)
        f, q = np.zeros((*dt.shape, m, m)), np.zeros((*dt.shape, m, m))
        for i in range(m):
            for j in range(m):
                q[..., i, j] = unit_q[i, j] * powers[2 * m - 1 - i - j]
                if j >= i:
                    f[..., i, j] = unit_f[i, j] * powers[j - i]
        return f, q

    def natural(self, change: Floats, dt: float) -> tuple[Floats, float, Floats]:
        m, square = self.order + 1, float(change[0]) ** 2
        hidden = np.array([square / dt ** (2 * i) for i in range(m)])
        return hidden[: 2 if self.pair else 1], square / dt ** (2 * m - 1), hidden


@dataclass(frozen=True, eq=False)
class StateSpaceModel:
    """A given linear model of several states together, for `KalmanSmoother`.

    z_{k+1} = F z_k + w, cov(w) = Q;  y_k = H z_k + e, cov(e) = R, where y are the states that
    are smoothed and z (m,) is hidden.

    Parameters
    ----------
    F : array-like of shape (m, m), or callable
        Transition over one time step, or ``F(dt)``, in the unit of `times`.
    H : array-like of shape (d, m)
    Q : array-like of shape (m, m), or callable
        Covariance of the process noise of one time step, or ``Q(dt)``.
    R : array-like of shape (d, d) or None, default=None
        Covariance of the measurement noise. None: Q is known up to a factor and R is diagonal;
        both follow from `process_noise` and `measurement_noise` of the smoother.
    initial_mean : array-like of shape (m,), optional
    initial_covariance : array-like of shape (m, m), optional
        Of z_0; default: learnt from the training episodes. Give both or none.
    outputs : mapping from name to m numbers, optional
        Further states to append: each is this row times z, such as a velocity.

    Raises
    ------
    ValueError
        If matrices do not fit together, or a covariance is none.

    Examples
    --------
    Two positions that share one velocity:

    >>> import numpy as np
    >>> def move(dt):
    ...     return np.array([[1, 0, dt], [0, 1, dt], [0, 0, 1]])
    >>> model = StateSpaceModel(
    ...     F=move,
    ...     H=[[1, 0, 0], [0, 1, 0]],
    ...     Q=lambda dt: dt * np.diag([0, 0, 1.0]),
    ...     outputs={"v": [0, 0, 1]},
    ... )
    """

    F: ArrayLike | Callable[[float], ArrayLike]
    H: ArrayLike
    Q: ArrayLike | Callable[[float], ArrayLike]
    R: ArrayLike | None = None
    initial_mean: ArrayLike | None = None
    initial_covariance: ArrayLike | None = None
    outputs: Mapping[str, Sequence[float]] = field(default_factory=dict)

    @property
    def measurement(self) -> Floats:
        """H (d, m), scaled such that the errors of an R that is given are independent."""
        h = np.asarray(self.H, dtype=np.float64)
        return h if self.R is None else self.scale @ h

    @property
    def for_one_step(self) -> bool:
        """Whether F or Q is a matrix, good for one time step only."""
        return not (callable(self.F) and callable(self.Q))

    @property
    def scale(self) -> Floats:
        """What makes errors of covariance R independent, with variance 1 (d, d)."""
        root = np.linalg.cholesky(np.asarray(self.R, dtype=np.float64))
        return np.asarray(np.linalg.inv(root), dtype=np.float64)

    def check(self, n_states: int) -> None:
        """Refuse matrices of wrong shapes.

        Raises
        ------
        ValueError
        """
        h = _matrix(self.H, "H")
        d, m = h.shape
        if d != n_states:
            raise ValueError(
                f"the model's H has {d} rows, but {n_states} states are to be smoothed; name "
                "them in states=."
            )
        for name in ("F", "Q"):
            given = getattr(self, name)
            if not callable(given):
                _matrix(given, name, (m, m))
        if self.R is not None:
            _covariance(self.R, "R", d, definite=True)
        if (self.initial_mean is None) != (self.initial_covariance is None):
            raise ValueError("give both initial_mean and initial_covariance of the model, or none.")
        if self.initial_mean is not None and np.shape(self.initial_mean) != (m,):
            raise ValueError(
                f"initial_mean of the model has shape {np.shape(self.initial_mean)}; expected "
                f"({m},)."
            )
        if self.initial_covariance is not None:
            _covariance(self.initial_covariance, "initial_covariance", m)
        for name, row in self.outputs.items():
            if np.shape(row) != (m,):
                raise ValueError(f"output {name!r} of the model needs {m} numbers, got {row!r}.")

    def matrices(self, dt: Floats) -> tuple[Floats, Floats]:
        m = np.shape(self.H)[1]
        steps, which = np.unique(dt, return_inverse=True)
        which = which.reshape(dt.shape)
        _covariance(_at(self.Q, float(steps[0])), "Q", m)
        f = np.stack([_matrix(_at(self.F, step), "F", (m, m)) for step in steps.tolist()])
        q = np.stack([_matrix(_at(self.Q, step), "Q", (m, m)) for step in steps.tolist()])
        return f[which], q[which]

    def natural(self, change: Floats, dt: float) -> tuple[Floats, float, Floats]:
        h = self.measurement
        floor = 1e-6 * float(np.mean(change**2))
        hidden = np.linalg.pinv(h) ** 2 @ change**2
        return change**2 + floor, 1.0, np.maximum(hidden, hidden.max() + floor)


def _at(value: Any, dt: float) -> Any:
    return value(dt) if callable(value) else value


def _matrix(value: Any, name: str, shape: tuple[int, int] | None = None) -> Floats:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != 2 or (shape is not None and array.shape != shape):
        want = "a matrix" if shape is None else f"shape {shape}"
        raise ValueError(f"{name} of the model has shape {array.shape}; expected {want}.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} of the model has NaN or infinite values.")
    return array


def _covariance(value: Any, name: str, size: int, *, definite: bool = False) -> Floats:
    array = _matrix(value, name, (size, size))
    scale = max(float(np.abs(array).max()), np.finfo(np.float64).tiny)
    least = np.linalg.eigvalsh((array + array.T) / 2).min()
    if np.abs(array - array.T).max() > 1e-8 * scale or least < -1e-8 * scale:
        raise ValueError(f"{name} of the model is no covariance: symmetric, no negative variance.")
    if definite and least <= 0:
        raise ValueError(f"{name} of the model must be positive definite: no error is zero.")
    return array
