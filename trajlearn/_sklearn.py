"""The few names of scikit-learn that are not public, imported in one place.

scikit-learn keeps its declarative parameter constraints in private modules; every
library of estimators needs them. When they move, this file is the one to change.
"""

from sklearn.base import _fit_context as fit_context
from sklearn.utils._param_validation import HasMethods, Interval, StrOptions

__all__ = ["HasMethods", "Interval", "StrOptions", "fit_context"]
