"""Nested parameter names that reach defaults, too."""

from abc import abstractmethod
from typing import Any, Self

from sklearn.base import BaseEstimator

__all__ = ["NestedDefaults"]


class NestedDefaults(BaseEstimator):
    """Estimator whose parameters may be None for a default with parameters of its own."""

    @abstractmethod
    def _defaults(self) -> dict[str, Any]:
        """Estimator that each parameter stands for if it is None."""

    def set_params(self, **params: Any) -> Self:
        """Set parameters; nested names such as ``estimator__max_steps`` reach the defaults too.

        Parameters
        ----------
        **params
            By name.

        Returns
        -------
        self
        """
        # first the estimator's own, which its defaults depend on
        own = {key: value for key, value in params.items() if "__" not in key}
        super().set_params(**own)
        nested = {key: value for key, value in params.items() if key not in own}
        replaceable = set(self._defaults()) & set(self.get_params(deep=False))
        for name in {key.partition("__")[0] for key in nested} & replaceable:
            if getattr(self, name) is None:
                setattr(self, name, self._defaults()[name])
        return super().set_params(**nested)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Get parameters.

        Parameters
        ----------
        deep : bool, default=True
            Also those of nested estimators, of the defaults too.

        Returns
        -------
        dict
        """
        params = super().get_params(deep=deep)
        if deep:
            for name, default in self._defaults().items():
                if name in params and params[name] is None:
                    own = default.get_params()
                    params |= {f"{name}__{key}": value for key, value in own.items()}
        return params
