"""Saved estimators: the same bits again, nothing executed, nothing guessed."""

import json
import struct

import numpy as np
import pytest
from safetensors.numpy import save_file
from sklearn.base import clone
from sklearn.ensemble import RandomForestRegressor
from sklearn.linear_model import Lasso
from sklearn.preprocessing import (
    FunctionTransformer,
    MaxAbsScaler,
    MinMaxScaler,
    RobustScaler,
    StandardScaler,
)

from tests.dynamics.systems import SMALL, gain_policy, linear
from trajlearn import (
    PID,
    BlockScaler,
    DirectRewardGP,
    DirectRewardNN,
    GPRegressor,
    HoldForecaster,
    LinearFeedback,
    MLPEnsembleRegressor,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryDataset,
    TrajectoryRegressor,
    TransitionRelabeler,
    load,
)
from trajlearn._persistence import save
from trajlearn.dynamics.calibrated import CalibratedForecaster
from trajlearn.exceptions import UnknownFileError


def squared(states):
    return -(states[..., 0] ** 2)


def squares(states, params):
    return states**2


def t(**settings):
    return TrajectoryRegressor(random_state=0).set_params(**SMALL | settings)


def d(**settings):
    return OneStepRegressor(random_state=0).set_params(**SMALL | settings)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.safetensors"


@pytest.fixture(scope="module")
def ds():
    return linear(8, shortest=6, longest=6, context={"task": ["a", "b"] * 4})


MODELS = [
    t(),
    t(estimator__n_members=3, estimator__probabilistic=True),
    t(scaler__horizon=MinMaxScaler((-1, 1)), baseline=None, fresh_batches=False),
    t(relabeler=SubtrajectoryRelabeler(max_rows=50, inputs=("state", "horizon", "context"))),
    t(scaler__state=RobustScaler(), scaler__params="passthrough"),
    t(scaler=StandardScaler()),
    TrajectoryRegressor(
        GPRegressor(n_restarts=0), relabeler=SubtrajectoryRelabeler(max_rows=40), random_state=0
    ),
    d(policy=LinearFeedback(bounds=(-2.0, 2.0))),
    d(scaler__action=MaxAbsScaler(), scaler__state=FunctionTransformer()),
    d(inputs=("action", "params", "dt"), clip_states=2.0, propagation="ts1"),
    DirectRewardGP(GPRegressor(n_restarts=0), reward=squared, random_state=0),
    DirectRewardNN(reward=squared, random_state=0).set_params(**SMALL),
    CalibratedForecaster(t(), cv=0.5, random_state=0),
    CalibratedForecaster(band="simultaneous", cv=2, random_state=0).set_params(
        **{f"estimator__{name}": value for name, value in SMALL.items()}
    ),
    CalibratedForecaster(HoldForecaster(), method="variance", cv=0.5, random_state=0),
]


@pytest.mark.parametrize("model", MODELS, ids=range(len(MODELS)))
def test_every_estimator_comes_back_with_the_same_bits(model, ds, path):
    model.fit(ds).save(path)
    again = load(path, callables={"squared": squared})
    assert type(again) is type(model)
    assert repr(again.get_params()) == repr(model.get_params())
    np.testing.assert_array_equal(np.asarray(again.predict(ds)), np.asarray(model.predict(ds)))
    if hasattr(model, "forecast"):
        first, second = (
            m.predict(ds, return_std=True, n_samples=3, random_state=1) for m in (model, again)
        )
        np.testing.assert_array_equal(first.std, second.std)
        np.testing.assert_array_equal(first.samples, second.samples)
        assert first.state_names == second.state_names
    # what was loaded goes on working as an estimator
    assert np.isfinite(again.fit(ds).score(ds))
    again.save(path)


def test_a_pid_comes_back_with_its_settings(path):
    rng = np.random.default_rng(0)
    joints = TrajectoryDataset.from_arrays(
        rng.normal(size=(2, 6, 3)),
        actions=rng.normal(size=(2, 5, 1)),
        params=rng.normal(size=(2, 3)),
    )
    model = d(policy=PID("cos", p_scale=3.0)).fit(joints)
    model.save(path)
    again = load(path)
    assert again.policy == PID("cos", p_scale=3.0)
    np.testing.assert_array_equal(np.asarray(again.predict(joints)), model.predict(joints))


def test_estimators_fitted_on_rows(path):
    rows = np.random.default_rng(0).normal(size=(20, 4))
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(rows, columns=["s", "h", "k", "l"])
    for model in (t(), d(), DirectRewardNN(random_state=0).set_params(**SMALL)):
        model.fit(frame, rows[:, 0]).save(path)
        again = load(path)
        np.testing.assert_array_equal(again.predict(frame), model.predict(frame))
        assert again.feature_names_in_.tolist() == ["s", "h", "k", "l"]


@pytest.mark.parametrize(
    "learner", [GPRegressor(n_restarts=0), MLPEnsembleRegressor(max_steps=5, n_members=2)]
)
def test_learners_by_themselves(learner, path):
    X = np.random.default_rng(0).normal(size=(15, 2))
    save(learner.fit(X, X[:, 0]), path)
    mean, std = load(path).predict(X, return_std=True)
    np.testing.assert_array_equal(mean, learner.predict(X))
    np.testing.assert_array_equal(std, learner.predict(X, return_std=True)[1])


def test_training_goes_on_from_where_it_was(path):
    X = np.random.default_rng(0).normal(size=(300, 2))
    model = MLPEnsembleRegressor(hidden_layer_sizes=(8,), batch_size=50, random_state=0)
    save(model.partial_fit(X, X[:, 0]), path)
    again = load(path)
    for one in (model, again):
        one.partial_fit(X, X[:, 0])
    np.testing.assert_array_equal(again.predict(X), model.predict(X))


def test_numbers_keep_their_kind(ds, path):
    model = t(gate=0.1 + 0.2, estimator__max_steps=np.int64(7), random_state=np.int32(3))
    model.fit(ds).save(path)
    again = load(path)
    assert again.gate == 0.1 + 0.2
    assert isinstance(again.estimator.max_steps, np.integer)
    assert again.estimator.max_steps == 7
    assert again.estimator.hidden_layer_sizes == (16,)
    assert again.random_state == 3
    assert d(random_state=None).fit(ds).save(path) is None
    assert load(path).random_state is None


def test_functions_are_stored_by_name_and_given_again(ds, path):
    model = d(policy=gain_policy).fit(ds)
    model.save(path)
    assert b"gain_policy" in path.read_bytes()
    with pytest.raises(ValueError, match=r"callables=\{'gain_policy': \.\.\.\}"):
        load(path)
    again = load(path, callables={"gain_policy": gain_policy})
    assert again.predict(ds).actions == "policy"
    np.testing.assert_array_equal(again.predict(ds).mean, model.predict(ds).mean)


def test_bounds_that_are_an_array_survive(ds, path):
    bounds = np.array([[-1.0, 2.0], [-3.0, 4.0]])
    model = clone(t(scaler__param_bounds=bounds)).fit(ds)
    model.save(path)
    again = load(path)
    np.testing.assert_array_equal(again.scaler.param_bounds, bounds)
    np.testing.assert_array_equal(again.predict(ds).mean, model.predict(ds).mean)
    assert not np.array_equal(again.predict(ds).mean, t().fit(ds).predict(ds).mean)
    np.testing.assert_array_equal(clone(again).fit(ds).predict(ds).mean, model.predict(ds).mean)


def test_features_are_stored_by_name_and_given_again(ds, path):
    model = t(scaler__features=squares).fit(ds)
    model.save(path)
    with pytest.raises(ValueError, match=r"callables=\{'squares': \.\.\.\}"):
        load(path)
    again = load(path, callables={"squares": squares})
    assert again.scaler.features is squares
    np.testing.assert_array_equal(again.predict(ds).mean, model.predict(ds).mean)
    assert not np.array_equal(again.predict(ds).mean, t().fit(ds).predict(ds).mean)


def test_two_functions_of_one_name_are_told_apart(ds, path):
    def first(states):
        return states[..., 0]

    first.__name__ = "squared"
    model = DirectRewardNN(
        reward=squared, scaler=BlockScaler(state=FunctionTransformer(first)), random_state=0
    ).set_params(**SMALL)
    with pytest.raises(ValueError, match="another function of the name 'squared'"):
        save(model, path)
    assert not path.exists()


@pytest.mark.parametrize("learner", [RandomForestRegressor(2), Lasso()])
def test_learners_of_others_are_refused_naming_joblib(learner, ds, path):
    model = TrajectoryRegressor(learner, relabeler=SubtrajectoryRelabeler(max_rows=50)).fit(ds)
    with pytest.raises(TypeError, match=r"(?s)cannot be stored.*joblib\.dump.*trust"):
        model.save(path)
    assert list(path.parent.iterdir()) == []


def test_a_class_that_borrows_a_known_name_is_refused(path):
    class StandardScaler:  # not scikit-learn's
        pass

    model = t(relabeler=TransitionRelabeler())
    model.scaler = StandardScaler()
    with pytest.raises(TypeError, match=r"TrajectoryRegressor\.scaler is a .*StandardScaler"):
        model.save(path)


def test_objects_inside_arrays_are_refused(path):
    model = t()
    model.extra_ = np.array([1, "a", None], dtype=object)
    with pytest.raises(TypeError, match=r"extra_ is a numpy\.ndarray"):
        model.save(path)


def test_a_failed_save_keeps_the_old_file(ds, path):
    t().fit(ds).save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        TrajectoryRegressor(Lasso()).fit(ds).save(path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


# -- files that are not what they should be -----------------------------------------------


def parts(path):
    """Header and tensors of a safetensors file."""
    raw = path.read_bytes()
    size = struct.unpack("<Q", raw[:8])[0]
    return json.loads(raw[8 : 8 + size]), raw[8 + size :]


def write(path, header, data):
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


@pytest.fixture
def saved(ds, path):
    t().fit(ds).save(path)
    return path


@pytest.mark.parametrize("keep", [0, 4, 100, 0.5, 0.999])
def test_a_truncated_file(saved, keep):
    raw = saved.read_bytes()
    saved.write_bytes(raw[: keep if isinstance(keep, int) else int(keep * len(raw))])
    with pytest.raises(UnknownFileError, match="truncated or changed"):
        load(saved)


def test_a_changed_weight(saved):
    raw = bytearray(saved.read_bytes())
    raw[-5] ^= 1
    saved.write_bytes(raw)
    with pytest.raises(UnknownFileError, match="digest does not match"):
        load(saved)


def change(saved, edit):
    header, data = parts(saved)
    inner = json.loads(header["__metadata__"]["trajlearn"])
    inner = edit(inner) or inner
    header["__metadata__"]["trajlearn"] = json.dumps(inner)
    write(saved, header, data)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda h: h.update(version=99), "format version 99, this trajlearn reads 1"),
        (lambda h: h.pop("version") and None, "format version None"),
        (lambda h: h.update(format="other"), "not a file of a saved estimator"),
        (lambda h: h.pop("digest") and None, "digest"),
        (lambda h: h.pop("tree") and None, "digest"),
        (lambda h: h["tree"].update(object="OneStepRegressor"), "digest"),
        (lambda h: ["a list"], "not a file of a saved estimator"),
    ],
)
def test_a_changed_header(saved, edit, message):
    change(saved, edit)
    with pytest.raises(UnknownFileError, match=message):
        load(saved)


@pytest.mark.parametrize(
    "content",
    [b"", b"hello", b"\x80\x04\x95 pickle", b"PK\x03\x04" + bytes(50)],
)
def test_a_foreign_file(path, content):
    path.write_bytes(content)
    with pytest.raises(UnknownFileError, match="not a file of a saved estimator"):
        load(path)


def test_safetensors_of_others(path):
    save_file({"weight": np.zeros(3)}, path)
    with pytest.raises(UnknownFileError, match="not a file of a saved estimator"):
        load(path)
    save_file({"weight": np.zeros(3)}, path, metadata={"trajlearn": "{not json"})
    with pytest.raises(UnknownFileError, match="not a file of a saved estimator"):
        load(path)


def test_a_missing_file(path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load(path)


def test_a_file_that_names_other_classes_runs_nothing(saved, tmp_path):
    # even with a digest that fits, only known classes are built
    from trajlearn import _persistence

    proof = tmp_path / "proof"
    for name in ("Popen", "os.system", "__import__", "MLPEnsembleRegressor.__init__"):
        tree = {"object": name, "state": {"dict": [["args", str(proof)]]}}
        header = {
            "format": _persistence.FORMAT,
            "version": _persistence.VERSION,
            "tree": tree,
            "digest": _persistence._digest(tree, {}),
        }
        save_file({"empty": np.zeros(1)}, saved, metadata={"trajlearn": json.dumps(header)})
        with pytest.raises(UnknownFileError, match="was changed"):
            load(saved)
    assert not proof.exists()
