"""What the commands share: options, one thread, the result file and the table."""

import argparse
import datetime
import os
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from threadpoolctl import threadpool_limits

from benchmarks._results import provenance, write_json
from benchmarks.speed._timing import spread

RESULTS = Path(__file__).parent / "results"

Row = dict[str, Any]
Columns = Mapping[str, Callable[[Row], str]]


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and every BLAS to one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)


def parser(name: str, about: str) -> argparse.ArgumentParser:
    """Options of every benchmark."""
    options = argparse.ArgumentParser(prog=f"python -m benchmarks.speed.{name}", description=about)
    options.add_argument("--quick", action="store_true", help="few rounds, for a first look")
    options.add_argument(
        "--out",
        type=Path,
        help="folder of the result files (default: this benchmark's results/; "
        f"results/speed/{name} in quick mode)",
    )
    return options


def command_line(
    name: str,
    about: str,
    run: Callable[..., dict[str, Any]],
    effort: Mapping[str, Any],
    columns: Columns,
    argv: Sequence[str] | None,
    *,
    flags: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """What every benchmark's `main` does: ``run(mode, effort[mode])``, the table, the files.

    `flags` are further options by name, with their help; `run` gets them as keyword arguments.
    """
    options = parser(name, about)
    for flag, text in flags.items():
        options.add_argument(f"--{flag}", action="store_true", help=text)
    given = options.parse_args(argv)
    mode = "quick" if given.quick else "full"
    asked = {flag: getattr(given, flag) for flag in flags}
    finish(name, run(mode, effort[mode], **asked), columns, given.out)


def result(name: str, mode: str, rows: list[Row], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Rows with everything a reader of the numbers needs to know."""
    now = datetime.datetime.now(datetime.UTC)
    return {
        "benchmark": f"benchmarks.speed.{name}",
        "date": now.isoformat(timespec="minutes"),
        **provenance(mode, [0], **settings),
        "cpu": _cpu(),
        "threads": 1,
        "clock": "CPU time of the process",
        "spread": spread(rows),
        "rows": rows,
    }


def finish(name: str, outcome: dict[str, Any], columns: Columns, out: Path | None) -> None:
    """Print the table and store it, with the raw numbers beside it."""
    mode = outcome["mode"]
    # a quick run never overwrites the results that the documentation quotes
    default = RESULTS / name if mode == "full" else Path("results") / "speed" / name
    folder = (out or default).resolve()
    text = _document(outcome, columns)
    print(text)
    write_json(folder / f"{mode}.json", outcome)
    (folder / f"{mode}.md").write_text(text + "\n", encoding="utf-8")
    print(f"Written to {folder} ({mode}.json, {mode}.md).")


def table(rows: Sequence[Row], columns: Columns) -> str:
    """Markdown table."""
    cells = [[show(row) for show in columns.values()] for row in rows]
    lines = [list(columns), ["---"] * len(columns), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def duration(seconds: float) -> str:
    """Seconds in a unit that suits them, three significant digits."""
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if seconds * factor >= 1:
            return f"{_three(seconds * factor)} {unit}"
    return f"{_three(seconds * 1e6)} us"


def times(ratio: float) -> str:
    """A ratio, three significant digits."""
    return f"{_three(ratio)}x"


def quartiles(row: Row) -> str:
    """Quartiles of the ratio."""
    low, high = row["ratio_quartiles"]
    return f"{_three(low)}-{_three(high)}"


def _three(number: float) -> str:
    return f"{number:.0f}" if number >= 99.95 else f"{number:#.3g}"


def _document(outcome: dict[str, Any], columns: Columns) -> str:
    packages = ", ".join(f"{name} {version}" for name, version in outcome["packages"].items())
    return "\n".join(
        [
            f"`python -m {outcome['benchmark']}`, {outcome['mode']} mode, {outcome['date']}, "
            f"commit {outcome['commit'] or 'none'}",
            "",
            table(outcome["rows"], columns),
            "",
            f"Medians of interleaved rounds, one thread, CPU time; typical spread of a ratio "
            f"(interquartile range) {100 * outcome['spread']:.0f} %.",
            f"{outcome['cpu']}; Python {outcome['python']}, {packages}.",
        ]
    )


def _cpu() -> str:
    """Model of the processor, number of cores and the instructions that torch uses."""
    model = platform.processor() or platform.machine()
    described = Path("/proc/cpuinfo")
    if described.is_file():
        lines = described.read_text(encoding="utf-8").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, {torch.backends.cpu.get_cpu_capability()}"
