"""Trajectory models as torch functions: the derivative of a prediction in theta."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.pipeline import Pipeline
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from trajlearn.dynamics._members import inside
from trajlearn.dynamics._planned import by_episode, planned
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.dynamics.trajectory import TrajectoryRegressor
from trajlearn.regressors._device import find_device
from trajlearn.regressors.mlp import MLPEnsembleRegressor

__all__ = ["DifferentiableTrajectory", "differentiable"]

Floats = NDArray[np.float64]

_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": torch.nn.functional.relu,
    "silu": torch.nn.functional.silu,
    "tanh": torch.tanh,
}


def differentiable(
    model: Any,
    *,
    context: Mapping[str, Any] | None = None,
    dtype: torch.dtype = torch.float32,
) -> "DifferentiableTrajectory":
    """Write a fitted trajectory model as a torch function.

    A trajectory model is a network from theta to the state after a horizon, so that it has an
    exact derivative in theta; nothing is rolled out.

    Parameters
    ----------
    model : TrajectoryRegressor, or CalibratedForecaster or search over settings of one
        Fitted, with an `MLPEnsembleRegressor` under a `BlockScaler`, relative to the start state
        or to nothing.
    context : mapping from name to value, optional
        Context of all predictions, where the model was fitted with one.
    dtype : torch dtype, default=torch.float32
        What the network computes in; inputs and outputs are float64.

    Returns
    -------
    DifferentiableTrajectory
        ``function(initial_states (n, d_s), params (n, p), horizons (k,)) -> (E, n, k, d_s)``,
        the means of the members, on the device of the learner.

    Raises
    ------
    ValueError
        If the model, or a part of it, has no such derivative; it says which.

    Examples
    --------
    >>> import numpy as np
    >>> import torch
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> from trajlearn.dynamics import differentiable
    >>> rate = np.linspace(0.5, 1.5, 20)  # s' = -theta s, from s_0 = 1
    >>> states = np.exp(-rate[:, None] * 0.1 * np.arange(31))[..., None]
    >>> ds = TrajectoryDataset.from_arrays(states, params=rate[:, None], dt=0.1)
    >>> model = TrajectoryRegressor(random_state=0).set_params(estimator__max_steps=300).fit(ds)
    >>> theta = torch.tensor([[1.0]], dtype=torch.float64, requires_grad=True)
    >>> function = differentiable(model)
    >>> end = function([[1.0]], theta, [1.0]).sum()
    >>> end.backward()
    >>> bool(abs(theta.grad.item() + np.exp(-1.0)) < 0.05)  # d exp(-theta) / d theta
    True
    """
    return DifferentiableTrajectory(_trajectory_model(model), context or {}, dtype)


class DifferentiableTrajectory:
    """Means of a fitted trajectory model in torch, see `differentiable`.

    Parameters
    ----------
    model : TrajectoryRegressor
    context : mapping from name to value
    dtype : torch dtype
    """

    def __init__(
        self, model: TrajectoryRegressor, context: Mapping[str, Any], dtype: torch.dtype
    ) -> None:
        learner, scaler = model.estimator_, model.scaler_
        self._model, self._dtype = model, dtype
        self.device = find_device(learner.device)
        self.n_members: int = len(learner.coefs_[0])
        self.n_states: int = len(model.target_scale_)
        self.n_params = len(model.layout_.columns["params"])
        columns, scale, shift = _affine_inputs(model)
        self._left = torch.as_tensor(columns, device=self.device)
        self._scale, self._shift = self._constant(scale), self._constant(shift)
        self._context = self._constant(np.empty((1, 0)))
        if "context" in model.layout_:
            self._context = self._constant(_context_row(model, context))
        at_horizon = scaler.block_columns_["horizon"]
        others = np.setdiff1d(np.arange(learner.n_features_in_), at_horizon)
        weights = [torch.as_tensor(w, device=self.device).to(dtype) for w in learner.coefs_]
        self._first = weights[0][:, others], weights[0][:, at_horizon]
        self._weights = weights[1:]
        self._biases = [
            torch.as_tensor(b, device=self.device).to(dtype) for b in learner.intercepts_
        ]
        self._activation = _ACTIVATIONS[learner.activation]
        # targets of the learner are standardised, and the learner's are those of the model
        self._unit = self._constant(learner.target_scale_)
        self._offset = self._constant(learner.target_mean_)

    def __call__(
        self, initial_states: ArrayLike | Tensor, params: ArrayLike | Tensor, horizons: ArrayLike
    ) -> Tensor:
        """Predict, with derivatives in states and params.

        Parameters
        ----------
        initial_states : array-like or Tensor of shape (n, d_s)
        params : array-like or Tensor of shape (n, p)
        horizons : array-like of shape (k,)
            Times after the start.

        Returns
        -------
        Tensor of shape (E, n, k, d_s), float64
            Not cut off where a forecast would count as diverged.
        """
        states = self._rows(initial_states, self.n_states, "initial_states")
        theta = self._rows(params, self.n_params, "params")
        if len(states) != len(theta):
            raise ValueError(
                f"initial_states has {len(states)} rows, params {len(theta)}: give one state for "
                "each theta."
            )
        times = np.atleast_1d(np.asarray(horizons, dtype=np.float64))
        right, gate = self._at_horizons(times)
        left = self._inputs(states, theta)
        # the first layer of starts and of horizons apart: it is linear, and each has few rows
        hidden = (left @ self._first[0])[:, :, None] + (right @ self._first[1])[:, None]
        z = (hidden + self._biases[0][:, None]).flatten(1, 2)
        for weight, bias in zip(self._weights, self._biases[1:]):
            z = torch.baddbmm(bias, self._activation(z), weight)
        outputs = z[..., : self.n_states].to(torch.float64) * self._unit + self._offset
        outputs = outputs.unflatten(1, (len(states), len(times)))
        scale = gate * self._constant(self._model.target_scale_)
        means = scale * outputs
        return means + states[:, None] if self._model._anchored else means

    def _at_horizons(self, times: Floats) -> tuple[Tensor, Tensor]:
        """Scaled inputs of the horizons (k, width), and the gate at each (k, 1)."""
        model = self._model
        rows = np.zeros((len(times), model.layout_.width))
        rows[:, model.layout_["horizon"]] = times[:, None]
        scaled = model._scaled(rows)[:, model.scaler_.block_columns_["horizon"]]
        return self._constant(scaled).to(self._dtype), self._constant(model._gate(rows))

    def _inputs(self, states: Tensor, theta: Tensor) -> Tensor:
        """Scaled inputs of starts (n, width), without the horizon's."""
        n = len(states)
        blocks = {
            "state": states,
            "horizon": states.new_zeros((n, 1)),
            "params": theta,
            "context": self._context.expand(n, -1),
        }
        rows = torch.cat([blocks[name] for name in self._model.layout_], dim=1)
        return (rows[:, self._left] * self._scale + self._shift).to(self._dtype)

    def _rows(self, values: ArrayLike | Tensor, width: int, name: str) -> Tensor:
        rows = torch.as_tensor(
            values if isinstance(values, Tensor) else np.asarray(values, dtype=np.float64)
        ).to(device=self.device, dtype=torch.float64)
        if rows.ndim != 2 or rows.shape[1] != width:
            raise ValueError(f"{name} has shape {tuple(rows.shape)}; expected (n, {width}).")
        return rows

    def _constant(self, values: Floats) -> Tensor:
        return torch.as_tensor(np.asarray(values, dtype=np.float64), device=self.device)


def _trajectory_model(model: Any) -> TrajectoryRegressor:
    """The trajectory model that predicts the means of `model`, if all of it has a derivative."""
    check_is_fitted(model)
    inner = model
    # what leaves the means as they are; a Pipeline may not
    while not isinstance(inner, Pipeline) and (within := inside(inner)) is not None:
        inner = within
    if not isinstance(inner, TrajectoryRegressor):
        raise _no_derivative(f"{type(inner).__name__} is no TrajectoryRegressor")
    if not isinstance(inner.estimator_, MLPEnsembleRegressor):
        raise _no_derivative(
            f"its learner is {type(inner.estimator_).__name__}, not MLPEnsembleRegressor"
        )
    if not isinstance(inner.scaler_, BlockScaler):
        raise _no_derivative(f"scaler={type(inner.scaler_).__name__} is no BlockScaler")
    if inner.scaler_.features is not None:
        raise _no_derivative("features= of its scaler is a function of numpy arrays")
    if inner.baseline_ is not None:
        raise _no_derivative(f"it predicts relative to baseline={inner.baseline!r}")
    if blocks := {"references", "phase"} & set(inner.layout_):
        raise _no_derivative(f"it has {' and '.join(sorted(blocks))} among its inputs")
    if "params" not in inner.layout_:
        raise _no_derivative("it was fitted without params")
    return inner


def _affine_inputs(model: TrajectoryRegressor) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Columns of a row but the horizon's, in the order of the scaled row, and scale and shift."""
    own = model.layout_["horizon"].start
    columns, scales, shifts = [], [], []
    for of_part, transformer in model.scaler_.parts_:
        if own in of_part:
            continue
        found = model.scaler_.affine_part(of_part, transformer)
        if found is None:
            raise _no_derivative(
                f"its scaler has a {type(transformer).__name__}, which is not linear"
            )
        columns.append(of_part)
        scales.append(found[0])
        shifts.append(found[1])
    return np.concatenate(columns), np.concatenate(scales), np.concatenate(shifts)


def _context_row(model: TrajectoryRegressor, context: Mapping[str, Any]) -> Floats:
    """One-hot context (1, n_categories)."""
    ds = planned(
        np.zeros((1, len(model.target_scale_))),
        np.zeros(1),
        params=None,
        actions=None,
        references=None,
        context={key: by_episode(value, 1, key) for key, value in context.items()},
        phase=np.full(1, np.nan),
        state_names=model.state_names_,
    )
    row: Floats = model.relabeler_.context_rows(ds)
    return row


def _no_derivative(reason: str) -> ValueError:
    return ValueError(
        f"the model has no derivative in theta here: {reason}. Search without gradients "
        "(optimizer='cma')."
    )
