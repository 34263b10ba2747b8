"""The PD controller that keeps a quadrotor level."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.envs._rigid_body import MAX_PWM, PITCH, ROLL

__all__ = ["AttitudePD"]

FEEDBACK: Final = ("pitch", "wy", "roll", "wx")


@dataclass(frozen=True)
class AttitudePD:
    r"""PD control of pitch and roll by four motors, with the gains as control parameters.

    The parameters are (P_pitch, D_pitch, P_roll, D_roll), P in PWM per rad and D in PWM per
    rad/s, and the command of motor i is

    .. math::
        \mathrm{clip}\bigl(\mathrm{hover} - s_i (P_\theta \theta + D_\theta \omega_y)
        - r_i (P_\phi \phi + D_\phi \omega_x),\ 0,\ 65535\bigr),

    with the signs s = (-, +, +, -) and r = (-, -, +, +) of the torques that the motors exert.
    The heading is left alone.

    Parameters
    ----------
    state_names : tuple of str
        The columns of the states; pitch, wy, roll and wx must be among them.
    hover : float
        Command of every motor in level flight, PWM.

    Raises
    ------
    ValueError
        If a state that is fed back is missing.

    Notes
    -----
    The derivative term is the angular velocity of the body, as a gyroscope measures it, rather
    than the change of the angle; a policy here has no memory of the last angle.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn.envs import AttitudePD
    >>> policy = AttitudePD(("roll", "pitch", "wx", "wy"), hover=30_000.0)
    >>> policy(np.array([[0.0, 0.1, 0.0, 2.0]]), np.array([[900.0, 100.0, 0.0, 0.0]]), np.zeros(1))
    array([[30290., 29710., 29710., 30290.]])
    """

    state_names: tuple[str, ...]
    hover: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "state_names", tuple(self.state_names))
        missing = [name for name in FEEDBACK if name not in self.state_names]
        if missing:
            raise ValueError(
                f"the controller feeds back {', '.join(FEEDBACK)}, but the states "
                f"{self.state_names} lack {', '.join(missing)}. Choose states that hold them, "
                "such as 'attitude', or roll out the logged actions instead of a policy."
            )

    def __call__(
        self, states: ArrayLike, params: ArrayLike, times: ArrayLike
    ) -> NDArray[np.float64]:
        """Evaluate the control law.

        Parameters
        ----------
        states : array-like of shape (n, d_s)
            Columns as in ``state_names``, in rad and rad/s.
        params : array-like of shape (n, 4)
            The gains of every row.
        times : array-like of shape (n,)
            The times of the rows; the law does not depend on them.

        Returns
        -------
        ndarray of shape (n, 4)
            The commands of the motors, PWM.

        Raises
        ------
        ValueError
            If a shape is wrong; the message names the argument.
        """
        s = np.asarray(states, dtype=np.float64)
        if s.ndim != 2 or s.shape[1] != len(self.state_names):
            raise ValueError(
                f"states must have shape (n, {len(self.state_names)}), the columns "
                f"{', '.join(self.state_names)}; got {s.shape}."
            )
        gains = np.asarray(params, dtype=np.float64)
        if gains.shape != (len(s), 4):
            raise ValueError(
                f"params must have shape ({len(s)}, 4), P and D of pitch and of roll for each row "
                f"of states; got {gains.shape}."
            )
        if np.shape(times) != (len(s),):
            raise ValueError(f"times must have shape ({len(s)},); got {np.shape(times)}.")
        pitch, wy, roll, wx = (s[:, [self.state_names.index(name)]] for name in FEEDBACK)
        p_pitch, d_pitch, p_roll, d_roll = np.hsplit(gains, 4)
        u = PITCH * (p_pitch * pitch + d_pitch * wy) + ROLL * (p_roll * roll + d_roll * wx)
        return np.clip(self.hover - u, 0.0, MAX_PWM)
