"""Environments of their own for the peers, whose requirements do not fit ours."""

import subprocess
import sys
from pathlib import Path

from benchmarks.speed import _mbrl

ROOT = Path(__file__).parents[2]
_FOLDER = Path(__file__).parent


def requirements(peer: str) -> Path:
    """The file that says what a peer's environment holds."""
    return _FOLDER / f"requirements-{peer}.txt"


def interpreter(peer: str) -> Path:
    """Interpreter of the environment of "pysindy", "pykoop" or "mbrl", made where it is missing.

    Raises
    ------
    InstallationError
        The message names the log.
    """
    if peer == "mbrl":
        return _mbrl.interpreter()
    folder = ROOT / f".venv-{peer}"
    python, marker = folder / "bin" / "python", folder / ".installed"
    wanted = requirements(peer).read_text(encoding="utf-8")
    if marker.is_file() and marker.read_text(encoding="utf-8") == wanted:
        return python
    print(f"Making {folder.name}; this takes a minute or two, once.", file=sys.stderr)
    subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
    log = folder / "install.log"
    pip = [str(python), "-m", "pip", "install", "--no-input", "--prefer-binary"]
    with log.open("w", encoding="utf-8") as out:
        command = [*pip, "-r", str(requirements(peer))]
        done = subprocess.run(command, stdout=out, stderr=subprocess.STDOUT, check=False)
    if done.returncode:
        raise _mbrl.InstallationError(
            f"{peer} could not be installed (exit status {done.returncode}); see {log}."
        )
    marker.write_text(wanted, encoding="utf-8")
    return python
