"""A quadrotor that a PD controller with random gains keeps level."""

from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from numbers import Real
from typing import ClassVar, Final

import numpy as np
from numpy.random import Generator, RandomState
from numpy.typing import ArrayLike, NDArray

from trajlearn.envs._attitude_pd import AttitudePD
from trajlearn.envs._rigid_body import MAX_PWM, STATES, Airframe, advance
from trajlearn.envs.base import Environment, _positive_integer
from trajlearn.policies import Policy
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["Quadrotor"]

STATE_SETS: Final = {
    "attitude": ("roll", "pitch", "wx", "wy", "wz"),
    "scored": ("vx", "vy", "roll", "pitch", "yaw"),
    "observed": STATES[3:],
    "all": STATES,
}
# What the rate of change of a state depends on, itself and the motors apart.
DEPENDS_ON: Final = {
    "x": ("vx",),
    "y": ("vy",),
    "z": ("vz",),
    "vx": ("roll", "pitch", "yaw"),
    "vy": ("roll", "pitch", "yaw"),
    "vz": ("roll", "pitch"),
    "roll": ("pitch", "wx", "wy", "wz"),
    "pitch": ("roll", "wy", "wz"),
    "yaw": ("roll", "pitch", "wy", "wz"),
    "wx": ("wy", "wz"),
    "wy": ("wx", "wz"),
    "wz": ("wx", "wy"),
}

# Half-widths of the box of initial states; the position and the heading start at zero.
INITIAL_RANGE: Final = np.array([0, 0, 0, 0.01, 0.01, 0.01, np.pi / 8, np.pi / 8, 0, *[0.01] * 3])


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


@dataclass(frozen=True)
class Quadrotor(Environment):
    r"""The paper's simulated quadrotor: level a Crazyflie by PD control with random gains.

    A rigid body of twelve states after Mahony, Kumar and Corke (2012): position and velocity
    (m, m/s; x forward, y left, z up), the angles roll, pitch and yaw (rad) and the angular
    velocity in the body wx, wy and wz (rad/s). The actions are the commands of the four motors
    as applied, PWM in [0, 65535]. The control parameters are the gains of `AttitudePD`, drawn
    uniformly for each episode; the reward of stepping into a state is cos(roll) cos(pitch).

    Parameters
    ----------
    states : {"attitude", "scored", "observed", "all"} or tuple of str, default="attitude"
        Which of the twelve states the episodes show, by name or as a set: the five of the
        attitude (roll, pitch, wx, wy, wz), the five (vx, vy, roll, pitch, yaw), the nine from vx
        on, or all. What is not shown is simulated all the same: ``collect`` draws the same
        flights whatever is shown. See Notes for the choice.
    noise : float, default=0.01
        Standard deviation of the Gaussian noise that every step adds to each of the twelve
        states, in their units. 0.01 is the paper's; its code has 1e-4.
    p_range, d_range : tuple of two floats, default=(15, 1500) and (0, 400)
        Ranges of the gains of both axes, PWM per rad and PWM per rad/s. Negative ones are
        allowed: P then pushes the craft over, and D feeds its swinging.
    tilt_limit : float, default=pi / 4
        Roll or pitch beyond which an episode ends, in rad, less than pi / 2.
    airframe : Airframe
        Mass, inertia, arm and thrust; by default those of a Crazyflie.
    integrator : {"euler", "rk4"}, default="euler"
        Explicit Euler as in the paper, or the classical Runge-Kutta method of fourth order.
    dt : float, default=0.05
        Time between two states in seconds, during which the commands are held.
    n_substeps : int, default=10
        Steps of the integrator in that time.
    redraw_terminated : bool, default=False
        Draw gains and initial state of an episode again until it runs to the full length, as
        the paper's code does. Survivorship bias; see ``collect``.

    Raises
    ------
    ValueError
        If a parameter is outside its set.

    Notes
    -----
    With the rotation R from body to world, thrust T, torques :math:`\tau` and inertia I,

    .. math::
        \dot p = v, \quad m \dot v = R\,(0, 0, T)^\top - (0, 0, m g)^\top, \quad
        I \dot\omega = \tau - \omega \times I \omega, \\
        \dot\phi = \omega_x + (\omega_y \sin\phi + \omega_z \cos\phi) \tan\theta, \quad
        \dot\theta = \omega_y \cos\phi - \omega_z \sin\phi, \quad
        \dot\psi = (\omega_y \sin\phi + \omega_z \cos\phi) / \cos\theta .

    *Which five states.* The paper counts five and does not name them; it calls the task
    attitude control. Its code learns the nine of "observed" and scores (vx, vy, roll, pitch); a
    comment adds yaw, which makes "scored". Those leave out the angular velocities: no one-step
    model can tell from them where the attitude goes, and the controller cannot be asked.
    "attitude" is the smallest set with roll and pitch that determines its own future under
    given actions, and holds all that the controller, the reward and the end of an episode
    depend on; hence the default. "observed" and "all" are closed, too.

    *Which plant.* In the paper's code gravity and thrust point the same way, torques are
    multiplied by a lever twice, and each motor has the thrust of the whole craft (see
    `Airframe`). At hover, a PWM of difference turns the craft here with 0.0131 rad/s^2, there
    with 0.0020. The ranges of its gains, [100, 10100] and, on the change of the angle in a step,
    [10, 50010], are therefore divided by 6.5 (and D multiplied by ``dt``): the closed loops are
    about the same, with natural frequencies up to 4.4 rad/s and any damping.

    *What the episodes look like.* With the defaults, 93 % last 500 steps. Those that end
    oscillate more and more: their damping is less than the delay of a held command takes away,
    D < P dt / 2 of an axis. Of the others, without noise, half stay within 5 degrees after
    1.2 s, and 6 % never do. The noise of 0.01 keeps a settled craft swaying by 1.6 degrees and
    0.06 rad/s (standard deviations); nothing controls the heading, so wz is a random walk to
    +-0.2 rad/s after 500 steps. There is no air drag, and nothing holds the height or the
    place: a craft that has leaned keeps its speed, sinks, mostly by less than 50 m in 500
    steps, and with gains that hardly right it comes to 50 m/s.

    The velocities start within 0.01 of zero, roll and pitch within pi / 8, the rest at zero.
    ``step`` is without noise; ``rollout`` takes a seed for it. Neither can start from states
    that are not closed.

    References
    ----------
    R. Mahony, V. Kumar and P. Corke, "Multirotor aerial vehicles: modeling, estimation, and
    control of quadrotor", IEEE Robotics and Automation Magazine 19(3), 2012.

    Examples
    --------
    >>> from trajlearn.envs import Quadrotor
    >>> system = Quadrotor()
    >>> episodes = system.collect(3, 500, random_state=0)
    >>> episodes[0].states.shape, episodes[0].actions.shape
    ((501, 5), (500, 4))
    >>> episodes.state_names
    ('roll', 'pitch', 'wx', 'wy', 'wz')
    >>> calm = Quadrotor("all", noise=0.0)
    >>> hovering = calm.rollout([[0.0] * 12], [500.0, 100.0, 500.0, 100.0], 100)[0]
    >>> bool(abs(hovering.states).max() < 1e-9)
    True
    """

    states: str | tuple[str, ...] = "attitude"
    _: KW_ONLY
    noise: float = 0.01
    p_range: tuple[float, float] = (15.0, 1500.0)
    d_range: tuple[float, float] = (0.0, 400.0)
    tilt_limit: float = np.pi / 4
    airframe: Airframe = Airframe()  # noqa: RUF009 (it is immutable)
    integrator: str = "euler"
    dt: float = 0.05
    n_substeps: int = 10
    redraw_terminated: bool = False

    action_names: ClassVar[tuple[str, ...]] = ("motor_1", "motor_2", "motor_3", "motor_4")
    param_names: ClassVar[tuple[str, ...]] = ("p_pitch", "d_pitch", "p_roll", "d_roll")

    def __post_init__(self) -> None:
        if isinstance(self.states, Iterable) and not isinstance(self.states, str):
            object.__setattr__(self, "states", tuple(self.states))
        names = self.states if isinstance(self.states, tuple) else STATE_SETS.get(self.states, ())
        known = all(name in STATES for name in names)
        if not names or not known or len(set(names)) < len(names):
            raise ValueError(
                f"states must be one of {list(STATE_SETS)} or a tuple of different names from "
                f"{STATES}; got {self.states!r}."
            )
        if not (_is_number(self.noise) and 0 <= self.noise < np.inf):
            raise ValueError(f"noise must be a finite number of at least 0; got {self.noise!r}.")
        for name in ("p_range", "d_range"):
            try:
                bounds = np.asarray(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError):
                bounds = np.array(np.nan)
            if bounds.shape != (2,) or not np.isfinite(bounds).all() or bounds[0] > bounds[1]:
                raise ValueError(
                    f"{name} must be two finite numbers (low, high) with low <= high; got "
                    f"{getattr(self, name)!r}."
                )
            object.__setattr__(self, name, tuple(bounds.tolist()))
        if not (_is_number(self.tilt_limit) and 0 < self.tilt_limit < np.pi / 2):
            raise ValueError(
                f"tilt_limit must be between 0 and pi / 2 rad; got {self.tilt_limit!r}."
            )
        if self.integrator not in ("euler", "rk4"):
            raise ValueError(f"integrator must be 'euler' or 'rk4'; got {self.integrator!r}.")
        if not (_is_number(self.dt) and 0 < self.dt < np.inf):
            raise ValueError(f"dt must be a finite number greater than 0; got {self.dt!r}.")
        _positive_integer(self.n_substeps, "n_substeps")

    @property
    def state_names(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the states that are shown, in the order of their columns."""
        return STATE_SETS[self.states] if isinstance(self.states, str) else self.states

    @property
    def policy(self) -> AttitudePD:
        """The PD controller on the states that are shown.

        Raises
        ------
        ValueError
            If pitch, roll or their angular velocities are not among them. ``collect`` flies
            the controller all the same, on the twelve states.
        """
        return AttitudePD(self.state_names, self.airframe.hover)

    @property
    def action_bounds(self) -> NDArray[np.float64]:
        """Lowest and highest command of the four motors, [[0, 65535], ...]."""
        return np.tile([0.0, MAX_PWM], (4, 1))

    @property
    def param_bounds(self) -> NDArray[np.float64]:
        """Range of P and D of pitch and of roll, shape (4, 2), lower bound first."""
        return np.array([self.p_range, self.d_range] * 2)

    def reset(  # noqa: D102 (inherited)
        self, n_episodes: int, random_state: int | RandomState | None = None
    ) -> NDArray[np.float64]:
        return super().reset(n_episodes, random_state)[:, self._columns]

    def collect(  # noqa: D102 (inherited)
        self,
        n_episodes: int,
        length: int,
        random_state: int | RandomState | None = None,
        *,
        n_jobs: int | None = None,
    ) -> TrajectoryDataset:
        if self.state_names == STATES:
            return super().collect(n_episodes, length, random_state, n_jobs=n_jobs)
        flown = self._whole.collect(n_episodes, length, random_state, n_jobs=n_jobs)
        return flown.select_states(self.state_names)

    def rollout(  # noqa: D102 (inherited)
        self,
        initial_states: ArrayLike,
        params: ArrayLike | None,
        length: int,
        policy: Policy | None = None,
        *,
        random_state: int | RandomState | None = None,
    ) -> TrajectoryDataset:
        if self.state_names == STATES:
            return super().rollout(
                initial_states, params, length, policy, random_state=random_state
            )
        starts = self._embedded(self._checked_batch(initial_states, "initial_states"))
        if policy is not None:
            policy = _OnColumns(policy, self._columns)
        flown = self._whole.rollout(starts, params, length, policy, random_state=random_state)
        return flown.select_states(self.state_names)

    def reward(self, states: ArrayLike) -> NDArray[np.float64]:
        """Reward cos(roll) cos(pitch) of stepping into a state.

        Parameters
        ----------
        states : array-like of shape (..., d_s)
            States, with any leading shape.

        Returns
        -------
        ndarray of shape (...)
            The rewards, 1 for a level craft.

        Raises
        ------
        ValueError
            If the last axis does not hold the states that are shown, or roll or pitch is not
            among them.
        """
        roll, pitch = self._tilt(states)
        return np.cos(roll) * np.cos(pitch)

    def is_terminal(self, states: ArrayLike) -> NDArray[np.bool_]:
        """Whether roll or pitch is beyond ``tilt_limit``.

        Parameters
        ----------
        states : array-like of shape (..., d_s)
            States, with any leading shape.

        Returns
        -------
        ndarray of bool of shape (...)
            True where an episode ends on stepping into the state.

        Raises
        ------
        ValueError
            If the last axis does not hold the states that are shown, or roll or pitch is not
            among them.
        """
        roll, pitch = self._tilt(states)
        return (np.abs(roll) > self.tilt_limit) | (np.abs(pitch) > self.tilt_limit)

    def _draw_initial_state(self, generator: Generator) -> NDArray[np.float64]:
        return generator.uniform(-INITIAL_RANGE, INITIAL_RANGE)

    def _draw_params(self, generator: Generator) -> NDArray[np.float64]:
        low, high = self.param_bounds.T
        return generator.uniform(low, high)

    def _step(
        self, states: NDArray[np.float64], actions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        after = advance(
            self.airframe,
            self._embedded(states),
            actions,
            duration=self.dt,
            n_steps=self.n_substeps,
            integrator=self.integrator,
        )
        return after[:, self._columns]

    def _disturbed(
        self, states: NDArray[np.float64], generators: Sequence[Generator]
    ) -> NDArray[np.float64]:
        if not self.noise:
            return states
        draws = [generator.standard_normal(len(STATES)) for generator in generators]
        return states + self.noise * np.stack(draws)

    @property
    def _columns(self) -> list[int]:
        return [STATES.index(name) for name in self.state_names]

    @property
    def _whole(self) -> "Quadrotor":
        """The same system showing all twelve states, which is what flies."""
        return replace(self, states="all")

    def _tilt(self, states: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        s = self._checked_states(states)
        missing = [name for name in ("roll", "pitch") if name not in self.state_names]
        if missing:
            raise ValueError(
                f"reward and end of an episode depend on roll and pitch, but the states "
                f"{self.state_names} lack {' and '.join(missing)}: choose states that hold them."
            )
        return s[..., self.state_names.index("roll")], s[..., self.state_names.index("pitch")]

    def _embedded(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """All twelve states (n, 12) of the shown ones, with zeros where nothing depends on it."""
        needed = set(self.state_names)
        while not needed >= (more := {name for shown in needed for name in DEPENDS_ON[shown]}):
            needed |= more
        missing = [name for name in STATES if name in needed.difference(self.state_names)]
        if missing:
            raise ValueError(
                f"where the states {self.state_names} go also depends on {', '.join(missing)}, so "
                "nothing can be simulated from them. Simulate with states='all' and call "
                "select_states on the episodes; collect works with any states."
            )
        whole = np.zeros((len(states), len(STATES)))
        whole[:, self._columns] = states
        return whole


@dataclass(frozen=True)
class _OnColumns:
    """A policy for the shown states, asked with all of them."""

    policy: Policy
    columns: list[int]

    def __call__(
        self,
        states: NDArray[np.float64],
        params: NDArray[np.float64],
        times: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        return self.policy(states[:, self.columns], params, times)
