"""The models of Lambert et al. (2021) with the settings that the paper prints.

Where text, table and code of the paper disagree, the text or table is taken: two hidden layers
of 250 ReLU units, Adam at a constant rate, inputs and targets scaled as printed. Actions are
aligned with the transition they cause (the paper's code shifts them by one step).

For the LSTM the paper gives three learning rates: 0.1 in its text, 1e-3 in its table, 8e-4 in
most of its code. Here it is the table's, with the table's depth of 2 (one layer in the code) and
batches of one sequence; it says nothing of epochs, and 22 is what its code used. As there, it
learns the next state itself, not the change.
"""

from typing import Any

from sklearn.preprocessing import MinMaxScaler

from trajlearn.dynamics import (
    BlockScaler,
    DirectRewardGP,
    DirectRewardNN,
    LSTMRegressor,
    OneStepRegressor,
    TrajectoryRegressor,
)
from trajlearn.regressors import GPRegressor, MLPEnsembleRegressor
from trajlearn.trajectories import SubtrajectoryRelabeler

__all__ = ["MODELS", "model"]

#: Names that `model` takes.
MODELS = ("D", "P", "DE", "PE", "T", "TP", "TE", "TPE", "LSTM", "GP", "NN")

# 80 % of the paper's cap of 1e5 sub-trajectories: its split held out the rest
_MAX_ROWS = 80_000
# best of the paper's table of epochs for T; the others are from its code
_EPOCHS = {"T": 8, "one-step": 25, "LSTM": 22}


def model(
    name: str, *, policy: Any = None, reward: Any = None, random_state: Any = None, **settings: Any
) -> Any:
    """Estimator with the paper's settings.

    Parameters
    ----------
    name : {"D", "P", "DE", "PE", "T", "TP", "TE", "TPE", "LSTM", "GP", "NN"}
        D deterministic, P probabilistic, E ensemble of 5; T trajectory-based, LSTM recurrent,
        otherwise one-step; GP and NN predict the reward directly.
    policy : callable, optional
        For one-step and recurrent models: recompute actions in roll-outs.
    reward : callable, optional
        For GP and NN.
    random_state : int, RandomState or None
    **settings
        Further parameters of the estimator, nested names included.

    Returns
    -------
    TrajectoryRegressor, OneStepRegressor, LSTMRegressor, DirectRewardGP or DirectRewardNN

    Examples
    --------
    >>> from trajlearn import paper
    >>> paper.model("TPE").estimator.n_members
    5
    """
    if name not in MODELS:
        raise ValueError(f"no model {name!r} in the paper; choose from {', '.join(MODELS)}.")
    estimator: Any
    if name == "GP":
        learner = GPRegressor(kernel="matern52")
        estimator = DirectRewardGP(learner, reward=reward, random_state=random_state)
    elif name == "NN":
        learner = _network("D")
        estimator = DirectRewardNN(learner, reward=reward, random_state=random_state)
    elif name == "LSTM":
        estimator = LSTMRegressor(
            hidden_size=250,
            n_layers=2,
            learning_rate=1e-3,
            schedule="constant",
            batch_size=1,
            max_epochs=_EPOCHS["LSTM"],
            target="state",
            policy=policy,
            random_state=random_state,
        )
    elif name.startswith("T"):
        estimator = TrajectoryRegressor(
            _network(name),
            relabeler=SubtrajectoryRelabeler(max_rows=_MAX_ROWS),
            scaler=BlockScaler(horizon=MinMaxScaler((-1, 1))),
            baseline=None,
            fresh_batches=False,
            random_state=random_state,
        )
    else:
        estimator = OneStepRegressor(
            _network(name), policy=policy, propagation="tsinf", random_state=random_state
        )
    return estimator.set_params(**settings)


def _network(name: str) -> MLPEnsembleRegressor:
    trajectory, probabilistic = name.startswith("T"), "P" in name
    ensemble = name.endswith("E")
    one_step_rate = 2.5e-5 if probabilistic else 5e-5
    return MLPEnsembleRegressor(
        hidden_layer_sizes=(250, 250),
        activation="relu",
        n_members=5 if ensemble else 1,
        bootstrap="row" if ensemble else False,
        probabilistic=probabilistic,
        nll_beta=0.0,
        learning_rate=8e-4 if trajectory else one_step_rate,
        schedule="constant",
        batch_size=64 if trajectory else 32,
        max_epochs=_EPOCHS["T" if trajectory else "one-step"],
    )
