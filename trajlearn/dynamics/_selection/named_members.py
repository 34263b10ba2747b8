"""Estimators under names, with nested parameters as in scikit-learn's ensembles."""

from typing import Any, Self

from sklearn.base import BaseEstimator, clone
from sklearn.frozen import FrozenEstimator

__all__ = ["NamedMembers", "checked_members", "with_policy"]


class NamedMembers(BaseEstimator):
    """Estimator with a parameter `estimators`, a list of (name, estimator) or None."""

    estimators: Any

    def _named(self) -> dict[str, Any]:
        """The members by name; none if what was given is not a list of pairs, which fit refuses."""
        given = self.estimators
        if not isinstance(given, (list, tuple)):
            return {}
        return {item[0]: item[1] for item in given if isinstance(item, tuple) and len(item) == 2}

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Get parameters.

        Parameters
        ----------
        deep : bool, default=True
            Also the members by their names, and their parameters as ``name__parameter``.

        Returns
        -------
        dict
        """
        params = super().get_params(deep=False)
        if deep:
            for name, member in self._named().items():
                params[name] = member
                if hasattr(member, "get_params"):
                    own = member.get_params(deep=True)
                    params |= {f"{name}__{key}": value for key, value in own.items()}
        return params

    def set_params(self, **params: Any) -> Self:
        """Set parameters, members by their names, and parameters of members.

        Parameters
        ----------
        **params
            ``name=estimator`` replaces a member, ``name="drop"`` leaves it out, and
            ``name__parameter=value`` sets a parameter of one.

        Returns
        -------
        self
        """
        if "estimators" in params:
            self.estimators = params.pop("estimators")
        named = self._named()
        replaced = {key: params.pop(key) for key in list(params) if key in named}
        if replaced:
            self.estimators = [(name, replaced.get(name, named[name])) for name in named]
        return super().set_params(**params)


def checked_members(estimators: Any, taken: set[str]) -> list[tuple[str, Any]]:
    """The members that are not dropped.

    Parameters
    ----------
    estimators : list of (str, estimator)
    taken : set of str
        Names that mean something else.

    Raises
    ------
    ValueError
        If names are missing, double or taken, or no member is left.
    TypeError
        If a member is no estimator.
    """
    pairs = list(estimators)
    if not all(isinstance(item, tuple) and len(item) == 2 for item in pairs):
        raise ValueError(
            "estimators must be a list of (name, estimator), such as "
            '[("T", TrajectoryRegressor()), ("D", OneStepRegressor())].'
        )
    names = [name for name, _ in pairs]
    for name in names:
        if not isinstance(name, str) or not name or "__" in name or name in taken:
            raise ValueError(
                f"estimators has the name {name!r}: a name is a text without '__' that is no "
                f"parameter of HorizonSelector ({', '.join(sorted(taken))})."
            )
    if len(set(names)) < len(names):
        raise ValueError(f"estimators has a name twice: {names}. Give each its own.")
    kept = [(name, member) for name, member in pairs if not isinstance(member, str)]
    if any(member != "drop" for _, member in pairs if isinstance(member, str)) or not kept:
        raise ValueError(
            "estimators needs one estimator or more under its names; 'drop' leaves one out."
        )
    for name, member in kept:
        if not (hasattr(member, "fit") and hasattr(member, "predict")):
            raise TypeError(
                f"estimators has {member!r} under the name {name!r}, which lacks fit or predict: "
                "give a dynamics estimator, or a Pipeline that ends in one."
            )
    return kept


def with_policy(member: Any, policy: Any) -> Any:
    """The member, with the policy wherever it has a parameter for one and none of its own."""
    if policy is None or isinstance(member, FrozenEstimator):
        return member
    params = member.get_params() if hasattr(member, "get_params") else {}
    lacking = [
        name
        for name, value in params.items()
        if name.rpartition("__")[2] == "policy" and value is None
    ]
    return clone(member).set_params(**dict.fromkeys(lacking, policy)) if lacking else member
