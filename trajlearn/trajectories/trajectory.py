"""One episode."""

from collections.abc import Hashable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.trajectories._columns import Columns, pack

__all__ = ["Trajectory"]


class Trajectory:
    """One episode of a controlled system; immutable, validated on construction.

    Parameters
    ----------
    states : array-like of shape (T + 1, d_s)
        s_0 ... s_T, the reset state included.
    actions : array-like of shape (T, d_a), optional
        As applied (after clipping); ``actions[t]`` takes s_t to s_{t+1}.
    rewards : array-like of shape (T,), optional
        ``rewards[t]`` belongs to the step into s_{t+1}.
    params : array-like of shape (p,) or (T, p), optional
        Parameters theta of the controller; (T, p) where they change on the way
        (``params[t]`` is in force from s_t to s_{t+1}).
    references : array-like of shape (T + 1, d_r), optional
        Exogenous signals whose future is known, such as a set-point.
    times : array-like of shape (T + 1,), optional
        Strictly increasing, irregular allowed. Default: ``t * dt``.
    dt : float, default=1.0
        Sampling time where `times` is not given.
    time_origin : float, default=nan
        The time at which the motion begins, in the unit of `times`; NaN if unknown. It may
        fall between samples or before the first one.
    context : mapping, optional
        Discrete facts of the episode (task, kind of motor): text, whole numbers or booleans.
    group : hashable, optional
        Label for group splits, such as the experiment an episode belongs to.
    terminated : bool, default=False
        The episode ended by itself (fell, crashed) rather than by a time limit.
    id : hashable, default=0
        What messages and tables call the episode.

    Raises
    ------
    InvalidEpisodeError
        Wrong shapes, non-finite values, unsorted times, or fewer than two states.

    Examples
    --------
    >>> import numpy as np
    >>> episode = Trajectory(np.zeros((4, 2)), actions=np.ones((3, 1)), params=[0.5], dt=0.1)
    >>> episode
    Trajectory(steps=3, d_s=2, d_a=1, p=1, duration=0.3)
    """

    __slots__ = (
        "actions",
        "context",
        "group",
        "id",
        "params",
        "references",
        "rewards",
        "states",
        "terminated",
        "time_origin",
        "times",
    )

    states: NDArray[np.float64]
    actions: NDArray[np.float64] | None
    rewards: NDArray[np.float64] | None
    params: NDArray[np.float64] | None
    references: NDArray[np.float64] | None
    times: NDArray[np.float64]
    time_origin: float
    context: Mapping[str, Any]
    group: Hashable | None
    terminated: bool
    id: Hashable

    def __init__(
        self,
        states: ArrayLike,
        *,
        actions: ArrayLike | None = None,
        rewards: ArrayLike | None = None,
        params: ArrayLike | None = None,
        references: ArrayLike | None = None,
        times: ArrayLike | None = None,
        dt: float = 1.0,
        time_origin: float = float("nan"),
        context: Mapping[str, Any] | None = None,
        group: Hashable | None = None,
        terminated: bool = False,
        id: Hashable = 0,
    ) -> None:
        fields = {
            "states": states,
            "actions": actions,
            "rewards": rewards,
            "params": params,
            "references": references,
            "times": times,
            "dt": dt,
            "time_origin": time_origin,
            "context": context,
            "group": group,
            "terminated": terminated,
        }
        self._take(pack([fields], [id]), 0)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(
            f"a Trajectory cannot be changed; make a new one: "
            f"Trajectory(**(episode.to_dict() | {{{name!r}: ...}}))"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self.to_dict(),)

    @classmethod
    def _of(cls, columns: Columns, i: int) -> "Trajectory":
        """Episode `i` of columns already validated: views, nothing copied."""
        episode = cls.__new__(cls)
        episode._take(columns, i)
        return episode

    def _take(self, columns: Columns, i: int) -> None:
        a, b = columns.offsets[i : i + 2]
        state_rows, step_rows = slice(a, b), slice(a - i, b - i - 1)
        values: dict[str, Any] = {
            "states": columns.states[state_rows],
            "times": columns.times[state_rows],
            "references": None if columns.references is None else columns.references[state_rows],
            "actions": None if columns.actions is None else columns.actions[step_rows],
            "rewards": None if columns.rewards is None else columns.rewards[step_rows],
            "params": None,
            "time_origin": float(columns.time_origin[i]),
            "context": MappingProxyType({k: v[i].item() for k, v in columns.context.items()}),
            "group": None if columns.group is None else columns.group[i].item(),
            "terminated": bool(columns.terminated[i]),
            "id": columns.ids[i].item(),
        }
        if columns.params is not None and columns.params_per_step:
            params = columns.params[step_rows]
            values["params"] = params[0] if (params == params[0]).all() else params
        elif columns.params is not None:
            values["params"] = columns.params[i]
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def length(self) -> int:
        """Number of steps T."""
        return len(self.states) - 1

    def __len__(self) -> int:
        return self.length

    def __repr__(self) -> str:
        parts = [f"steps={self.length}", f"d_s={self.states.shape[1]}"]
        if self.actions is not None:
            parts.append(f"d_a={self.actions.shape[1]}")
        if self.params is not None:
            parts.append(f"p={self.params.shape[-1]}")
        if self.references is not None:
            parts.append(f"d_r={self.references.shape[1]}")
        parts.append(f"duration={self.times[-1] - self.times[0]:g}")
        if self.terminated:
            parts.append("terminated=True")
        return f"Trajectory({', '.join(parts)})"

    def to_dict(self) -> dict[str, Any]:
        """Fields by name, as the constructor takes them.

        Returns
        -------
        dict
        """
        fields = {name: getattr(self, name) for name in self.__slots__}
        return fields | {"context": dict(self.context)}


def _rebuild(fields: dict[str, Any]) -> Trajectory:
    return Trajectory(**fields)
