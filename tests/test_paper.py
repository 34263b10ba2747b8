"""The paper's settings by name."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.preprocessing import MinMaxScaler

from trajlearn import (
    Cartpole,
    DirectRewardGP,
    DirectRewardNN,
    LSTMRegressor,
    OneStepRegressor,
    TrajectoryRegressor,
    paper,
)

CLASSES = {
    "GP": DirectRewardGP,
    "LSTM": LSTMRegressor,
    "NN": DirectRewardNN,
    **dict.fromkeys(("D", "P", "DE", "PE"), OneStepRegressor),
    **dict.fromkeys(("T", "TP", "TE", "TPE"), TrajectoryRegressor),
}


@pytest.mark.parametrize("name", paper.MODELS)
def test_every_model_has_the_printed_settings(name):
    model = paper.model(name, random_state=0)
    assert type(model) is CLASSES[name]
    clone(model)
    if name in ("GP", "LSTM"):
        return
    learner = model.estimator
    assert tuple(learner.hidden_layer_sizes) == (250, 250)
    assert learner.activation == "relu"
    assert learner.schedule == "constant"
    assert learner.probabilistic == ("P" in name)
    assert learner.n_members == (5 if name.endswith("E") else 1)
    assert learner.batch_size == (64 if name.startswith("T") else 32)
    rate = 8e-4 if name.startswith("T") else 2.5e-5 if "P" in name else 5e-5
    assert learner.learning_rate == rate


def test_the_lstm_has_the_settings_of_the_table():
    model = paper.model("LSTM")
    assert (model.n_layers, model.hidden_size) == (2, 250)
    assert (model.learning_rate, model.schedule) == (1e-3, "constant")
    assert model.batch_size == 1
    assert model.max_epochs == 22
    assert model.target == "state"
    assert not model.probabilistic


def test_t_is_absolute_with_a_scaled_horizon():
    model = paper.model("T")
    assert model.baseline is None
    assert isinstance(model.scaler.horizon, MinMaxScaler)
    assert model.relabeler.starts == model.relabeler.horizons == "uniform"


@pytest.mark.parametrize("name", ["D", "TP", "LSTM", "NN", "GP"])
def test_models_fit_and_predict(name):
    env = Cartpole(redraw_terminated=True)
    ds = env.collect(4, 20, random_state=0)
    model = paper.model(name, policy=env.policy, reward=env.reward, random_state=0)
    if name == "LSTM":
        model.set_params(max_epochs=1, hidden_size=8)
    elif name != "GP":
        model.set_params(estimator__max_epochs=1, estimator__hidden_layer_sizes=(8,))
    predicted = np.asarray(model.fit(ds).predict(ds))
    assert predicted.shape == ((4,) if name in ("NN", "GP") else (4, 20, 4))
    assert np.isfinite(predicted).all()


def test_the_policy_is_used_and_settings_pass_through():
    env = Cartpole()
    model = paper.model("PE", policy=env.policy, estimator__max_epochs=3, clip_states=2.0)
    assert model.policy == env.policy
    assert model.estimator.max_epochs == 3
    assert model.clip_states == 2.0


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"no model 'X'.*TPE"):
        paper.model("X")
