"""PID control of joints."""

from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.policies._checks import checked_bounds, checked_times

__all__ = ["PID"]


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
        object.__setattr__(self, "bounds", checked_bounds(self.bounds))

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
        checked_times(times, len(s))
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
