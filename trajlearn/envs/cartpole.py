"""A cart that balances a pole under linear feedback with perturbed LQR gains."""

from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import ClassVar, Final

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from trajlearn.envs.base import Environment
from trajlearn.policies import LinearFeedback

__all__ = ["Cartpole"]

GRAVITY: Final = 9.8  # m/s^2
CART_MASS: Final = 1.0  # kg
POLE_MASS: Final = 0.1  # kg
HALF_POLE: Final = 0.5  # m, from the hinge to the centre of the pole
FORCE: Final = 10.0  # N at action 1
TOTAL_MASS: Final = CART_MASS + POLE_MASS

POSITION_LIMIT: Final = 9.6  # m
ANGLE_LIMIT: Final = np.deg2rad(24.0)

STATE_COST: Final = (0.5, 0.05, 1.0, 0.05)
ACTION_COST: Final = 1.0

# Interval of the factors on the elements of the LQR gain.
MULTIPLIERS: Final = {
    "stable": (0.5, 1.5),
    "code": (1.0, 1.5),
    "periodic": (0.0, 0.75),
    "unstable": (-0.75, 0.75),
}


@dataclass(frozen=True)
class Cartpole(Environment):
    r"""The paper's cartpole: balance a pole on a cart with a perturbed LQR controller.

    The state is (x, x_dot, theta, theta_dot) in m, m/s, rad and rad/s, theta = 0 upright; the
    action a in [-1, 1] is a force of 10 a newton on the cart. The control parameters are the
    four elements of the gain K in ``a = clip(-K s, -1, 1)``, drawn for each episode as LQR gain
    times a uniform random factor, element by element.

    Parameters
    ----------
    gains : {"stable", "code", "periodic", "unstable"}, default="stable"
        Interval of the random factors: [0.5, 1.5] (the paper's text), [1, 1.5] (the default of
        the paper's code), [0, 0.75], [-0.75, 0.75].
    linearization : {"paper", "exact"}, default="paper"
        The linear model behind the LQR gain: the one printed in the paper or the Jacobian of
        the simulated plant. See Notes.
    redraw_terminated : bool, default=False
        Draw the gains and the initial state of an episode again until it runs to the full
        length, as the paper does. Survivorship bias; see ``collect``.
    limit_scale : float, default=1.0
        Multiplies the limits on position (9.6 m) and angle (24 degrees) beyond which an episode
        ends; infinity never ends one. The paper's code doubles them for the unstable gains.
    dt : float, default=0.02
        Length of the explicit Euler step in seconds, also the time between two states.

    Raises
    ------
    ValueError
        If a parameter is outside its set.

    Notes
    -----
    With F = 10 a, total mass M, pole mass m and half length l, the plant is that of Barto,
    Sutton and Anderson (1983) without friction,

    .. math::
        \ddot\theta &= \frac{g \sin\theta - q \cos\theta}
                              {l\,(4/3 - m \cos^2\theta / M)}, \qquad
        q = (F + m l \dot\theta^2 \sin\theta) / M, \\
        \ddot x &= q - m l \ddot\theta \cos\theta / M .

    The reward is -(x^2 + theta^2) of the state stepped into. The initial x and theta are
    uniform in [-1, 1], the velocities in [-0.05, 0.05]. As 1 rad is far beyond 24 degrees, 58 %
    of the draws end on their first step: such an episode is kept with one step and
    ``terminated`` set. Redrawing therefore also truncates the initial angle.

    The LQR gain minimises the integral of s' diag(0.5, 0.05, 1, 0.05) s + a^2 in continuous
    time. The paper's matrices put g m / m_cart on x_dot instead of theta, ignore the inertia of
    the pole and take a force of 1 N for action 1. The resulting
    K* = [-0.7071, -4.2906, -37.4540, -8.0665] is ten times stronger on the plant: 0.027 rad
    saturate the action. The closed loop is stable all the same, but stiff: its eigenvalues
    -68.7, -6.09, -1.23 and -0.197 per second mean a fastest time constant of 15 ms, below the
    20 ms step, and a slowest of 5.1 s, longer than 200 steps: the angle settles, the position
    does not. ``linearization="exact"`` gives [-0.7071, -0.8402, -5.6239, -1.4413] with the
    eigenvalues -4.70 +- 0.37i and -1.74 +- 1.23i, a loop that settles in 200 steps.

    Examples
    --------
    >>> from trajlearn.envs import Cartpole
    >>> system = Cartpole(redraw_terminated=True)
    >>> episodes = system.collect(3, 200, random_state=0)
    >>> episodes[0].states.shape, episodes[0].actions.shape
    ((201, 4), (200, 1))
    >>> upright = system.rollout([[1.0, 0.0, 0.0, 0.0]], system.lqr_gain, 200)
    >>> bool(upright[0].terminated)
    False
    """

    gains: str = "stable"
    _: KW_ONLY
    linearization: str = "paper"
    redraw_terminated: bool = False
    limit_scale: float = 1.0
    dt: float = 0.02

    state_names: ClassVar[tuple[str, ...]] = ("x", "x_dot", "theta", "theta_dot")
    action_names: ClassVar[tuple[str, ...]] = ("force",)
    param_names: ClassVar[tuple[str, ...]] = ("k_x", "k_x_dot", "k_theta", "k_theta_dot")

    def __post_init__(self) -> None:
        if self.gains not in MULTIPLIERS:
            raise ValueError(f"gains must be one of {list(MULTIPLIERS)}; got {self.gains!r}.")
        if self.linearization not in ("paper", "exact"):
            raise ValueError(
                f"linearization must be 'paper' or 'exact'; got {self.linearization!r}."
            )
        if not self.limit_scale > 0:
            raise ValueError(f"limit_scale must be greater than 0; got {self.limit_scale!r}.")
        if not 0 < self.dt < np.inf:
            raise ValueError(f"dt must be a finite number greater than 0; got {self.dt!r}.")

    @property
    def policy(self) -> LinearFeedback:
        """The controller ``a = clip(-K s, -1, 1)``."""
        return LinearFeedback(bounds=(-1.0, 1.0))

    @property
    def action_bounds(self) -> NDArray[np.float64]:
        """Lowest and highest action, [[-1, 1]]."""
        return np.array([[-1.0, 1.0]])

    @property
    def param_bounds(self) -> NDArray[np.float64]:
        """Range of the gains in the chosen mode, shape (4, 2), lower bound first."""
        return np.sort(np.outer(self.lqr_gain, MULTIPLIERS[self.gains]), axis=1)

    @cached_property
    def lqr_gain(self) -> NDArray[np.float64]:
        """The gain K* that the random factors multiply, shape (4,)."""
        from control import lqr

        a, b = self.linearize()
        # The solver is named because python-control would pick another where slycot is present.
        gain, _, _ = lqr(a, b, np.diag(STATE_COST), [[ACTION_COST]], method="scipy")
        gain = np.asarray(gain)[0]
        gain.setflags(write=False)
        return gain

    def linearize(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the linear model ``s_dot = A s + B a`` of the upright pole.

        Returns
        -------
        A : ndarray of shape (4, 4)
        B : ndarray of shape (4, 1)
            As printed in the paper, or the Jacobian of ``derivatives``, by ``linearization``.
        """
        a, b = np.zeros((4, 4)), np.zeros((4, 1))
        a[0, 1] = a[2, 3] = 1.0
        if self.linearization == "paper":
            a[1, 1] = GRAVITY * POLE_MASS / CART_MASS
            a[3, 2] = GRAVITY * TOTAL_MASS / (HALF_POLE * CART_MASS)
            b[1, 0] = 1.0 / CART_MASS
            b[3, 0] = -1.0 / (HALF_POLE * CART_MASS)
        else:
            reaction = POLE_MASS * HALF_POLE / TOTAL_MASS
            inertia = HALF_POLE * (4.0 / 3.0 - POLE_MASS / TOTAL_MASS)
            a[3, 2] = GRAVITY / inertia
            b[3, 0] = -FORCE / (TOTAL_MASS * inertia)
            a[1, 2] = -reaction * a[3, 2]
            b[1, 0] = FORCE / TOTAL_MASS - reaction * b[3, 0]
        return a, b

    def derivatives(self, states: ArrayLike, actions: ArrayLike) -> NDArray[np.float64]:
        """Time derivative of the states in continuous time.

        Parameters
        ----------
        states : array-like of shape (n, 4)
            The states.
        actions : array-like of shape (n, 1)
            The actions, clipped to [-1, 1].

        Returns
        -------
        ndarray of shape (n, 4)
            (x_dot, x_ddot, theta_dot, theta_ddot), per second.

        Raises
        ------
        ValueError
            If a shape is wrong or the actions are not finite.
        """
        s = self._checked_batch(states, "states")
        return self._derivatives(s, self._clipped(actions, len(s), "actions"))

    def reward(self, states: ArrayLike) -> NDArray[np.float64]:
        """Reward -(x^2 + theta^2) of stepping into a state.

        Parameters
        ----------
        states : array-like of shape (..., 4)
            States, with any leading shape.

        Returns
        -------
        ndarray of shape (...)
            The rewards.

        Raises
        ------
        ValueError
            If the last axis does not hold the four states.
        """
        s = self._checked_states(states)
        return -(s[..., 0] ** 2 + s[..., 2] ** 2)

    def is_terminal(self, states: ArrayLike) -> NDArray[np.bool_]:
        """Whether the cart or the pole is beyond its limit.

        Parameters
        ----------
        states : array-like of shape (..., 4)
            States, with any leading shape.

        Returns
        -------
        ndarray of bool of shape (...)
            True where an episode ends on stepping into the state.

        Raises
        ------
        ValueError
            If the last axis does not hold the four states.
        """
        s = self._checked_states(states)
        return (np.abs(s[..., 0]) > POSITION_LIMIT * self.limit_scale) | (
            np.abs(s[..., 2]) > ANGLE_LIMIT * self.limit_scale
        )

    def _draw_initial_state(self, generator: Generator) -> NDArray[np.float64]:
        return generator.uniform(-0.05, 0.05, size=4) * (20.0, 1.0, 20.0, 1.0)

    def _draw_params(self, generator: Generator) -> NDArray[np.float64]:
        return self.lqr_gain * generator.uniform(*MULTIPLIERS[self.gains], size=4)

    def _step(
        self, states: NDArray[np.float64], actions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return states + self.dt * self._derivatives(states, actions)

    @staticmethod
    def _derivatives(
        states: NDArray[np.float64], actions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        _, x_dot, theta, theta_dot = states.T
        sin, cos = np.sin(theta), np.cos(theta)
        push = FORCE * actions[:, 0] + POLE_MASS * HALF_POLE * theta_dot**2 * sin
        push /= TOTAL_MASS
        inertia = HALF_POLE * (4.0 / 3.0 - POLE_MASS * cos**2 / TOTAL_MASS)
        theta_ddot = (GRAVITY * sin - cos * push) / inertia
        x_ddot = push - POLE_MASS * HALF_POLE * theta_ddot * cos / TOTAL_MASS
        return np.stack([x_dot, x_ddot, theta_dot, theta_ddot], axis=1)
