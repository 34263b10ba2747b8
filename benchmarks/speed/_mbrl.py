"""An environment for mbrl-lib, whose pinned dependencies fit no other, and its trainer's times."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
ENVIRONMENT = ROOT / ".venv-mbrl"
# mbrl 0.2.0 pins releases of these that cannot be imported on Python 3.11
REPLACED = ("hydra-core==1.3.2", "omegaconf==2.3.0")


class InstallationError(RuntimeError):
    """An environment could not be made; the message names the log."""


def interpreter() -> Path:
    """Interpreter of the environment, made on first use and when the requirements change.

    Raises
    ------
    InstallationError
    """
    python = ENVIRONMENT / "bin" / "python"
    steps = _installation()
    marker = ENVIRONMENT / ".installed"
    if marker.is_file() and marker.read_text(encoding="utf-8") == repr(steps):
        return python
    print(f"Making {ENVIRONMENT.name} for mbrl-lib; this takes minutes once.", file=sys.stderr)
    subprocess.run([sys.executable, "-m", "venv", "--clear", ENVIRONMENT], check=True)
    log = ENVIRONMENT / "install.log"
    with log.open("w", encoding="utf-8") as out:
        for step in steps:
            command = [str(python), "-m", "pip", "install", "--no-input", "--prefer-binary", *step]
            done = subprocess.run(command, stdout=out, stderr=subprocess.STDOUT, check=False)
            if done.returncode:
                raise InstallationError(
                    f"mbrl-lib could not be installed (exit status {done.returncode}); see {log}."
                )
    marker.write_text(repr(steps), encoding="utf-8")
    return python


def run(
    python: Path, sizes: Sequence[int], effort: Mapping[str, Any]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Package versions of the environment, and rows as `measure` gives them."""
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(
        [python, "-m", "benchmarks.speed._mbrl_worker", json.dumps({"sizes": sizes, **effort})],
        cwd=ROOT,
        env=os.environ | one_thread,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    answer = json.loads(done.stdout.splitlines()[-1])
    return answer["packages"], answer["rows"]


def _installation() -> list[list[str]]:
    """Arguments of pip, call by call."""
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    same = [pin for pin in pins if pin.startswith(("torch==", "numpy=="))]
    # newer pips refuse the metadata of mbrl's dependencies
    return [["pip<24.1"], ["mbrl==0.2.0", *same], list(REPLACED)]
