"""Optional dependencies, with an error that names the extra to install."""

from importlib import import_module
from types import ModuleType

__all__ = ["import_extra"]


def import_extra(module: str, extra: str, *, by: str) -> ModuleType:
    """Import `module`, which the extra `extra` of the package installs.

    Raises
    ------
    ImportError
        If it is missing; the message says what to install.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{by} needs {module.partition('.')[0]}, which could not be imported ({error}). "
            f'Install it with: pip install "trajlearn[{extra}]"'
        ) from error
