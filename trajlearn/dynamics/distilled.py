"""Trajectory models that learn from what a one-step model imagines."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import HasMethods, Interval, fit_context
from trajlearn.dynamics._episode_arguments import checked_weight, in_groups, weights_for
from trajlearn.dynamics._imagination import begun, imagine, together
from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._meta import ForecasterAround
from trajlearn.dynamics._shared_states import shared_states
from trajlearn.dynamics.forecast import Forecast
from trajlearn.dynamics.one_step import OneStepRegressor
from trajlearn.dynamics.trajectory import TrajectoryRegressor
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.times import median_step

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["DistilledForecaster"]

Floats = NDArray[np.float64]


class DistilledForecaster(ForecasterAround):
    """A trajectory model that learns from logged episodes and from a one-step model's.

    How the future depends on theta, a trajectory model learns from many theta; a log of a few
    trials has few. A one-step model with the policy of the controller knows from one trial what
    other theta do, but needs as many evaluations as there are steps. Here it is the teacher: it
    is fitted on the log and imagines episodes under theta from all over `param_bounds`, and the
    student, which predicts any horizon in one evaluation, learns from both.

    Its forecasts are the student's. It knows no more than the teacher: look at `fidelity`.

    Parameters
    ----------
    teacher : dynamics estimator or None, default=None
        What imagines; only its `predict(episodes, ...)` is used. None is
        ``OneStepRegressor(clip_states=3.0)``, which needs its ``policy``. One that is fitted, in
        a `FrozenEstimator`, is taken as it is.
    student : dynamics estimator or None, default=None
        What learns from states and theta, without actions. None is `TrajectoryRegressor()`.
    param_bounds : array-like of shape (p, 2) or None, default=None
        Imagined theta are uniform between these. None takes the least and the greatest logged
        ones, which is too narrow after one or two trials.
    initial_states : array-like of shape (k, d_s) or None, default=None
        Imagined episodes begin at one of these; None: where a logged episode begins. References,
        context and phase are those of a logged episode.
    n_imagined : int, default=1000
        Imagined episodes: they are cheap, and each has a theta of its own.
    horizon : int or None, default=None
        Their steps; None is the longest logged episode. Those that begin as an episode with
        references, or where the time step varies, end as it does.
    reach : float, default=3.0
        Imagined states are clipped to this multiple of the logged range about its centre (of the
        range with `initial_states`): that a theta leads far off matters, not how far. Were the
        episode cut there, the student would have to guess, and may guess that all is well.
    weight_logged : float, default=1.0
        How many imagined episodes a logged one counts as. Other than 1 needs a student that
        takes `sample_weight`.
    error_score : float, default=-1e12
        Score of a diverged episode.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    teacher_, student_ : estimator
        As fitted.
    imagined_ : TrajectoryDataset
        What the teacher imagined.
    param_bounds_ : ndarray of shape (p, 2)
    dt_ : float or None
        Median time step of the log.
    state_range_ : ndarray of shape (2, d_s)
        Least and greatest logged states.
    max_horizon_ : float
        Longest horizon in training, as a time.

    Notes
    -----
    Where theta is unstable a small difference at the start decides to which side the plant falls,
    and the mean of the student lies between both, where all looks well. Its standard deviation
    tells: judge theta by sampled trajectories (`PolicySearch` with ``objective="lcb"``) rather
    than by the mean one. To plan from the beginning of an episode only, let the student learn
    that: ``relabeler=SubtrajectoryRelabeler(starts="first", horizons="mixture", n_knots=3)``.

    See Also
    --------
    OneStepRegressor : the better choice where horizons are short or time is no matter.

    References
    ----------
    R. S. Sutton, "Dyna, an Integrated Architecture for Learning, Planning, and Reacting",
    SIGART Bulletin 1991 (learning from imagined experience).
    G. Hinton et al., "Distilling the Knowledge in a Neural Network", 2015.

    Examples
    --------
    Three trials of s' = s + 0.1 (a - s), a = -theta s, and the state after 30 steps under a theta
    that none of them had:

    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import DistilledForecaster, OneStepRegressor, TrajectoryDataset
    >>> theta = np.array([[0.2], [0.3], [1.0]])
    >>> states = (0.9 - 0.1 * theta)[..., None] ** np.arange(31)[:, None]
    >>> actions = -theta[..., None] * states[:, :-1]
    >>> ds = TrajectoryDataset.from_arrays(states, actions=actions, params=theta)
    >>> def policy(states, params, times):
    ...     return -params * states
    >>> teacher = OneStepRegressor(LinearRegression(), policy=policy)
    >>> model = DistilledForecaster(teacher, param_bounds=[[0.0, 2.0]], random_state=0)
    >>> model = model.set_params(student__estimator__max_steps=300).fit(ds)
    >>> found = model.predict_trajectory([1.0], params=[1.6], horizons=[3.0, 30.0]).mean.ravel()
    >>> bool(np.abs(found - 0.74 ** np.array([3, 30])).max() < 0.03)
    True
    """

    teacher_: Any
    student_: Any
    imagined_: TrajectoryDataset
    dt_: float | None

    _forecasts_by = "student"
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "teacher": [HasMethods(["fit", "predict"]), None],
        "student": [HasMethods(["fit", "predict"]), None],
        "param_bounds": ["array-like", None],
        "initial_states": ["array-like", None],
        "n_imagined": [Interval(Integral, 1, None, closed="left")],
        "horizon": [Interval(Integral, 1, None, closed="left"), None],
        "reach": [Interval(Real, 1, None, closed="left")],
        "weight_logged": [Interval(Real, 0, None, closed="neither")],
        "error_score": [Interval(Real, None, 0, closed="both")],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        teacher: Any = None,
        student: Any = None,
        *,
        param_bounds: ArrayLike | None = None,
        initial_states: ArrayLike | None = None,
        n_imagined: int = 1000,
        horizon: int | None = None,
        reach: float = 3.0,
        weight_logged: float = 1.0,
        error_score: float = -1e12,
        random_state: Any = None,
    ) -> None:
        self.teacher = teacher
        self.student = student
        self.param_bounds = param_bounds
        self.initial_states = initial_states
        self.n_imagined = n_imagined
        self.horizon = horizon
        self.reach = reach
        self.weight_logged = weight_logged
        self.error_score = error_score
        self.random_state = random_state

    def _defaults(self) -> dict[str, Any]:
        return {"teacher": OneStepRegressor(clip_states=3.0), "student": TrajectoryRegressor()}

    # -- fitting --------------------------------------------------------------------------

    @fit_context(prefer_skip_nested_validation=False)
    def fit(
        self,
        X: Any,
        y: None = None,
        *,
        sample_weight: ArrayLike | None = None,
        groups: ArrayLike | None = None,
    ) -> Self:
        """Fit the teacher on the episodes, then the student on these and on imagined ones.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
            With params; with actions, too, unless the teacher does without.
        y : None
            Must be omitted.
        sample_weight : array-like of shape (n,), optional
            An episode of weight 2 counts as two, as a start of imagined ones, too.
        groups : array-like of shape (n,), optional
            Labels of episodes that a learner keeps together; each imagined one is its own. The
            default is ``ds.group``, else the episode.

        Returns
        -------
        self

        Raises
        ------
        TypeError
            If `X` is rows.
        MissingFieldError
            If the episodes have no params.
        ValueError
            If the teacher has no policy and needs one; if `param_bounds` or `initial_states` do
            not fit the episodes.
        """
        ds = in_groups(self._episodes(X, y), groups)
        ds.require("params", by="DistilledForecaster (theta is what it varies)")
        weight = np.ones(len(ds))
        if sample_weight is not None:
            weight = checked_weight(sample_weight, len(ds))
            ds, weight = ds[weight > 0], weight[weight > 0]
        given = self._given()
        _require_policy(given["teacher"])
        bounds = self._bounds(ds)
        seed = check_random_state(self.random_state).randint(2**31, size=4)
        # streams of their own: what is imagined does not depend on what the teacher has to seed
        teaching, imagining, learning = np.random.default_rng(seed).spawn(3)
        teacher = _fitted(given["teacher"], ds, weight, teaching)
        imagined = self._imagined(teacher, ds, weight, bounds, imagining)
        both = together(ds, imagined)
        counts = np.concatenate([self.weight_logged * weight, np.ones(len(imagined))])
        student = _fitted(given["student"], both, counts, learning)
        # all at once: if this fit fails, no teacher stands beside the student of an earlier one
        self.teacher_, self.student_, self.imagined_ = teacher, student, imagined
        self.param_bounds_, self.dt_ = bounds, median_step(ds)
        self._learn_ranges_of(ds)
        self.max_horizon_ = getattr(student, "max_horizon_", np.inf)
        return self

    def _bounds(self, ds: TrajectoryDataset) -> Floats:
        theta = ds._columns.params
        assert theta is not None  # required
        if self.param_bounds is None:
            return np.stack([theta.min(axis=0), theta.max(axis=0)], axis=1)
        bounds = np.asarray(self.param_bounds, dtype=np.float64)
        if bounds.shape != (theta.shape[1], 2):
            raise ValueError(
                f"param_bounds has shape {bounds.shape}; give the lower and the upper bound of "
                f"each of the {theta.shape[1]} params, ({theta.shape[1]}, 2)."
            )
        if not np.isfinite(bounds).all() or (bounds[:, 0] > bounds[:, 1]).any():
            raise ValueError(
                "param_bounds must be finite, with no lower bound above the upper one; got "
                f"{bounds.tolist()}."
            )
        return bounds

    def _imagined(
        self,
        teacher: Any,
        ds: TrajectoryDataset,
        weight: Floats,
        bounds: Floats,
        rng: np.random.Generator,
    ) -> TrajectoryDataset:
        lower, upper = bounds.T
        episode = rng.choice(len(ds), self.n_imagined, p=weight / weight.sum())
        theta = lower + (upper - lower) * rng.random((self.n_imagined, len(lower)))
        starts = None
        if self.initial_states is not None:
            d_s = len(ds.state_names)
            choice = np.asarray(self.initial_states, dtype=np.float64)
            if choice.ndim != 2 or choice.shape[1] != d_s or not len(choice):
                raise ValueError(f"initial_states has shape {choice.shape}; expected (k, {d_s}).")
            if not np.isfinite(choice).all():
                raise ValueError("initial_states has NaN or infinite values.")
            starts = choice[rng.integers(len(choice), size=self.n_imagined)]
        known = ds.states if starts is None else np.concatenate([ds.states, choice])
        low, high = known.min(axis=0), known.max(axis=0)
        half = self.reach * np.where(high > low, high - low, 1.0) / 2
        middle = (low + high) / 2
        n_steps = int(ds.lengths.max()) if self.horizon is None else self.horizon
        limits = np.stack([middle - half, middle + half])
        return imagine(teacher, begun(ds, episode, theta, starts), n_steps, limits, rng)

    # -- prediction -----------------------------------------------------------------------

    def fidelity(self, X: Any, horizons: Sequence[int] | None = None) -> "pd.DataFrame":
        """What distilling cost: errors of the student and of the teacher, and between them.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
            Other episodes than those of training, forecast from their first state; the teacher
            by its policy, where it takes actions.
        horizons : sequence of int or None, default=None
            Steps; None is all of them.

        Returns
        -------
        DataFrame
            One row a horizon: `horizon`; `n`, the episodes in which both reach it; `student` and
            `teacher`, root mean squared errors in logged ranges, over states and episodes;
            `student_teacher`, the same of their difference. inf where one diverged.
        """
        import pandas as pd

        check_is_fitted(self)
        ds = self._episodes(X)
        student = self.predict(ds)
        # the mean of particles, too, is to be the same each time
        teacher = self._ranged(self.teacher_.predict(ds, actions="policy", random_state=0))
        # a student that knows constant theta only ends where theta changes
        lengths = np.minimum(student.lengths, teacher.lengths)
        longest = int(lengths.max())
        steps = np.arange(1, longest + 1) if horizons is None else np.asarray(horizons)
        if steps.ndim != 1 or not len(steps) or steps.min() < 1 or steps.max() > longest:
            raise ValueError(
                f"horizons must be steps from 1 to {longest}, the longest forecast of both."
            )
        reached = lengths[:, None] >= steps
        squared = {
            "student": student.squared_errors(ds),
            "teacher": teacher.squared_errors(ds),
            "student_teacher": self._squared_gap(student, teacher, ds),
        }
        errors = {
            name: np.sqrt(np.nanmean(values[:, steps - 1], axis=(0, 2), where=reached[..., None]))
            for name, values in squared.items()
        }
        return pd.DataFrame({"horizon": steps, "n": reached.sum(axis=0), **errors})

    def _squared_gap(self, student: Forecast, teacher: Forecast, ds: TrajectoryDataset) -> Floats:
        """Squared difference of two forecasts in logged ranges; inf where one diverged."""
        of_student, names, _ = shared_states(student.state_names, ds)
        of_teacher, others, _ = shared_states(teacher.state_names, ds)
        both = [name for name in names if name in others]
        columns = [of_student[names.index(name)] for name in both]
        n_steps = min(student.mean.shape[1], teacher.mean.shape[1])
        one = student.mean[:, :n_steps, columns]
        other = teacher.mean[:, :n_steps, [of_teacher[others.index(name)] for name in both]]
        low, high = student.state_range[:, columns]
        with np.errstate(invalid="ignore"):
            gap: Floats = ((one - other) / np.where(high > low, high - low, 1.0)) ** 2
        # both at infinity
        gap[np.isinf(one) | np.isinf(other)] = np.inf
        return gap


def _require_policy(teacher: Any) -> None:
    """Refuse a teacher that could only replay logged actions."""
    last = teacher.steps[-1][1] if hasattr(teacher, "steps") else teacher
    if not hasattr(last, "policy") or last.policy is not None:
        return
    relabeler = getattr(last, "relabeler", None)
    inputs = getattr(last if relabeler is None else relabeler, "inputs", "params")
    if "action" in ((inputs,) if isinstance(inputs, str) else inputs):
        raise ValueError(
            "the teacher takes actions and has no policy, so it does not know what other theta "
            "would do: give DistilledForecaster(OneStepRegressor(policy=..., clip_states=3.0)) or "
            "set_params(teacher__policy=...), with policy(states, params, times) -> actions; or "
            'choose a teacher with inputs="params".'
        )


def _fitted(estimator: Any, ds: TrajectoryDataset, weight: Floats, rng: np.random.Generator) -> Any:
    # a frozen one wants a y
    return seeded(estimator, rng).fit(ds, None, **weights_for(estimator, weight))
