"""Result files: what was run, with what, and the numbers; written whole or not at all."""

import json
import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd

import trajlearn

_PACKAGES = ("numpy", "scipy", "scikit-learn", "torch", "gpytorch", "control", "mujoco")


def provenance(mode: str, seeds: list[int], **settings: Any) -> dict[str, Any]:
    """Facts that a reader of a number needs: mode, seeds, settings, versions, commit."""
    return {
        "mode": mode,
        "seeds": seeds,
        "settings": settings,
        "python": platform.python_version(),
        "packages": {"trajlearn": trajlearn.__version__} | {n: version(n) for n in _PACKAGES},
        "commit": _commit(),
    }


def _commit() -> str | None:
    root = Path(__file__).parent
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None


def write_json(path: Path, payload: Any) -> None:
    """Write JSON atomically; numbers keep five significant digits, infinities become text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    part.write_text(json.dumps(plain(payload), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, path)


def read_json(path: Path) -> Any:
    """Read what `write_json` wrote; "inf", "-inf" and "nan" become numbers again."""
    return _numbers(json.loads(path.read_text(encoding="utf-8")))


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write a table atomically, without its index; numbers keep five significant digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    table.to_csv(part, index=False, float_format="%.5g", lineterminator="\n")
    os.replace(part, path)


def plain(value: Any) -> Any:
    """What JSON can hold: five significant digits, infinities as text, arrays as lists."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.5g}") if abs(value) < float("inf") else str(value)
    return value


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return float(value) if value in ("inf", "-inf", "nan") else value
