"""Promises about fitting: parameters, both doors, seeds, copies, files."""

import pickle
import tempfile
from pathlib import Path
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, clone
from sklearn.pipeline import Pipeline

from trajlearn._persistence import load
from trajlearn.testing._case import Case, NotApplicable, refused, require
from trajlearn.trajectories import TrajectoryDataset, as_dataset


def check_fit_returns_self_and_changes_no_parameter(case: Case) -> None:
    """`fit` returns the estimator and leaves its parameters as they were given."""
    estimator = case.new(0)
    before, text = estimator.get_params(deep=False), repr(estimator)
    require(estimator.fit(case.train) is estimator, "fit returned something else.")
    after = estimator.get_params(deep=False)
    # a Pipeline copies the list of its steps
    changed = [
        name
        for name, value in before.items()
        if after[name] is not value and not (isinstance(value, list) and after[name] == value)
    ]
    require(not changed and repr(estimator) == text, f"changed: {changed or 'inside a parameter'}.")


def check_fit_refuses_targets_with_episodes(case: Case) -> None:
    """Episodes bring their own targets: `fit(episodes, y)` raises."""
    refused("fit(episodes, y)", case.new(0).fit, case.train, np.zeros(len(case.train)))


def check_seeds_decide_the_fit(case: Case) -> None:
    """The same `random_state` gives the same bits; another one, another fit if fits are random."""
    expected = case.fitted.predict(case.test)
    again = case.new(0).fit(case.train).predict(case.test)
    case.require_same(again, expected, "the same seed, fitted twice")
    first, second, other = (
        np.asarray(case.new(seed).fit(case.train).predict(case.test)) for seed in (None, None, 1)
    )
    if not np.array_equal(first, second, equal_nan=True):
        differ = not np.array_equal(other, np.asarray(expected), equal_nan=True)
        require(differ, "random_state=0 and 1 give the same fit, though fits are random.")


def check_fit_takes_a_list_of_trajectories(case: Case) -> None:
    """A list of `Trajectory` is as good as a dataset, in `fit` and in `predict`."""
    if isinstance(case.estimator, Pipeline):
        raise NotApplicable
    names = {"state_names": case.train.state_names}
    fitted = case.new(0).fit(list(TrajectoryDataset.from_list(case.train, **names)))
    case.require_same(
        fitted.predict(list(case.test)), case.fitted.predict(case.test), "list against dataset"
    )


def check_fit_forgets_the_last_fit(case: Case) -> None:
    """Fitting again gives what a new estimator gives (unless `warm_start` is asked for)."""
    if case.estimator.get_params().get("warm_start"):
        raise NotApplicable
    again = case.new(0).fit(case.train[:12]).fit(case.train)
    case.require_same(
        again.predict(case.test), case.fitted.predict(case.test), "fitted twice against once"
    )


def check_clone_is_unfitted_and_fits_the_same(case: Case) -> None:
    """`clone` of a fitted estimator is unfitted, and fits to the same bits."""
    copy = clone(case.fitted)
    learned = [name for name in vars(copy) if name.endswith("_") and not name.startswith("_")]
    require(not learned, f"the clone has the fitted attributes {learned}.")
    case.require_same(
        copy.fit(case.train).predict(case.test), case.fitted.predict(case.test), "clone, fitted"
    )


def check_pickle_keeps_the_bits(case: Case) -> None:
    """A pickled estimator predicts the same bits."""
    copy = pickle.loads(pickle.dumps(case.fitted))
    case.require_same(copy.predict(case.test), case.fitted.predict(case.test), "pickled")


def check_save_keeps_the_bits_or_names_joblib(case: Case) -> None:
    """`save` and `load` keep the bits; what cannot be stored safely raises, naming joblib."""
    if not hasattr(case.fitted, "save"):
        raise NotApplicable
    functions = {
        function.__name__: function
        for function in case.estimator.get_params().values()
        if callable(function) and hasattr(function, "__name__")
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        try:
            case.fitted.save(path)
        except TypeError as error:
            require("joblib" in str(error), f"the message names no way out: {error}")
            require(not list(Path(folder).iterdir()), "a refused save leaves a file behind.")
            return
        copy = load(path, callables=functions)
    case.require_same(copy.predict(case.test), case.fitted.predict(case.test), "saved and loaded")


def check_rows_and_episodes_agree(case: Case) -> None:
    """`predict` of a relabelled row is the forecast of the episode, to 1e-5 of the range."""
    layout = getattr(case.fitted, "layout_", None)
    if layout is None:
        raise NotApplicable
    for fitted, ds in case.trained:
        for episode in ds:
            found = fitted.predict(_rows(fitted.layout_, episode, steps=4))
            expected = np.asarray(fitted.predict([episode]))
            expected = expected[0, :4] if case.forecasts else expected
            count = len(expected) if "horizon" in layout else 1
            gap = np.abs(found[:count] - expected[:count]).max()
            require(gap <= 1e-5 * case.range, f"rows and episode {episode.id} differ by {gap:g}.")


def _rows(layout: Any, episode: Any, *, steps: int) -> np.ndarray:
    """Rows at the first state: one a horizon (the same row again for other models)."""
    blocks = {
        "state": episode.states[0],
        "params": episode.params,
        "action": episode.actions[0],
        "dt": episode.times[1:2] - episode.times[:1],
    }
    horizons = episode.times[1 : steps + 1] - episode.times[0]
    unknown = set(layout) - set(blocks) - {"horizon"}
    if unknown:
        raise NotApplicable
    return np.stack(
        [np.concatenate([(blocks | {"horizon": [h]})[name] for name in layout]) for h in horizons]
    )


class _Identity(BaseEstimator):
    """A dataset transformer that changes nothing."""

    def fit(self, X: TrajectoryDataset, y: None = None) -> Self:
        """Learn nothing."""
        self.n_features_in_ = as_dataset(X).states.shape[1]
        return self

    def transform(self, X: TrajectoryDataset) -> TrajectoryDataset:
        """Return the episodes."""
        return as_dataset(X)

    def set_output(self, *, transform: Any = None) -> Self:
        """Datasets stay datasets."""
        return self


def check_pipeline_passes_keywords(case: Case) -> None:
    """Behind a dataset transformer in a `Pipeline`, `predict` takes the same keywords."""
    pipeline = Pipeline([("same", _Identity()), ("model", case.new(0))]).fit(case.train)
    settings = {"start": 1, "horizon": 3} if case.forecasts else {}
    case.require_same(
        pipeline.predict(case.test, **settings),
        case.fitted.predict(case.test, **settings),
        f"pipeline.predict(ds, {settings})",
    )
