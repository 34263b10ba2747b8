"""Fitted estimators as one safetensors file: arrays as tensors, all else as JSON in its header.

Loading builds only classes named in `_CLASSES`, never unpickles and never runs code from the
file. Callables are stored by name and have to be passed again.
"""

import contextlib
import hashlib
import importlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import UnknownFileError

__all__ = ["SaveMixin", "load", "save"]

FORMAT, VERSION = "trajlearn-estimator", 1
# safetensors wants at least one tensor
_EMPTY = "empty"

_CLASSES = {
    name: module
    for module, names in {
        "trajlearn.dynamics": (
            "BlockScaler",
            "DirectRewardGP",
            "DirectRewardNN",
            "HoldForecaster",
            "HorizonFeatures",
            "LSTMRegressor",
            "MeanEpisodeForecaster",
            "OneStepRegressor",
            "PhaseFeatures",
            "ReferenceForecaster",
            "TrajectoryRegressor",
        ),
        "trajlearn.dynamics._uncertainty.calibration": ("Rescaling",),
        "trajlearn.dynamics._uncertainty.conformal": ("ConformalBands",),
        "trajlearn.dynamics.calibrated": ("CalibratedForecaster",),
        "trajlearn.dynamics.distilled": ("DistilledForecaster",),
        "trajlearn.dynamics._rollouts.cloned_policy": ("ClonedPolicy",),
        "trajlearn.regressors.control_law": ("ControlLawRegressor",),
        "trajlearn.dynamics._denoising.noise": ("NoiseModel",),
        "trajlearn.dynamics._selection.held_out_noise": ("HeldOutNoise",),
        "trajlearn.dynamics._uncertainty.residual_paths": ("ResidualPaths",),
        "trajlearn.dynamics._sequence": ("SequenceLearner",),
        "trajlearn.dynamics.selector": ("HorizonSelector",),
        "trajlearn.regressors": ("GPRegressor", "MLPEnsembleRegressor"),
        "trajlearn.trajectories": (
            "EpisodeRelabeler",
            "SubtrajectoryRelabeler",
            "TrajectoryDataset",
            "TransitionRelabeler",
        ),
        "trajlearn.trajectories._columns": ("Columns",),
        "trajlearn.trajectories._layout": ("Layout",),
        "trajlearn.envs": ("AttitudePD",),
        "trajlearn.policies": ("LinearFeedback", "NetworkPolicy", "PID"),
        "sklearn.frozen": ("FrozenEstimator",),
        "sklearn.linear_model": ("LinearRegression", "Ridge"),
        "sklearn.pipeline": ("Pipeline",),
        "sklearn.preprocessing": (
            "FunctionTransformer",
            "MaxAbsScaler",
            "MinMaxScaler",
            "PolynomialFeatures",
            "RobustScaler",
            "StandardScaler",
        ),
        "sklearn.multioutput": ("MultiOutputRegressor",),
    }.items()
    for name in names
}


def save(estimator: Any, path: str | Path) -> None:
    """Write a fitted estimator, whole or not at all.

    Parameters
    ----------
    estimator : estimator of trajlearn
    path : str or Path
        Conventionally ``.safetensors``.

    Raises
    ------
    TypeError
        If it contains an object of a class that cannot be stored safely, such as a learner of
        another library.
    ValueError
        If it contains two functions of the same name.
    """
    from safetensors.numpy import save_file

    encoder = _Encoder()
    tree, arrays = encoder.encode(estimator, type(estimator).__name__), encoder.arrays
    header = json.dumps(
        {"format": FORMAT, "version": VERSION, "tree": tree, "digest": _digest(tree, arrays)}
    )
    temporary = Path(f"{path}.{os.getpid()}.part")
    try:
        save_file(arrays or {_EMPTY: np.zeros(1)}, temporary, metadata={"trajlearn": header})
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


def load(path: str | Path, *, callables: Mapping[str, Callable[..., Any]] | None = None) -> Any:
    """Read an estimator that `save` wrote; nothing in the file is executed.

    Parameters
    ----------
    path : str or Path
    callables : mapping from name to function, optional
        Policies, reward functions and features the estimator was built with, by their names.

    Returns
    -------
    The fitted estimator.

    Raises
    ------
    UnknownFileError
        If the file is truncated, changed, or of another kind.
    ValueError
        If a callable is missing.

    Examples
    --------
    >>> import tempfile, os
    >>> import numpy as np
    >>> from trajlearn import OneStepRegressor, TrajectoryDataset, load
    >>> ds = TrajectoryDataset.from_arrays(np.arange(8.0).reshape(1, 8, 1), params=[[1.0]])
    >>> model = OneStepRegressor(inputs="params", random_state=0).fit(ds)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "model.safetensors")
    ...     model.save(path)
    ...     again = load(path)
    >>> bool((np.asarray(again.predict(ds)) == np.asarray(model.predict(ds))).all())
    True
    """
    from safetensors import SafetensorError, safe_open

    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}.")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})["trajlearn"])
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        if header["format"] != FORMAT:
            raise KeyError(FORMAT)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UnknownFileError(
            f"{path} is not a file of a saved estimator, or it was truncated or changed ({error})."
        ) from error
    if header.get("version") != VERSION:
        raise UnknownFileError(
            f"{path} has format version {header.get('version')}, this trajlearn reads {VERSION}."
        )
    if header.get("digest") != _digest(header.get("tree"), arrays):
        raise UnknownFileError(f"{path} was changed after it was saved: its digest does not match.")
    try:
        return _decode(header["tree"], arrays, callables or {})
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise UnknownFileError(f"{path} was changed: {error!r}.") from error


class SaveMixin:
    """Adds `save` to an estimator."""

    def save(self, path: str | Path) -> None:
        """Write the fitted estimator to a safetensors file; `trajlearn.load` reads it back.

        Parameters
        ----------
        path : str or Path

        Raises
        ------
        TypeError
            If it contains an object that cannot be stored as plain arrays.
        """
        save(self, path)


def _digest(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256(json.dumps(tree, sort_keys=True).encode())
    for key in sorted(arrays):
        if key != _EMPTY:
            digest.update(f"{key}{arrays[key].dtype}{arrays[key].shape}".encode())
            digest.update(np.ascontiguousarray(arrays[key]).tobytes())
    return digest.hexdigest()


class _Encoder:
    """Turns objects into a tree for JSON, and collects their arrays and functions on the way."""

    def __init__(self) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self._functions: dict[str, Any] = {}

    def encode(self, value: Any, where: str) -> Any:
        """Tree of a value; `where` is its path from the estimator, for messages."""
        if value is None or isinstance(value, (bool, int, str)):
            return value
        if isinstance(value, float):
            return {"float": value.hex()}
        if isinstance(value, np.generic):
            return {"scalar": self.encode(np.asarray(value), where)}
        if isinstance(value, np.ndarray):
            if value.dtype.kind in "UO" and all(isinstance(item, str) for item in value.flat):
                return {"texts": value.tolist(), "dtype": value.dtype.kind}
            if value.dtype.kind in "biuf":
                key = f"{len(self.arrays)}:{where}"
                self.arrays[key] = np.asarray(value, order="C")
                return {"array": key}
        if isinstance(value, (list, tuple)):
            kind = "tuple" if isinstance(value, tuple) else "list"
            return {kind: [self.encode(item, f"{where}.{i}") for i, item in enumerate(value)]}
        if isinstance(value, dict):
            keys = [self.encode(key, where) for key in value]
            items = [self.encode(item, f"{where}.{key}") for key, item in value.items()]
            return {"dict": list(zip(keys, items))}
        if _CLASSES.get(type(value).__name__) and _known_class(value):
            state = {k: item for k, item in vars(value).items() if k != "_sklearn_output_config"}
            return {"object": type(value).__name__, "state": self.encode(state, where)}
        if callable(value) and hasattr(value, "__name__"):
            return {"callable": self._name(value, where)}
        raise TypeError(
            f"{where} is a {type(value).__module__}.{type(value).__qualname__}, which cannot be "
            "stored as plain arrays. Use joblib.dump(model, path) instead, and load such a file "
            "only if you trust where it comes from: unpickling runs code."
        )

    def _name(self, function: Any, where: str) -> str:
        name = str(function.__name__)
        if self._functions.setdefault(name, function) != function:
            raise ValueError(
                f"{where} is another function of the name {name!r}; functions are stored by name, "
                "so give each its own (def instead of lambda)."
            )
        return name


def _known_class(value: Any) -> bool:
    module = importlib.import_module(_CLASSES[type(value).__name__])
    return getattr(module, type(value).__name__, None) is type(value)


def _decode(tree: Any, arrays: Mapping[str, NDArray[Any]], callables: Mapping[str, Any]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "float" in tree:
        return float.fromhex(tree["float"])
    if "scalar" in tree:
        return _decode(tree["scalar"], arrays, callables)[()]
    if "texts" in tree:
        return np.array(tree["texts"], dtype=object if tree["dtype"] == "O" else np.str_)
    if "array" in tree:
        return arrays[tree["array"]]
    if "list" in tree or "tuple" in tree:
        values = tree["list"] if "list" in tree else tree["tuple"]
        items = [_decode(item, arrays, callables) for item in values]
        return tuple(items) if "tuple" in tree else items
    if "dict" in tree:
        pairs = tree["dict"]
        return {_decode(k, arrays, callables): _decode(v, arrays, callables) for k, v in pairs}
    if "callable" in tree:
        name = tree["callable"]
        if name not in callables:
            raise ValueError(
                f"the estimator was built with the function {name!r}, which is not stored: "
                f"load(path, callables={{{name!r}: ...}})."
            )
        return callables[name]
    cls = getattr(importlib.import_module(_CLASSES[tree["object"]]), tree["object"])
    instance = cls.__new__(cls)
    state = _decode(tree["state"], arrays, callables)
    if not isinstance(state, dict):
        raise TypeError("the state of an object must be a mapping")
    # frozen dataclasses refuse setattr
    vars(instance).update(state)
    return instance
