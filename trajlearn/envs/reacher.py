"""A five-joint arm in three dimensions under PID control with random gains and targets."""

from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from trajlearn.envs._flight import SimulationError, Simulator
from trajlearn.envs.base import Environment
from trajlearn.policies import PID

if TYPE_CHECKING:
    import mujoco

__all__ = ["Reacher"]

JOINTS: Final = ("base_z", "base_x", "elbow_z", "wrist_z", "wrist_x")
N_JOINTS: Final = len(JOINTS)
LINK: Final = 0.5  # m, from joint to joint
BASE: Final = 0.25  # m, where the first joint is on the y axis
CONTROL_STEP: Final = 0.008  # s
PHYSICS_STEP: Final = 0.002  # s
MAX_SPEED: Final = 50.0  # rad/s; episodes of the default setting stay below 10
INITIAL_RANGE: Final = 0.01  # rad and rad/s

MJCF: Final = """
<mujoco model="reacher">
  <option timestep="{timestep}" integrator="implicitfast" gravity="0 0 0">
    <flag contact="disable" autoreset="disable"/>
  </option>
  <size memory="64K"/>
  <default>
    <joint type="hinge" pos="0 0.25 0" damping="{damping}" limited="true" range="-3.14 3.14"/>
    <geom type="box" size="0.05 0.25 0.05" mass="1"/>
    <site size="0.05"/>
    <motor gear="10" ctrllimited="true" ctrlrange="-1 1"/>
  </default>
  <compiler angle="radian"/>
  <worldbody>
    <body name="upper_arm">
      <joint name="base_z" axis="0 0 1"/>
      <joint name="base_x" axis="1 0 0"/>
      <geom/>
      <body name="forearm" pos="0 -0.5 0">
        <joint name="elbow_z" axis="0 0 1"/>
        <geom/>
        <body name="hand" pos="0 -0.5 0">
          <joint name="wrist_z" axis="0 0 1"/>
          <joint name="wrist_x" axis="1 0 0"/>
          <geom/>
          <site name="fingertip" pos="0 -0.25 0"/>
        </body>
      </body>
    </body>
    <site name="goal" pos="{goal}"/>
  </worldbody>
  <actuator>
    <motor joint="base_z"/>
    <motor joint="base_x"/>
    <motor joint="elbow_z"/>
    <motor joint="wrist_z"/>
    <motor joint="wrist_x"/>
  </actuator>
</mujoco>
"""


def _names(kind: str) -> tuple[str, ...]:
    return tuple(f"{kind}_{joint}" for joint in JOINTS)


@dataclass(frozen=True)
class Reacher(Environment):
    r"""The paper's reacher: bring the joints of an arm to random targets with random gains.

    Three links of 0.5 m and 1 kg hang together by hinges about z and x (base), z (elbow), z
    and x (wrist), without gravity. The state holds the cosines, the sines and the velocities
    (rad/s) of the five joints; the actions in [-1, 1] are torques of 10 a newton metre. The
    control parameters of an episode are (P / 5, D, target) of a PID controller, drawn uniformly
    from [0, 1], [0, 1] and [-1, 1] for every joint.

    Parameters
    ----------
    controller : {"angle", "cos"}, default="angle"
        What the controller regulates: the joint angles, as the paper says, or their cosines
        with a kick of the derivative term in the first step, as the paper's code does.
    goal : tuple of three floats, default=(0.5, -0.5, 0.5)
        The point (x, y, z) in m that the reward measures the distance to. It does not act on
        the arm. The default is a corner of the cube that the paper draws goals from, just
        within reach of targets in [-1, 1].
    damping : float, default=2.0
        Viscous friction of every joint in N m s/rad.

    Raises
    ------
    ValueError
        If a parameter is outside its set.

    Notes
    -----
    With the arm straight along -y at q = 0 and l = (0, -0.5, 0), the fingertip is at

    .. math::
        (0, 0.25, 0) + R_z(q_0) R_x(q_1) \bigl(l + R_z(q_2) (l + R_z(q_3) R_x(q_4)\, l)\bigr) ,

    and the reward of stepping into a state is minus its distance from the goal.

    MuJoCo integrates with steps of 2 ms, four for each action, by ``implicitfast``: the hand
    rolls about its long axis with so little inertia that explicit methods are at the edge of
    stability with the damping of 2, where MuJoCo starts again at zero and goes on. Here a
    warning of MuJoCo and a joint faster than 50 rad/s are errors.

    Angles and velocities start within 0.01 of zero: episodes differ by their parameters. A
    joint stops softly at +-3.14 rad. It may be pressed a little beyond a half turn there, which
    the state cannot tell from just before the opposite stop; ``step`` and ``rollout`` take the
    angle between -pi and pi. Only the controller on cosines gets there.

    Both controllers take the derivative term from the velocity, see `PID`, so that they can be
    asked at any state. The paper's code takes differences of successive errors.

    Examples
    --------
    >>> from trajlearn import Reacher
    >>> system = Reacher()
    >>> episodes = system.collect(3, 500, random_state=0)
    >>> episodes[0].states.shape, episodes[0].actions.shape
    ((501, 15), (500, 5))
    >>> start = system.reset(1, random_state=0)
    >>> system.fingertip(start).round(1)
    array([[-0.  , -1.2,  0. ]])
    """

    controller: str = "angle"
    _: KW_ONLY
    goal: tuple[float, float, float] = (0.5, -0.5, 0.5)
    damping: float = 2.0

    state_names: ClassVar[tuple[str, ...]] = _names("cos") + _names("sin") + _names("velocity")
    action_names: ClassVar[tuple[str, ...]] = _names("torque")
    param_names: ClassVar[tuple[str, ...]] = _names("p") + _names("d") + _names("target")

    # No episode ends early.
    redraw_terminated = False
    dt = CONTROL_STEP

    def __post_init__(self) -> None:
        if self.controller not in ("angle", "cos"):
            raise ValueError(f"controller must be 'angle' or 'cos'; got {self.controller!r}.")
        goal = np.asarray(self.goal, dtype=np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"goal must be three finite numbers (x, y, z); got {self.goal!r}.")
        object.__setattr__(self, "goal", tuple(goal.tolist()))
        if not 0 <= self.damping < np.inf:
            raise ValueError(
                f"damping must be a finite number of at least 0; got {self.damping!r}."
            )

    @property
    def policy(self) -> PID:
        """The PID controller on angles or cosines."""
        return PID(self.controller, dt=CONTROL_STEP, initial_kick=self.controller == "cos")

    @property
    def action_bounds(self) -> NDArray[np.float64]:
        """Lowest and highest action of the five joints, [[-1, 1], ...]."""
        return np.tile([-1.0, 1.0], (N_JOINTS, 1))

    @property
    def param_bounds(self) -> NDArray[np.float64]:
        """Range of P / 5, D and target of the joints, shape (15, 2), lower bound first."""
        return np.repeat([[0.0, 1.0], [0.0, 1.0], [-1.0, 1.0]], N_JOINTS, axis=0)

    @property
    def mjcf(self) -> str:
        """The model in MuJoCo's XML format, to look at in a viewer."""
        return MJCF.format(
            timestep=PHYSICS_STEP, damping=self.damping, goal=" ".join(map(str, self.goal))
        )

    def fingertip(self, states: ArrayLike) -> NDArray[np.float64]:
        """Position of the fingertip by forward kinematics.

        Parameters
        ----------
        states : array-like of shape (..., 15)
            States, with any leading shape. Each pair (cos, sin) is divided by its length, so that
            a prediction whose squares do not add up to 1 leaves the links as long as they are; a
            pair of zeros stands for no angle and folds the rest of the arm into its joint.

        Returns
        -------
        ndarray of shape (..., 3)
            x, y and z in m.

        Raises
        ------
        ValueError
            If the last axis does not hold the fifteen states.
        """
        s = self._checked_states(states)
        cos, sin = (np.moveaxis(s[..., at : at + N_JOINTS], -1, 0) for at in (0, N_JOINTS))
        length = np.hypot(cos, sin)
        cos, sin = (part / np.where(length > 0, length, 1.0) for part in (cos, sin))
        # from the tip inwards: a link along -y is turned by a joint, the next link is added
        x, y, z = np.zeros_like(cos[0]), -LINK * cos[4], -LINK * sin[4]
        x, y = cos[3] * x - sin[3] * y, sin[3] * x + cos[3] * y - LINK
        x, y = cos[2] * x - sin[2] * y, sin[2] * x + cos[2] * y - LINK
        y, z = cos[1] * y - sin[1] * z, sin[1] * y + cos[1] * z
        x, y = cos[0] * x - sin[0] * y, sin[0] * x + cos[0] * y + BASE
        return np.stack([x, y, z], axis=-1)

    def reward(self, states: ArrayLike) -> NDArray[np.float64]:
        """Reward of stepping into a state, minus the fingertip's distance from the goal in m.

        Parameters
        ----------
        states : array-like of shape (..., 15)
            States, with any leading shape.

        Returns
        -------
        ndarray of shape (...)
            The rewards.

        Raises
        ------
        ValueError
            If the last axis does not hold the fifteen states.
        """
        return -np.linalg.norm(self.fingertip(states) - self.goal, axis=-1)

    def _draw_initial_state(self, generator: Generator) -> NDArray[np.float64]:
        angles, velocities = generator.uniform(-INITIAL_RANGE, INITIAL_RANGE, size=(2, N_JOINTS))
        return _states(angles, velocities)

    def _draw_params(self, generator: Generator) -> NDArray[np.float64]:
        low, high = self.param_bounds.T
        return generator.uniform(low, high)

    def _step(
        self, states: NDArray[np.float64], actions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        arm = _Arm(self._model())
        angles, velocities = _coordinates(states)
        for row in range(len(states)):
            arm.start(angles[row], velocities[row])
            angles[row], velocities[row] = arm.advance(actions[row], row)
        return _checked(angles, velocities)

    def _simulator(self, starts: NDArray[np.float64]) -> Simulator:
        model = self._model()
        arms = [_Arm(model) for _ in starts]
        for arm, angles, velocities in zip(arms, *_coordinates(starts), strict=True):
            arm.start(angles, velocities)

        def advance(
            rows: NDArray[np.intp], states: NDArray[np.float64], actions: NDArray[np.float64]
        ) -> NDArray[np.float64]:
            angles, velocities = np.empty((2, len(rows), N_JOINTS))
            for k, row in enumerate(rows.tolist()):
                angles[k], velocities[k] = arms[row].advance(actions[k], k)
            return _checked(angles, velocities)

        return advance

    def _model(self) -> "mujoco.MjModel":
        import mujoco

        return mujoco.MjModel.from_xml_string(self.mjcf)


class _Arm:
    """MuJoCo's state of one arm, which counts the turns of a joint and remembers warnings."""

    def __init__(self, model: "mujoco.MjModel") -> None:
        import mujoco

        self._model, self._data = model, mujoco.MjData(model)
        self._step, self._reset = mujoco.mj_step, mujoco.mj_resetData
        self._substeps = round(CONTROL_STEP / PHYSICS_STEP)
        # views that follow the data
        self._angles, self._velocities = self._data.qpos, self._data.qvel
        self._torques, self._warnings = self._data.ctrl, self._data.warning.number

    def start(self, angles: NDArray[np.float64], velocities: NDArray[np.float64]) -> None:
        self._reset(self._model, self._data)
        self._angles[:], self._velocities[:] = angles, velocities

    def advance(
        self, action: NDArray[np.float64], row: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angles and velocities, as views, after one control step; ``row`` is for messages."""
        self._torques[:] = action
        self._step(self._model, self._data, nstep=self._substeps)
        if any(self._warnings.tolist()):
            from mujoco import mjtWarning

            raised = [mjtWarning(i).name for i in np.flatnonzero(self._warnings)]
            names = ", ".join(name.removeprefix("mjWARN_") for name in raised)
            raise SimulationError(row, f"made MuJoCo warn ({names})")
        return self._angles, self._velocities


def _coordinates(
    states: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angles and velocities of states (n, 15)."""
    cos, sin, velocities = np.hsplit(states, 3)
    off = np.abs(np.hypot(cos, sin) - 1.0) > 1e-3
    if off.any():
        row, joint = np.argwhere(off)[0]
        raise ValueError(
            f"(cos, sin) of {JOINTS[joint]} in row {row} of the states is "
            f"({cos[row, joint]}, {sin[row, joint]}), which no angle has. Divide the pair by "
            "its length, or pass the states in their own units if they were scaled."
        )
    return np.arctan2(sin, cos), velocities.copy()


def _states(angles: NDArray[np.float64], velocities: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([np.cos(angles), np.sin(angles), velocities], axis=-1)


def _checked(angles: NDArray[np.float64], velocities: NDArray[np.float64]) -> NDArray[np.float64]:
    """States of the angles and velocities (n, 5), which must be plausible."""
    fast = ~(np.abs(velocities) <= MAX_SPEED).all(axis=1)
    if fast.any():
        reason = f"moved a joint faster than {MAX_SPEED:g} rad/s"
        raise SimulationError(int(np.argmax(fast)), reason)
    return _states(angles, velocities)
