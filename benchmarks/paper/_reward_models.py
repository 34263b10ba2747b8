"""Models of the reward table, and the configurations that a tuned row chooses from."""

from typing import Any

from benchmarks.paper._models import build
from benchmarks.paper._symmetry import folded, mirrored
from benchmarks.paper._tasks import environment
from trajlearn import DirectRewardGP, DirectRewardNN, TrajectoryDataset, paper

Config = dict[str, Any]

#: Models from (s_0, theta) to the reward, without states in between.
DIRECT = {"GP": DirectRewardGP, "NN": DirectRewardNN}
# gradient steps of our dynamics networks in quick mode
QUICK_STEPS = 1000
# rows of learners whose time grows with the cube of rows (GP) or of features (polynomials)
MAX_ROWS = {
    "full": {
        ("cartpole", "T, GP"): 1200,
        ("reacher", "T, GP"): 500,
        ("reacher", "D, polynomial"): 10_000,
    },
    "quick": {
        ("cartpole", "T, GP"): 200,
        ("reacher", "T, GP"): 100,
        ("reacher", "D, polynomial"): 5_000,
    },
}


def _varied(name: str, *values: Any, **fixed: Any) -> list[Config]:
    return [{name: value} | fixed for value in values]


# what the constructors' nested parameters are called
_DECAY, _BATCH = "estimator__weight_decay", "estimator__batch_size"
_GP = _varied("estimator__kernel", "rbf", "matern52")
_NN = [
    {"estimator__activation": "tanh"},
    {"estimator__activation": "silu", "estimator__max_steps": 1000},
]
_RIDGE, _DEGREE = "estimator__ridge__alpha", "estimator__polynomialfeatures__degree"

#: Two settings for every model; each is tried with and without the mirror images.
SETTINGS: dict[str, dict[str, list[Config]]] = {
    "cartpole": {
        "GP": _GP,
        "NN": _NN,
        "D": _varied(_BATCH, 128, 256),
        "D, polynomial": _varied(_DEGREE, 3, 5, **{_RIDGE: 1e-3}),
        "C": _varied(_BATCH, 128, 256),
        "T": _varied("gate", 0.05, 0.2),
        "T, features": _varied("gate", 0.05, 0.2),
    },
    "reacher": {
        "GP": _GP,
        # standardised, first states that differ by 0.01 would be as large as the gains
        "NN": [config | {"scaler__state": "passthrough"} for config in _NN],
        "D": [{}, {"estimator__n_members": 5, _BATCH: 256}],
        # degree 3; predictions that leave the training range grow as its cube
        "D, polynomial": _varied(_RIDGE, 10.0, 100.0, clip_states=1.2),
        "C": [{_DECAY: 0.1}, {"estimator__n_members": 5}],
        "T": _varied(_DECAY, 0.0, 0.1),
        "T, features": _varied(_DECAY, 0.0, 0.1),
    },
}


def candidates(task: str, model: str) -> list[Config]:
    """Four configurations for every model: two settings, without and with the symmetry."""
    return [
        config | {"symmetry": symmetry}
        for symmetry in (False, True)
        for config in SETTINGS[task][model]
    ]


def make(task: str, model: str, settings: str, config: Config, mode: str, seed: int) -> Any:
    """Estimator with the paper's settings, or ours with a configuration (empty: the defaults)."""
    env = environment(task)
    if settings == "paper" and model in DIRECT:
        return paper.model(model, reward=env.reward, random_state=seed)
    if settings == "paper":
        return build(model, "paper", policy=env.policy, mode=mode, seed=seed)
    own: Config = {}
    if model in DIRECT:
        estimator: Any = DIRECT[model](reward=env.reward, random_state=seed)
    else:
        estimator = build(model, "default", policy=env.policy, mode=mode, seed=seed)
        if mode == "quick" and model in ("D", "C", "T", "T, features"):
            own["estimator__max_steps"] = QUICK_STEPS
        if (task, model) in MAX_ROWS[mode]:
            own["relabeler__max_rows"] = MAX_ROWS[mode][task, model]
    own |= {name: value for name, value in config.items() if name != "symmetry"}
    return estimator.set_params(**own)


def for_training(task: str, ds: TrajectoryDataset, model: str, config: Config) -> TrajectoryDataset:
    """Training episodes as a configuration wants them.

    The reward of the reacher's images differs from that of the episode, as the goal is not
    mirrored; a direct model computes it from the states.
    """
    if not config.get("symmetry"):
        return ds
    return folded(ds) if _folds(task, model) else mirrored(task, ds)


def for_prediction(
    task: str, ds: TrajectoryDataset, model: str, config: Config
) -> TrajectoryDataset:
    """Episodes to predict as a configuration wants them."""
    return folded(ds) if config.get("symmetry") and _folds(task, model) else ds


def _folds(task: str, model: str) -> bool:
    return task == "cartpole" and model in DIRECT
