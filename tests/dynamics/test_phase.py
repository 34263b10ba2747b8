"""Features of the phase."""

import numpy as np
import pytest
from sklearn.utils.estimator_checks import check_estimator

from trajlearn import BlockScaler, PhaseFeatures


def test_columns_are_the_scaled_phase_and_waves_of_the_period():
    x = np.linspace(-1.0, 3.0, 9)[:, None]
    features = PhaseFeatures(n_harmonics=2).fit_transform(x)
    period = 1.25 * 4
    angle = 2 * np.pi * (x[:, 0] + 1) / period
    expected = [
        (x[:, 0] - 1) / 2, np.sin(angle), np.cos(angle), np.sin(2 * angle), np.cos(2 * angle)
    ]  # fmt: skip
    np.testing.assert_allclose(features, np.transpose(expected), atol=1e-12)


def test_the_end_of_a_motion_does_not_look_like_its_beginning():
    features = PhaseFeatures().fit(np.array([[0.0], [7.0]])).transform(np.array([[0.0], [7.0]]))
    assert np.abs(features[0, 1:] - features[1, 1:]).max() > 0.5


def test_one_phase_only_and_no_harmonics():
    assert np.isfinite(PhaseFeatures().fit_transform(np.ones((3, 1)))).all()
    assert PhaseFeatures(n_harmonics=0).fit_transform(np.arange(3.0)[:, None]).shape == (3, 1)
    with pytest.raises(ValueError, match="n_harmonics"):
        PhaseFeatures(n_harmonics=-1).fit(np.ones((3, 1)))


def test_it_is_a_transformer_of_scikit_learn():
    check_estimator(PhaseFeatures())


def test_the_slot_of_the_block_scaler():
    rows = np.linspace(0, 1, 6).reshape(3, 2)
    layout = {"state": slice(0, 1), "phase": slice(1, 2)}
    scaler = BlockScaler(phase=PhaseFeatures(n_harmonics=3)).fit(rows, layout=layout)
    out = scaler.transform(rows)
    assert out.shape == (3, 8)
    np.testing.assert_allclose(out[:, 1:], PhaseFeatures(n_harmonics=3).fit_transform(rows[:, 1:]))
