"""Neural networks whose weights are the control parameters."""

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.policies._checks import checked_bounds, checked_times

__all__ = ["NetworkPolicy"]


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
        bounds = checked_bounds(self.bounds)
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
        checked_times(times, len(s))
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
        # in C order: of other strides a product of matrices may round otherwise
        s = np.asarray(states, dtype=np.float64, order="C")
        if s.ndim != 2 or s.shape[1] != self.n_states:
            raise ValueError(f"{name} must have shape (n, {self.n_states}); got {s.shape}.")
        return s

    def _checked_params(self, params: ArrayLike) -> NDArray[np.float64]:
        theta = np.asarray(params, dtype=np.float64, order="C")
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
