"""Equations of motion of a quadrotor as a rigid body, and how they are integrated."""

from dataclasses import KW_ONLY, dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_PWM", "STATES", "Airframe", "advance"]

#: Position and velocity in the world, Euler angles, angular velocity in the body.
STATES: Final = (
    *("x", "y", "z", "vx", "vy", "vz"),
    *("roll", "pitch", "yaw", "wx", "wy", "wz"),
)
MAX_PWM: Final = 65535.0

# Signs of the torques of motors 1 to 4, which are front right, back right, back left and front
# left; 1 and 3 turn counterclockwise seen from above, so the air turns the body clockwise.
ROLL: Final = np.array([-1.0, -1.0, 1.0, 1.0])
PITCH: Final = np.array([-1.0, 1.0, 1.0, -1.0])
YAW: Final = np.array([-1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Airframe:
    r"""The physical constants of a quadrotor with crossed arms, by default of a Crazyflie 2.

    Parameters
    ----------
    mass : float, default=0.027
        In kg.
    inertia : tuple of three floats, default=(2.3951e-5, 2.3951e-5, 3.2347e-5)
        Principal moments about the body's x, y and z in kg m^2.
    arm : float, default=0.046
        Distance of a motor from the centre in m. The arms are at 45 degrees to x and y, so the
        lever of a motor about either is arm / sqrt(2).
    thrust : tuple of two floats, default=(0.35, 0.26)
        a and b of the thrust of the four motors together, a d + b d^2 in N, where
        d = PWM / 65535 is their common command. A motor gives a quarter of it.
    torque_ratio : float, default=0.005964552
        Reaction torque of a motor about z, in m: per newton of its thrust.
    gravity : float, default=9.81
        In m/s^2.

    Raises
    ------
    ValueError
        If a constant is not a finite number greater than 0 (one of ``thrust`` may be 0), or
        the motors cannot lift the weight.

    Notes
    -----
    Mass and inertia are those of the paper's text and code. The thrust curve is the code's,
    too, but it fits the lift of the *whole* craft in the measurements of its maker
    (24.4 g at 50 %, 57.9 g at 94 %), while the code gives as much to each motor. Arm and torque
    ratio are from the firmware; the code has 35.5 mm / sqrt(2) and 1.15 mm.

    Examples
    --------
    >>> from trajlearn.envs import Airframe
    >>> round(Airframe().hover), round(Airframe(mass=0.035).hover)
    (35395, 43167)
    """

    _: KW_ONLY
    mass: float = 0.027
    inertia: tuple[float, float, float] = (2.3951e-5, 2.3951e-5, 3.2347e-5)
    arm: float = 0.046
    thrust: tuple[float, float] = (0.35, 0.26)
    torque_ratio: float = 0.005964552
    gravity: float = 9.81

    def __post_init__(self) -> None:
        shapes = {"inertia": (3,), "thrust": (2,)}
        for name in ("mass", "inertia", "arm", "thrust", "torque_ratio", "gravity"):
            given, shape = getattr(self, name), shapes.get(name, ())
            numbers = np.asarray(given, dtype=np.float64)
            positive = numbers.sum() > 0 if name == "thrust" else (numbers > 0).all()
            if numbers.shape != shape or not positive or not (np.abs(numbers) < np.inf).all():
                what = f"{shape[0]} finite numbers" if shape else "a finite number"
                raise ValueError(f"{name} must be {what} greater than 0; got {given!r}.")
            object.__setattr__(self, name, tuple(numbers.tolist()) if shape else float(numbers))
        if min(self.thrust) < 0:
            raise ValueError(f"thrust must not be negative; got {self.thrust!r}.")
        if self.hover > MAX_PWM:
            raise ValueError(
                f"the weight of {self.mass * self.gravity:.3g} N is more than the motors lift, "
                f"{sum(self.thrust):.3g} N: give a smaller mass or more thrust."
            )

    @property
    def hover(self) -> float:
        """The command (PWM) of all four motors at which a level craft neither climbs nor sinks."""
        a, b = self.thrust
        weight = self.mass * self.gravity
        return MAX_PWM * 2 * weight / (a + float(np.sqrt(a**2 + 4 * b * weight)))

    def wrench(
        self, commands: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Thrust (n,) along the body's z in N and torques (3, n) in N m of commands (n, 4)."""
        a, b = self.thrust
        duty = commands / MAX_PWM
        forces = ((a + b * duty) * duty / 4.0).T
        lever = self.arm / np.sqrt(2.0)
        # Motor by motor: a matrix product may round differently with n.
        total = forces[0] + forces[1] + forces[2] + forces[3]
        roll, pitch, yaw = (
            sum(sign * force for sign, force in zip(signs, forces, strict=True))
            for signs in (ROLL, PITCH, YAW)
        )
        return total, np.stack([lever * roll, lever * pitch, self.torque_ratio * yaw])

    def rates(
        self,
        s: NDArray[np.float64],
        thrust: NDArray[np.float64],
        torques: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Time derivative of the states s (12, n) under a thrust (n,) and torques (3, n)."""
        sin_roll, sin_pitch, sin_yaw = np.sin(s[6:9])
        cos_roll, cos_pitch, cos_yaw = np.cos(s[6:9])
        wx, wy, wz = s[9:]
        ix, iy, iz = self.inertia
        lift = thrust / self.mass
        forward = sin_pitch * cos_roll
        heading_rate = (wy * sin_roll + wz * cos_roll) / cos_pitch
        out = np.empty_like(s)
        out[0:3] = s[3:6]
        out[3] = lift * (cos_yaw * forward + sin_yaw * sin_roll)
        out[4] = lift * (sin_yaw * forward - cos_yaw * sin_roll)
        out[5] = lift * (cos_pitch * cos_roll) - self.gravity
        out[6] = wx + sin_pitch * heading_rate
        out[7] = wy * cos_roll - wz * sin_roll
        out[8] = heading_rate
        out[9] = (torques[0] - (iz - iy) * wy * wz) / ix
        out[10] = (torques[1] - (ix - iz) * wz * wx) / iy
        out[11] = (torques[2] - (iy - ix) * wx * wy) / iz
        return out


def advance(
    airframe: Airframe,
    states: NDArray[np.float64],
    commands: NDArray[np.float64],
    *,
    duration: float,
    n_steps: int,
    integrator: str,
) -> NDArray[np.float64]:
    """States (n, 12) after holding the commands (n, 4) for ``duration`` seconds."""
    thrust, torques = airframe.wrench(commands)
    s, h = np.ascontiguousarray(states.T), duration / n_steps
    for _ in range(n_steps):
        k1 = airframe.rates(s, thrust, torques)
        if integrator == "euler":
            s = s + h * k1
            continue
        k2 = airframe.rates(s + h / 2 * k1, thrust, torques)
        k3 = airframe.rates(s + h / 2 * k2, thrust, torques)
        k4 = airframe.rates(s + h * k3, thrust, torques)
        s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.ascontiguousarray(s.T)
