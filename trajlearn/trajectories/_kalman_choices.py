"""From the parameters of a smoother to its filters: which state goes where."""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from numbers import Real
from typing import Any

import numpy as np

from trajlearn.trajectories._kalman_blocks import Block
from trajlearn.trajectories._kalman_models import Kinematic, StateSpaceModel

__all__ = [
    "MODELS",
    "check_process_noise",
    "given_noise",
    "kinematic_blocks",
    "known_states",
    "state_space_block",
]

MODELS = {"velocity": (1,), "acceleration": (2,), "auto": (1, 2)}


def known_states(given: Any, parameter: str, state_names: Sequence[str]) -> list[str]:
    """Names of states as a list; all if None.

    Raises
    ------
    ValueError
        If one is unknown or repeated, or there is none.
    """
    names = list(state_names) if given is None else list(given)
    if isinstance(given, str):
        names = [given]
    for name in names:
        if name not in state_names:
            close = get_close_matches(str(name), state_names, n=1)
            hint = f" Did you mean {close[0]!r}?" if close else ""
            raise ValueError(
                f"{parameter} names {name!r}; the states are {list(state_names)}.{hint}"
            )
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{parameter} = {names}: name at least one state, and each once.")
    return names


def kinematic_blocks(
    model: str,
    names: Sequence[str],
    velocities: Mapping[str, str] | None,
    append: Any,
    state_names: Sequence[str],
) -> list[list[Block]]:
    """A filter of each state, or of a position and its velocity: the models to choose from.

    Raises
    ------
    ValueError
        If `velocities` or `append` do not fit the states.
    """
    pairs = dict(velocities or {})
    if pairs:
        used = known_states([*pairs, *pairs.values()], "velocities", state_names)
        outside = [name for name in used if name not in names]
        if outside:
            raise ValueError(f"velocities names {outside}, which states= leaves out: name both.")
    single = [name for name in names if name not in (*pairs, *pairs.values())]
    if isinstance(append, (bool, np.bool_)):
        append = single if append else []
    elif set(known_states(append, "append_velocities", state_names)) - set(single):
        raise ValueError(
            f"append_velocities = {list(append)}: velocities are estimated for states that are "
            f"smoothed and have none in velocities=: {single}."
        )
    choices = []
    for name in names:
        if name in pairs.values():
            continue
        measured = (name, pairs[name]) if name in pairs else (name,)
        appended = (f"d_{name}",) if name in append else ()
        choices.append(
            [
                Block(
                    columns=tuple(state_names.index(item) for item in measured),
                    motion=Kinematic(order, pair=name in pairs),
                    outputs=np.eye(len(measured) + len(appended), order + 1),
                    appended=appended,
                )
                for order in MODELS[model]
            ]
        )
    return choices


def state_space_block(
    model: StateSpaceModel, names: Sequence[str], state_names: Sequence[str]
) -> Block:
    """The one filter of a given model.

    Raises
    ------
    ValueError
        If its matrices do not fit together or not the states.
    """
    model.check(len(names))
    rows = [*np.asarray(model.H, dtype=np.float64), *model.outputs.values()]
    return Block(
        columns=tuple(state_names.index(name) for name in names),
        motion=model,
        outputs=np.array(rows, dtype=np.float64),
        appended=tuple(model.outputs),
    )


def check_process_noise(model: Any, process_noise: Any) -> None:
    """Refuse one number for models in different units.

    Raises
    ------
    ValueError
    """
    if isinstance(model, str) and model == "auto" and process_noise is not None:
        raise ValueError(
            "process_noise has other units for each model (unit^2 / time^3 for a velocity that "
            'drifts, unit^2 / time^5 for an acceleration), so it does not go with model="auto": '
            'choose "velocity" or "acceleration", or leave it out.'
        )


def given_noise(value: Any, parameter: str, names: Sequence[str]) -> dict[str, float]:
    """Noise by name, as far as it is given.

    Raises
    ------
    ValueError
        If a name is unknown, or a number is not positive.
    """
    if not isinstance(value, Mapping):
        return {} if value is None else dict.fromkeys(names, float(value))
    odd = [name for name in value if name not in names]
    if odd:
        raise ValueError(f"{parameter} names {odd}; it goes by {list(names)}.")
    for name, number in value.items():
        if not (isinstance(number, Real) and 0 < float(number) < np.inf):
            raise ValueError(f"{parameter}[{name!r}] = {number!r} must be positive and finite.")
    return {name: float(number) for name, number in value.items()}
