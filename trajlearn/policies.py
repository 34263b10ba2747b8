"""Controllers as vectorised functions of state, control parameters and time.

A policy is any callable ``policy(states, params, times) -> actions`` that answers for many
episodes at once. It carries no memory: what it needs to know is in its three arguments, so
a learned model can ask it for the action at a state that no simulator ever visited.
"""

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from numbers import Integral
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["PID", "LinearFeedback", "NetworkPolicy", "Policy"]


class Policy(Protocol):
    """What is called a policy: a vectorised function ``(states, params, times) -> actions``.

    ``states`` is (n, d_s), ``params`` (n, p), ``times`` (n,) in the unit of the episodes'
    times, and the answer (n, d_a). Row i may depend on row i of the arguments only. A class
    need not inherit from this one; a plain function will do.
    """

    def __call__(
        self,
        states: NDArray[np.float64],
        params: NDArray[np.float64],
        times: NDArray[np.float64],
        /,
    ) -> NDArray[np.float64]:
        """Return the actions, shape (n, d_a)."""
        ...


@dataclass(frozen=True)
class LinearFeedback:
    r"""State feedback ``a = clip(-K s, low, high)`` with the gain K as control parameters.

    Parameters
    ----------
    bounds : (low, high) or None, default=(-1.0, 1.0)
        Limits of every action; None leaves the actions unclipped.

    Raises
    ------
    ValueError
        If ``bounds`` is neither None nor two numbers with low < high.

    Notes
    -----
    A linear quadratic regulator has this form; its gain is the one that minimises
    :math:`\int_0^\infty s^T Q s + a^T R a\,dt`. A row gets the same bits alone as in a batch.

    Examples
    --------
    >>> import numpy as np
    >>> policy = LinearFeedback()
    >>> states = np.array([[0.2, 0.1], [3.0, 0.0]])
    >>> gains = np.array([[1.0, 2.0], [1.0, 2.0]])
    >>> policy(states, gains, np.zeros(2))
    array([[-0.4],
           [-1. ]])
    """

    bounds: tuple[float, float] | None = (-1.0, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", _checked_bounds(self.bounds))

    def __call__(
        self, states: ArrayLike, params: ArrayLike, times: ArrayLike
    ) -> NDArray[np.float64]:
        """Evaluate the feedback law.

        Parameters
        ----------
        states : array-like of shape (n, d_s)
            The states to act on.
        params : array-like of shape (n, d_a * d_s)
            The gain of every row, K of shape (d_a, d_s) flattened row by row.
        times : array-like of shape (n,)
            The times of the rows; the law does not depend on them.

        Returns
        -------
        ndarray of shape (n, d_a)
            The actions, within ``bounds``.

        Raises
        ------
        ValueError
            If a shape is wrong; the message names the argument.
        """
        s = np.asarray(states, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] == 0:
            raise ValueError(f"states must have shape (n, d_s) with d_s >= 1; got {s.shape}.")
        n, d_s = s.shape
        gains = np.asarray(params, dtype=np.float64)
        if gains.ndim != 2 or len(gains) != n or gains.shape[1] == 0 or gains.shape[1] % d_s:
            raise ValueError(
                f"params must have shape (n, d_a * d_s), one flattened gain for each of the {n} "
                f"rows of states with d_s = {d_s}; got {gains.shape}."
            )
        _checked_times(times, n)
        gains = gains.reshape(n, gains.shape[1] // d_s, d_s)
        # Column by column: a matrix product or a pairwise sum may round differently with n.
        actions = -gains[:, :, 0] * s[:, :1]
        for j in range(1, d_s):
            actions -= gains[:, :, j] * s[:, j : j + 1]
        return actions if self.bounds is None else np.clip(actions, *self.bounds)


@dataclass(frozen=True)
class PID:
    r"""PID control of joints, integral gain zero, with gains and targets as control parameters.

    The state is (cos q, sin q, q_dot) of m joints, the parameters are (P / p_scale, D, target),
    and the action of a joint is

    .. math:: u = \mathrm{clip}(P\,(z_d - z) - D\,\Delta t\,\dot z,\ \mathrm{low},\ \mathrm{high}),

    where z is the angle q = arctan2(sin q, cos q) or its cosine.

    Parameters
    ----------
    feedback : {"angle", "cos"}, default="angle"
        What is regulated to the target: the joint angles in rad, or their cosines.
    p_scale : float, default=5.0
        The proportional gain is this times the first block of the parameters.
    dt : float, default=0.008
        Interval in seconds over which the derivative term takes the change of the error. With
        1.0 the gain D multiplies the time derivative itself.
    initial_kick : bool, default=False
        Whether at time 0 the derivative term is D times the whole error, as if it had been 0
        before.
    bounds : (low, high) or None, default=(-1.0, 1.0)
        Limits of every action; None leaves the actions unclipped.

    Raises
    ------
    ValueError
        If ``feedback`` is none of its values, ``p_scale`` or ``dt`` is not a finite number
        greater than 0, or ``bounds`` is neither None nor two numbers with low < high.

    Notes
    -----
    A digital PID remembers the last error: its derivative term is D (e_t - e_{t-1}). A policy
    here has no memory. It takes the change from the velocity in the state, to first order in
    ``dt``: -q_dot dt for angles, sin(q) q_dot dt for cosines. An integral term would need a
    memory, too, and is left out; the paper sets its gain to zero.

    The sign is that of negative feedback, error = target - measurement. As printed in the
    paper, with error = measurement - target and positive gains, the loop would be unstable.

    A row gets the same bits alone as in a batch.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import PID
    >>> angle, velocity, target = 0.3, 2.0, 0.5
    >>> state = np.array([[np.cos(angle), np.sin(angle), velocity]])
    >>> PID()(state, np.array([[0.4, 1.0, target]]), np.zeros(1))
    array([[0.384]])
    """

    feedback: str = "angle"
    _: KW_ONLY
    p_scale: float = 5.0
    dt: float = 0.008
    initial_kick: bool = False
    bounds: tuple[float, float] | None = (-1.0, 1.0)

    def __post_init__(self) -> None:
        if self.feedback not in ("angle", "cos"):
            raise ValueError(f"feedback must be 'angle' or 'cos'; got {self.feedback!r}.")
        for name in ("p_scale", "dt"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(
                    f"{name} must be a finite number greater than 0; got {getattr(self, name)!r}."
                )
        object.__setattr__(self, "bounds", _checked_bounds(self.bounds))

    def __call__(
        self, states: ArrayLike, params: ArrayLike, times: ArrayLike
    ) -> NDArray[np.float64]:
        """Evaluate the control law.

        Parameters
        ----------
        states : array-like of shape (n, 3 * m)
            Cosines, sines and velocities (rad/s) of m joints, in this order.
        params : array-like of shape (n, 3 * m)
            P / p_scale, D and target of the m joints, in this order.
        times : array-like of shape (n,)
            The times of the rows; the law depends on them only with ``initial_kick``.

        Returns
        -------
        ndarray of shape (n, m)
            The actions, within ``bounds``.

        Raises
        ------
        ValueError
            If a shape is wrong; the message names the argument.
        """
        s = np.asarray(states, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] == 0 or s.shape[1] % 3:
            raise ValueError(
                "states must have shape (n, 3 * m), the cosines, sines and velocities of m >= 1 "
                f"joints; got {s.shape}."
            )
        theta = np.asarray(params, dtype=np.float64)
        if theta.shape != s.shape:
            raise ValueError(
                f"params must have shape {s.shape}, P / p_scale, D and target of the "
                f"{s.shape[1] // 3} joints for each row of states; got {theta.shape}."
            )
        _checked_times(times, len(s))
        cos, sin, velocity = np.hsplit(s, 3)
        p, d, target = np.hsplit(theta, 3)
        if self.feedback == "angle":
            error, change = target - np.arctan2(sin, cos), -velocity * self.dt
        else:
            error, change = target - cos, sin * velocity * self.dt
        if self.initial_kick:
            change = np.where(np.equal(times, 0.0)[:, None], error, change)
        actions = self.p_scale * p * error + d * change
        return actions if self.bounds is None else np.clip(actions, *self.bounds)


@dataclass(frozen=True)
class NetworkPolicy:
    r"""A small neural network whose weights are the control parameters.

    Every row of states has a network of its own. With :math:`x_0 = s`, the hidden layers are
    :math:`x_{l+1} = \phi(W_l x_l + b_l)` and the action is
    :math:`\tanh(W_L x_L + b_L)`, moved from [-1, 1] to ``bounds``.

    Parameters
    ----------
    hidden : tuple of int, default=(5,)
        Units of the hidden layers; () is linear feedback with an offset, squashed.
    n_states, n_actions : int
        Sizes d_s and d_a of states and actions.
    activation : {"tanh", "relu"}, default="tanh"
        The function :math:`\phi` of the hidden units.
    bounds : (low, high) or None, default=(-1.0, 1.0)
        Limits of every action; None leaves the last layer linear.

    Raises
    ------
    ValueError
        If a size is not a positive integer, ``activation`` is none of its values, or ``bounds``
        is neither None nor two finite numbers with low < high.

    Notes
    -----
    The parameters of a row are, for each layer from the states on, W of shape (outputs, inputs)
    flattened row by row, then b. States enter as they are: where their units differ by orders of
    magnitude, widen the bounds of the weights accordingly. A row gets the same bits alone as in
    a batch.

    Networks that differ by a permutation of hidden units act alike, so a model over weights has
    much to learn that does not matter. `responses` describes a policy by what it does instead.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import NetworkPolicy
    >>> policy = NetworkPolicy((5,), n_states=4, n_actions=1)
    >>> policy.n_params
    31
    >>> weights = np.random.default_rng(0).uniform(-1, 1, size=(3, policy.n_params))
    >>> policy(np.ones((3, 4)), weights, np.zeros(3)).shape
    (3, 1)
    >>> policy.responses(weights, np.eye(4)).shape
    (3, 4)
    """

    hidden: tuple[int, ...] = (5,)
    _: KW_ONLY
    n_states: int
    n_actions: int
    activation: str = "tanh"
    bounds: tuple[float, float] | None = (-1.0, 1.0)

    def __post_init__(self) -> None:
        try:
            hidden = tuple(self.hidden)
        except TypeError:
            raise ValueError(
                f"hidden must be a tuple of layer sizes, such as (5,); got {self.hidden!r}."
            ) from None
        for size in hidden:
            _require_size(size, "every size in hidden")
        _require_size(self.n_states, "n_states")
        _require_size(self.n_actions, "n_actions")
        if self.activation not in ("tanh", "relu"):
            raise ValueError(f"activation must be 'tanh' or 'relu'; got {self.activation!r}.")
        bounds = _checked_bounds(self.bounds)
        if bounds is not None and not np.isfinite(bounds).all():
            raise ValueError(f"bounds must be finite, tanh is scaled to them; got {bounds}.")
        object.__setattr__(self, "hidden", tuple(int(size) for size in hidden))
        object.__setattr__(self, "bounds", bounds)

    @property
    def n_params(self) -> int:
        """Number p of weights and biases."""
        return sum((inputs + 1) * outputs for inputs, outputs in self._layers())

    def __call__(
        self, states: ArrayLike, params: ArrayLike, times: ArrayLike
    ) -> NDArray[np.float64]:
        """Evaluate each row's network at its state.

        Parameters
        ----------
        states : array-like of shape (n, n_states)
            The states to act on.
        params : array-like of shape (n, n_params)
            The weights of every row, in the order of the Notes.
        times : array-like of shape (n,)
            The times of the rows; the network does not see them.

        Returns
        -------
        ndarray of shape (n, n_actions)
            The actions, within ``bounds``.

        Raises
        ------
        ValueError
            If a shape is wrong; the message names the argument.
        """
        s = self._checked_states(states, "states")
        theta = self._checked_params(params)
        if len(theta) != len(s):
            raise ValueError(
                f"params must have one row for each of the {len(s)} states; got {len(theta)}."
            )
        _checked_times(times, len(s))
        return self._evaluate(s[:, :, None], theta)[:, :, 0]

    def responses(self, params: ArrayLike, probe_states: ArrayLike) -> NDArray[np.float64]:
        """Describe policies by their actions at a few states.

        Parameters
        ----------
        params : array-like of shape (n, n_params)
            The weights of n policies.
        probe_states : array-like of shape (k, n_states)
            Where the policies are asked, such as logged states far from one another.

        Returns
        -------
        ndarray of shape (n, k * n_actions)
            Actions at the first probe state, then at the second, and so on.

        Raises
        ------
        ValueError
            If a shape is wrong; the message names the argument.
        """
        probes = self._checked_states(probe_states, "probe_states")
        theta = self._checked_params(params)
        # one product a layer for all probes of a policy: they are columns
        actions = self._evaluate(np.broadcast_to(probes.T, (len(theta), *probes.T.shape)), theta)
        return actions.transpose(0, 2, 1).reshape(len(theta), -1)

    def _layers(self) -> Iterator[tuple[int, int]]:
        """Inputs and outputs of each layer."""
        return pairwise((self.n_states, *self.hidden, self.n_actions))

    def _evaluate(self, x: NDArray[np.float64], params: NDArray[np.float64]) -> NDArray[np.float64]:
        """Actions (n, d_a, k) at the columns of x (n, d_s, k)."""
        at, last = 0, len(self.hidden)
        for layer, (inputs, outputs) in enumerate(self._layers()):
            end = at + inputs * outputs
            weights = params[:, at:end].reshape(-1, outputs, inputs)
            at = end + outputs
            x = weights @ x + params[:, end:at, None]
            if layer < last:
                x = np.tanh(x) if self.activation == "tanh" else np.maximum(x, 0.0)
        if self.bounds is None:
            return x
        low, high = self.bounds
        return (low + high) / 2 + (high - low) / 2 * np.tanh(x)

    def _checked_states(self, states: ArrayLike, name: str) -> NDArray[np.float64]:
        s = np.asarray(states, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] != self.n_states:
            raise ValueError(f"{name} must have shape (n, {self.n_states}); got {s.shape}.")
        return s

    def _checked_params(self, params: ArrayLike) -> NDArray[np.float64]:
        theta = np.asarray(params, dtype=np.float64)
        if theta.ndim != 2 or theta.shape[1] != self.n_params:
            sizes = "-".join(str(n) for n in (self.n_states, *self.hidden, self.n_actions))
            raise ValueError(
                f"params must have shape (n, {self.n_params}), the weights of a network "
                f"{sizes}; got {theta.shape}."
            )
        return theta


def _require_size(size: object, name: str) -> None:
    if isinstance(size, bool) or not isinstance(size, Integral) or size < 1:
        raise ValueError(f"{name} must be an integer of at least 1; got {size!r}.")


def _checked_bounds(bounds: object) -> tuple[float, float] | None:
    if bounds is None:
        return None
    try:
        low, high = (float(bound) for bound in bounds)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise ValueError(f"bounds must be None or a pair (low, high); got {bounds!r}.") from error
    if not low < high:
        raise ValueError(f"bounds must satisfy low < high; got ({low}, {high}).")
    return low, high


def _checked_times(times: ArrayLike, n: int) -> None:
    if np.shape(times) != (n,):
        raise ValueError(f"times must have shape ({n},), one a row; got {np.shape(times)}.")
