"""Rows of a learner's inputs at each step of a roll-out; only known signals and actions enter."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._query import Query
from trajlearn.dynamics._rollouts.cloned_policy import controller
from trajlearn.dynamics._rollouts.noisy_sight import Normal, noisy_sight
from trajlearn.dynamics._rollouts.rollout import InputRows, checked_actions, filled
from trajlearn.dynamics._rollouts.window import Window
from trajlearn.exceptions import MissingFieldError

__all__ = ["input_rows"]

Floats = NDArray[np.float64]


def input_rows(
    model: Any,
    query: Query,
    source: str,
    policy: Any,
    sight: tuple[Floats, Normal] | None = None,
) -> InputRows:
    """Function from states to rows, for any number of copies of the starts.

    Copy i of start j is row ``i * len(query) + j``.

    Parameters
    ----------
    model : RollingEstimator
        Fitted.
    query : Query
    source : {"none", "logged", "policy"}
        Where actions come from.
    policy : callable or None
    sight : tuple of ndarray of shape (d_s,) and callable, optional
        Noise of what a policy sees: its standard deviation, and how it is drawn.

    Returns
    -------
    callable

    Raises
    ------
    MissingFieldError
        If the episodes lack what a row holds.
    """
    ds, layout = query.ds, model.layout_
    blocks: dict[str, Floats] = {}
    if "params" in layout or source == "policy":
        theta = _theta(query)
    if "context" in layout:
        blocks["context"] = model.relabeler_.context_rows(ds)
    if "references" in layout:
        ds.require("references", by=f"{type(model).__name__} (fitted with references)")
        assert ds.references is not None
        references = query.future(ds.references, steps=False)
    if query.start.any() and ("previous" in layout or "past_actions" in layout):
        _check_past_actions(model, query)
    logged = None
    if source == "logged":
        assert ds.actions is not None  # the source has been checked
        logged = query.future(ds.actions, steps=True)
    times = np.concatenate([query.initial_times[:, None], query.times], axis=1)
    times = filled(times)
    if source == "policy":
        n_told = ds.states.shape[1] if query.base is not None and model._told() else 0
        control = controller(policy, query, theta, times, n_told)
        if sight is not None:
            control = noisy_sight(control, *sight)
    window = _window(model)
    if window is not None:
        at_start = window.before(query)

    def inputs(states: Floats, k: int, previous: Floats | None) -> tuple[Floats, Floats | None]:
        copies = len(states) // len(query)
        now: dict[str, Floats] = {"state": states}
        past: dict[str, Floats] = {}
        if window is not None:
            # what a roll-out carries along is the window, not the last action
            behind = np.tile(at_start, (copies, 1)) if previous is None else previous
            past = window.blocks(behind, states)
            now |= past
        if logged is not None:
            blocks["action"] = logged[:, k]
        elif source == "policy":
            # the controller knows the state itself, not what it is relative to
            base = 0.0 if query.base is None else np.tile(query.base[:, k], (copies, 1))
            actions = control(states + base, k, past)
            now["action"] = checked_actions(actions, layout["action"], states)
        if "params" in layout:
            blocks["params"] = theta[:, k]
        if "dt" in layout:
            blocks["dt"] = (times[:, k + 1] - times[:, k])[:, None]
        if "references" in layout:
            blocks["references"] = np.concatenate([references[:, k], references[:, k + 1]], axis=1)
        for block, values in blocks.items():
            now[block] = values if copies == 1 else np.tile(values, (copies, 1))
        if "previous" in layout:
            now["previous"] = _before(query, now["action"]) if previous is None else previous
        carried = now.get("action")
        if window is not None:
            carried = window.after(behind, states, carried)
        return layout.assemble(now), carried

    return inputs


def _check_past_actions(model: Any, query: Query) -> None:
    """Raise an error if episodes do not have the actions before a start that rows show."""
    if query.ds.actions is None:
        raise MissingFieldError(
            f'{type(model).__name__} was fitted with past actions (history= or "previous"), but '
            "the episodes have no actions before the start. Give them, or forecast from the first "
            "state."
        )
    model._check_action_width(query.ds)


def _window(model: Any) -> Window | None:
    """The window that a roll-out carries, if a row shows more than one state."""
    if model._history() == 1:
        return None
    columns = model.layout_.columns
    return Window(model._history(), len(columns["state"]), len(columns.get("action", ())))


def _before(query: Query, actions: Floats) -> Floats:
    """Action before the start of each row; the first of an episode has none but itself."""
    started = query.start > 0
    if not started.any():
        return actions
    assert query.ds.actions is not None  # checked
    copies = len(actions) // len(query)
    step = query.rows - np.arange(len(query)) - started
    return np.where(
        np.tile(started, copies)[:, None], np.tile(query.ds.actions[step], (copies, 1)), actions
    )


def _theta(query: Query) -> Floats:
    """theta_t along the roll-out (n, H, p)."""
    params = query.ds.step_params if query.ds.params_vary else None
    if params is None:
        return np.repeat(query.params()[:, None], query.n_steps, axis=1)
    return query.future(params, steps=True)
