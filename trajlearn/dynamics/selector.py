"""Forecasts by the formulation that is best at each horizon, judged on held-out episodes."""

from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.frozen import FrozenEstimator
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import Interval, StrOptions, fit_context
from trajlearn.dynamics._episode_arguments import in_groups
from trajlearn.dynamics._forecaster import DIVERGENCE_RANGES
from trajlearn.dynamics._selection.assessment import assess_all, errors_in_ranges, states_of
from trajlearn.dynamics._selection.choice import Choice, blend, pick, step_weights
from trajlearn.dynamics._selection.default_members import default_members
from trajlearn.dynamics._selection.evidence import ReportsSelection
from trajlearn.dynamics._selection.folds import held_out_folds, units_of
from trajlearn.dynamics._selection.forecasts_by_weights import ForecastsByWeights
from trajlearn.dynamics._selection.held_out_noise import HeldOutNoise, noise_of
from trajlearn.dynamics._selection.losses import HorizonLosses
from trajlearn.dynamics._selection.named_members import checked_members, with_policy
from trajlearn.dynamics.distilled import DistilledForecaster
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.times import median_step

__all__ = ["HorizonSelector"]

Floats = NDArray[np.float64]


class HorizonSelector(ReportsSelection, ForecastsByWeights):
    """Fits several formulations and forecasts by the one that is best at each horizon.

    No formulation wins everywhere: a one-step model is ahead where the whole state is measured
    well, a trajectory model where it is not, and which of them at which horizon, nobody knows
    before. Here each member is fitted on some episodes and forecasts the others from their first
    state; its squared errors by horizon, compared with the logged states, decide.

    - The loss of a member on an episode at a horizon is log(1 + e / m), with e its squared error
      in training ranges, averaged over horizons nearby, and m the geometric mean of the best
      member's error on that episode and of its median error: one episode in which all go wrong
      decides nothing.
    - ``rule="pick"``: the member of least mean loss over all horizons; at a horizon where another
      one is better by more than `margin` standard errors, paired by episode, that one.
    - ``rule="blend"``: the pick; at a horizon where a convex combination of the `n_blended` best
      members, that of least loss, is better than the pick by more than twice that, the
      combination.

    Parameters
    ----------
    estimators : list of (str, estimator) or None, default=None
        Members by name: dynamics estimators or Pipelines that end in one, all of the same states.
        ``"drop"`` in place of one leaves it out; one in a `FrozenEstimator` is not fitted, and
        should not have seen the episodes. None: what suits the episodes, see `default_members`.
    policy : callable, "clone" or None, default=None
        Policy for all members that have a parameter `policy` and none of their own. For the
        default members None is "clone": they learn it from the logged actions.
    cv : int, splitter or iterable of (train, test), default=4
        Folds of whole episodes (of groups, where there are); up to five episodes are left out one
        by one, and forecast with the policy that is cloned from all of them (few do not determine
        how actions depend on several gains; it sees what it is judged by). Your own folds may hold
        out an episode once at most, and train on others only.
    rule : {"pick", "blend"}, default="pick"
    margin : float, default=1.0
        Standard errors by which another member must be better at a horizon.
    bandwidth : float, default=0.3
        Errors at horizons that differ by less than this in their logarithm are averaged, with
        weights that fall from the middle on. 0 takes each step by itself.
    n_blended : int, default=5
        Members that "blend" combines.
    race : bool, default=True
        A member leaves after the first or the second fold if it is behind another one: its loss
        over all horizons is greater by more than two standard errors, and at no horizon is it
        likely to be more than slightly better. It costs a part of a full fit then. Five episodes
        (groups) have to be held out first; "blend" keeps the `n_blended` best. False judges all
        members by all folds: that takes two to three times as long where networks are behind.
    error_score : float, default=-1e12
        Score of a diverged episode.
    random_state : int, RandomState or None, default=None
    n_jobs : int or None, default=None
        Members fitted at once, as in joblib.
    verbose : int, default=0
        1 shows a progress bar of all fits, with the members and folds that are at it; 2 also those
        of members.

    Attributes
    ----------
    names_ : tuple of str
    estimators_ : list of estimator
        Members, fitted on all episodes. One that left the race was fitted on the training
        episodes of one fold only (one that smooths episodes, on all), and is never chosen.
    best_ : str
        The member of least loss over all horizons.
    weights_ : ndarray of shape (H, M)
        Weight of each member at each step; of a pick one of them is 1.
    choice_ : ndarray of shape (H,)
        Name of the member of greatest weight at each step.
    cv_errors_ : DataFrame
        One row a member and horizon: ``member``, ``horizon``, ``n_episodes`` that the member was
        judged by (fewer if it left the race), ``n_diverged`` of these, the ``median`` and ``mean``
        of their squared errors in training ranges, and the ``loss``.
    fit_seconds_, predict_seconds_ : dict from name to float
        Of all fits of a member (a policy that several of them share counts for each), and of one
        forecast of all episodes it was judged by.
    state_range_ : ndarray of shape (2, d_s)
    state_names_ : tuple of str
    dt_ : float
        Median time step.

    Notes
    -----
    An episode counts at the horizons it has. A member that cannot forecast as many episodes to a
    horizon as another (a trajectory model where theta changes on the way) is not chosen there.
    Beyond the longest held-out episode the last choice is kept. A forecast's `actions` say where
    its members, chosen or not, take theirs from.

    `std` and `samples` are those of the mixture of members under the weights; one that has no
    standard deviation gets the root mean square of its held-out errors at that horizon. Put a
    `CalibratedForecaster` around the selector for intervals that hold.

    Errors are measured against logged states, noise and all, which hides differences that are
    small beside it. And the best of many on the same episodes looks better than it is: judge the
    selector itself on episodes that it has not seen.

    See Also
    --------
    trajlearn.evaluation.cross_validate_horizons : one estimator's errors by horizon.

    References
    ----------
    L. Breiman, "Stacked regressions", Machine Learning 24 (1996) (convex weights by
    cross-validation).
    L. Breiman et al., "Classification and Regression Trees", 1984 (one standard error).

    Examples
    --------
    A decay under known feedback is linear step by step; its end is not linear in theta:

    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import HorizonSelector, OneStepRegressor, TrajectoryDataset
    >>> from trajlearn import TrajectoryRegressor
    >>> theta = np.linspace(0.2, 1.0, 12)[:, None]
    >>> states = np.exp(-theta * 0.1 * np.arange(41))[..., None]
    >>> ds = TrajectoryDataset.from_arrays(states, actions=-theta[..., None] * states[:, :-1],
    ...                                    params=theta, dt=0.1)
    >>> model = HorizonSelector([
    ...     ("D", OneStepRegressor(LinearRegression(), policy=lambda s, theta, t: -theta * s)),
    ...     ("T", TrajectoryRegressor(LinearRegression())),
    ... ], random_state=0).fit(ds)
    >>> model.best_, model.predict(ds)
    ('D', Forecast(n=12, H=40, d_s=1, actions='policy'))
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "estimators": [list, tuple, None],
        "policy": [callable, StrOptions({"clone"}), None],
        "cv": [Interval(Integral, 2, None, closed="left"), "cv_object"],
        "rule": [StrOptions({"pick", "blend"})],
        "margin": [Interval(Real, 0, None, closed="left")],
        "bandwidth": [Interval(Real, 0, None, closed="left")],
        "n_blended": [Interval(Integral, 1, 10, closed="both")],
        "race": ["boolean"],
        "error_score": [Interval(Real, None, 0, closed="both")],
        "random_state": ["random_state"],
        "n_jobs": [Integral, None],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        estimators: Any = None,
        *,
        policy: Any = None,
        cv: Any = 4,
        rule: str = "pick",
        margin: float = 1.0,
        bandwidth: float = 0.3,
        n_blended: int = 5,
        race: bool = True,
        error_score: float = -1e12,
        random_state: Any = None,
        n_jobs: int | None = None,
        verbose: int = 0,
    ) -> None:
        self.estimators = estimators
        self.policy = policy
        self.cv = cv
        self.rule = rule
        self.margin = margin
        self.bandwidth = bandwidth
        self.n_blended = n_blended
        self.race = race
        self.error_score = error_score
        self.random_state = random_state
        self.n_jobs = n_jobs
        self.verbose = verbose

    def _defaults(self) -> dict[str, Any]:
        # the members depend on the episodes
        return {}

    # -- fitting --------------------------------------------------------------------------

    @fit_context(prefer_skip_nested_validation=False)
    def fit(self, X: Any, y: None = None, *, groups: ArrayLike | None = None) -> Self:
        """Judge the members on held-out episodes, and fit them on all.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
            Must be omitted.
        groups : array-like of shape (n,), optional
            Labels of episodes that are held out together. The default is ``ds.group``, else the
            episode.

        Returns
        -------
        self

        Raises
        ------
        TypeError
            If `X` is rows, or a member predicts no `Forecast`.
        ValueError
            If there is one episode or group only; if a fold of `cv` is empty, trains on what it
            holds out, or holds out what another one does; if members forecast different states.
        """
        ds = in_groups(self._episodes(X, y), groups)
        seed = check_random_state(self.random_state).randint(2**31, size=4)
        splitting, fitting = np.random.default_rng(seed).spawn(2)
        members = self._members(ds)
        folds = held_out_folds(ds, self.cv, splitting)
        assessed = assess_all(
            members,
            ds,
            folds,
            fitting,
            bandwidth=self.bandwidth,
            n_kept=(1 if self.rule == "pick" else self.n_blended) if self.race else None,
            n_jobs=self.n_jobs,
            verbose=self.verbose,
        )
        names = tuple(name for name, _ in members)
        self.state_names_, self.state_range_, columns = states_of(assessed, ds)
        scaled, self._errors = errors_in_ranges(assessed, ds)
        self._units, self._bandwidth = units_of(ds), self.bandwidth
        losses = self._losses()
        self.names_, self.estimators_ = names, [a.model for a in assessed]
        choice = self._chosen(losses, scaled)
        self.best_ = names[choice.best]
        self.weights_ = step_weights(choice, losses, self._errors.shape[2])
        self.choice_ = np.array(names)[self.weights_.argmax(axis=1)]
        self.fit_seconds_ = {name: a.fit_seconds for name, a in zip(names, assessed)}
        self.predict_seconds_ = {name: a.predict_seconds for name, a in zip(names, assessed)}
        self.dt_ = median_step(ds)
        self._sources = tuple(a.actions for a in assessed)
        self._noise: list[HeldOutNoise | None] = [
            None if a.gives_std else noise_of(a, self.state_range_, columns, self.bandwidth)
            for a in assessed
        ]
        elapsed = np.concatenate([a.elapsed for a in assessed])
        self._elapsed: Floats = np.maximum.accumulate(np.nanmedian(elapsed, axis=0))
        return self

    def _members(self, ds: TrajectoryDataset) -> list[tuple[str, Any]]:
        if self.estimators is None:
            return default_members(ds, policy=self.policy)
        taken = set(self.get_params(deep=False))
        given = checked_members(self.estimators, taken)
        return [(name, with_policy(member, self.policy)) for name, member in given]

    def _chosen(self, losses: HorizonLosses, residuals: Floats) -> Choice:
        if self.rule == "pick":
            return pick(losses, self.margin)
        # as in the losses, who has diverged is this far off
        finite = np.clip(residuals, -DIVERGENCE_RANGES, DIVERGENCE_RANGES)
        return blend(losses, finite, self.margin, self.n_blended, self.bandwidth)

    def distill(
        self, X: Any, student: Any = None, *, random_state: Any = None, **settings: Any
    ) -> DistilledForecaster:
        """Teach one trajectory model what the selector forecasts: any horizon in one evaluation.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
            With params; what the student learns from beside what the selector imagines.
        student : dynamics estimator or None, default=None
            None is `TrajectoryRegressor()`.
        random_state : int, RandomState or None, default=None
        **settings
            Further parameters of `DistilledForecaster`, such as ``param_bounds=``.

        Returns
        -------
        DistilledForecaster
            Fitted. ``fidelity(others)`` measures, by horizon and on episodes that neither has
            seen, what was lost.
        """
        check_is_fitted(self, "weights_")
        teacher = FrozenEstimator(self)
        distilled = DistilledForecaster(teacher, student, random_state=random_state, **settings)
        return distilled.fit(X)
