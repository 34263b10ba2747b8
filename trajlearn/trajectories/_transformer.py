"""What transformers from dataset to dataset share."""

from typing import Any

from sklearn.base import BaseEstimator, TransformerMixin

__all__ = ["DatasetTransformer"]


class DatasetTransformer(TransformerMixin, BaseEstimator):
    """Transformer of episodes, for a `Pipeline` in front of a dynamics estimator."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        # a dataset is not to be wrapped in a DataFrame, whatever set_config(transform_output=) says
        super().__init_subclass__(auto_wrap_output_keys=None, **kwargs)
