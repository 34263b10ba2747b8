"""A policy learned from logged actions: behaviour cloning."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.preprocessing import MaxAbsScaler

from trajlearn.dynamics._learner import fit_learner
from trajlearn.dynamics._query import Query
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.exceptions import MissingFieldError
from trajlearn.regressors.control_law import ControlLawRegressor
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler
from trajlearn.trajectories._relabeler import has_block

__all__ = ["ClonedPolicy", "clone_policy", "controller"]

Floats = NDArray[np.float64]
# (states (m, d_s), step, blocks of the past) -> actions (m, d_a), see `controller`
Controller = Callable[[Floats, int, Mapping[str, Floats]], Any]


@dataclass(frozen=True, eq=False)
class ClonedPolicy:
    """A controller as logged episodes show it: ``policy(states, params, times) -> actions``.

    Parameters
    ----------
    relabeler : TransitionRelabeler
        Fitted; its blocks are what the controller is taken to see.
    scaler : BlockScaler
        Fitted.
    estimator : regressor
        Fitted, from scaled rows to actions.
    action_range : ndarray of shape (2, d_a)
        Least and greatest logged actions, to which the answers are clipped.
    """

    relabeler: TransitionRelabeler
    scaler: BlockScaler
    estimator: Any
    action_range: Floats

    @property
    def blocks(self) -> frozenset[str]:
        """Blocks that the controller sees."""
        return frozenset(self.relabeler.layout_)

    @property
    def history(self) -> int:
        """States that the controller sees: the newest, and those before."""
        return int(self.relabeler.history)

    def act(self, blocks: dict[str, Floats]) -> Floats:
        """Actions (m, d_a) from the blocks (m, width) that the controller sees, and others."""
        rows = self.scaler.scaled(self.relabeler.layout_.assemble(blocks))
        actions = np.asarray(self.estimator.predict(rows), dtype=np.float64)
        actions = actions.reshape(len(rows), -1)
        return np.clip(actions, self.action_range[0], self.action_range[1])

    def check(self, ds: TrajectoryDataset, n_references: int) -> None:
        """Raise an error if episodes do not tell what the controller sees."""
        columns = self.relabeler.layout_.columns
        given = {"params": len(ds.param_names), "references": 2 * n_references}
        for block, width in given.items():
            if block not in columns:
                continue
            ds.require(block, by=f"policy='clone' (cloned from episodes with {block})")
            if width != len(columns[block]):
                raise ValueError(
                    f"the episodes have other {block} than those that the policy was cloned from: "
                    f"expected {', '.join(columns[block])}."
                )

    def __call__(self, states: ArrayLike, params: ArrayLike, times: ArrayLike) -> Floats:
        """Actions (n, d_a) at states (n, d_s) under params (n, p).

        Raises
        ------
        ValueError
            If the controller sees more than that: past states, references or the context. Only
            the model that it was cloned by knows them.
        """
        more = sorted(self.blocks - {"state", "params"})
        if more:
            raise ValueError(
                f"the cloned policy sees {', '.join(more)}, too: roll it out with its model."
            )
        given = {
            "state": np.asarray(states, dtype=np.float64),
            "params": np.asarray(params, dtype=np.float64),
        }
        for name, columns in self.relabeler.layout_.columns.items():
            if given[name].ndim != 2 or given[name].shape[1] != len(columns):
                raise ValueError(
                    f"{'states' if name == 'state' else name} has shape {given[name].shape}; "
                    f"expected (n, {len(columns)}), as the logged actions were cloned from."
                )
        return self.act(given)


def clone_policy(
    ds: TrajectoryDataset,
    estimator: Any,
    *,
    history: int = 1,
    pad: bool = True,
    timed: bool = False,
    weight: Floats | None = None,
    groups: NDArray[Any] | None = None,
) -> ClonedPolicy:
    """Learn what controller gave the logged actions.

    It is taken to see the state, theta, and context and references where there are some; with a
    `history`, the states and actions before, too.

    Parameters
    ----------
    ds : TrajectoryDataset
        With the states that the controller acted on.
    estimator : regressor
        It is fitted.
    history : int, default=1
    pad : bool, default=True
        As in `TransitionRelabeler`.
    timed : bool, default=False
        Whether it is to see the time step, which has to be the same everywhere otherwise.
    weight, groups : ndarray of shape (n,), optional
        By episode.

    Raises
    ------
    MissingFieldError
        If no actions are logged.
    """
    if ds.actions is None:
        raise MissingFieldError(
            "policy='clone' learns a controller from logged actions, but the episodes have none. "
            "Give actions= when the dataset is built, or a policy=, or use inputs='params'."
        )
    wanted = ("params", "context", "references")
    inputs = ["state", *(block for block in wanted if has_block(ds, block))]
    if history > 1:
        inputs += ["past_states", "past_actions"]
    if timed:
        inputs.append("dt")
    relabeler = TransitionRelabeler(inputs=tuple(inputs), history=history, pad=pad).fit(ds)
    begin = relabeler.begins(ds)
    episode = np.searchsorted(ds.offsets, begin, side="right") - 1
    rows = relabeler.rows(ds, episode, begin, begin + 1)
    actions = ds.actions.take(begin - episode, axis=0)
    of_row = None if weight is None else weight[episode]
    scaler = BlockScaler()
    if isinstance(estimator, ControlLawRegressor):
        # zero is zero: feedback has fewer terms in states and gains that are not centred
        scaler = BlockScaler(state=MaxAbsScaler(), action=MaxAbsScaler(), params=MaxAbsScaler())
    scaler.fit(rows, layout=relabeler.layout_, sample_weight=of_row)
    rows, labels = scaler.scaled(rows), None if groups is None else groups[episode]
    if isinstance(estimator, ControlLawRegressor):
        gains = scaler.block_columns_.get("params")
        estimator.fit(rows, actions, sample_weight=of_row, groups=labels, gains=gains)
    else:
        estimator = fit_learner(estimator, rows, actions, weight=of_row, groups=labels)
    limits = np.stack([ds.actions.min(axis=0), ds.actions.max(axis=0)])
    return ClonedPolicy(relabeler, scaler, estimator, limits)


def controller(policy: Any, query: Query, theta: Floats, times: Floats, n_told: int) -> Controller:
    """Where a roll-out gets its actions from: a policy, or a clone with all that it sees.

    Parameters
    ----------
    policy : callable or ClonedPolicy
    query : Query
    theta : ndarray of shape (n, H, p)
    times : ndarray of shape (n, H + 1)
    n_told : int
        Columns of the references of the query that tell a baseline, behind those logged.

    Returns
    -------
    callable
        ``control(states, k, past) -> actions`` at step k, for any number of copies of the starts,
        of states that are not relative to anything.
    """
    if not isinstance(policy, ClonedPolicy):

        def ask(states: Floats, k: int, past: Mapping[str, Floats]) -> Any:
            copies = len(states) // len(query)
            return policy(states, np.tile(theta[:, k], (copies, 1)), np.tile(times[:, k], copies))

        return ask

    n_references = len(query.ds.reference_names) - n_told
    policy.check(query.ds, n_references)
    signals: dict[str, Callable[[int], Floats]] = {}
    if "params" in policy.blocks:
        signals["params"] = lambda k: theta[:, k]
    if "context" in policy.blocks:
        context = policy.relabeler.context_rows(query.ds)
        signals["context"] = lambda k: context
    if "dt" in policy.blocks:
        signals["dt"] = lambda k: (times[:, k + 1] - times[:, k])[:, None]
    if "references" in policy.blocks:
        assert query.ds.references is not None  # checked
        ahead = query.future(query.ds.references[:, :n_references], steps=False)
        signals["references"] = lambda k: np.concatenate([ahead[:, k], ahead[:, k + 1]], axis=1)

    def act(states: Floats, k: int, past: Mapping[str, Floats]) -> Floats:
        copies = len(states) // len(query)
        own = {name: np.tile(signal(k), (copies, 1)) for name, signal in signals.items()}
        return policy.act({"state": states, **past, **own})

    return act
