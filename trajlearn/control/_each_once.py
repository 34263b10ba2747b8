"""Warnings of many forecasts about one thing, said once."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["each_once"]


@contextmanager
def each_once() -> Iterator[None]:
    """Hold back warnings that are shown more than once, of equal words, inside."""
    with warnings.catch_warnings(record=True) as caught:
        try:
            yield
        finally:
            found = {(each.category, str(each.message)): each for each in caught}
    for each in found.values():
        warnings.warn_explicit(
            each.message, each.category, each.filename, each.lineno, source=each.source
        )
