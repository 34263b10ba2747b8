"""Noise, unknown policies, few or partial logs: which formulation wins where?

Regimes of cartpole, reacher and simulated quadrotor (measurement noise of 1 to 30 %, process
noise, 5 to 100 episodes, velocities missing, slow logging, a controller that acts on noisy
states, periodic and unstable gains; the policy known or not) and folds of the real flights. Every
member of `HorizonSelector`, the selector itself, and other libraries on the same episodes with
the same metric: PySINDy, pykoop and mbrl-lib in environments of their own, scikit-learn's GP here.

Errors are against the true test states (real flights: the logged ones), forecasts start from the
logged first state, states are kept within 1.2 times their range (what n training episodes show of
it, times (n + 1) / (n - 1)), and actions are recomputed by the policy; where it is unknown,
members clone it and peers see theta instead.
Rules and settings were developed on seeds below 33, of which 10 is shown, and frozen before the
fresh ones 33, 34 and 35.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks._results import read_json
from benchmarks._sweep import Cell, _finished, _name
from benchmarks.paper._command import Benchmark, Run, Tables, _save_png, read_tables
from benchmarks.regimes import _floor, _members, _peers
from benchmarks.regimes._environments import interpreter
from benchmarks.regimes._episodes import FLIGHT_STEPS, N_TEST
from benchmarks.regimes._page import report
from benchmarks.regimes._pictures import apart, curves, who_wins, winners
from benchmarks.regimes._regimes import DEVELOPMENT, FRESH, QUICK, REGIMES, SYSTEMS
from benchmarks.regimes._tables import Found, tables

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = Path(__file__).parent / "results"
#: Seeds in the order in which they are run: fresh ones first.
SEEDS = (*FRESH, *DEVELOPMENT)
#: Regimes of mbrl-lib, which takes a minute or two a fit.
MBRL = ("clean", "noise 1 %", "noise 3 %", "noise 10 %", "process .02", "20 episodes, noise 3 %")


def cells(
    system: str, mode: str, seed: int, peers: list[str]
) -> tuple[list[Cell], list[Cell], list[Cell]]:
    """Cells of our forecasters, of the peers, and of the plant itself."""
    chosen = [
        regime
        for (of, name), regime in REGIMES.items()
        if of == system and (mode == "full" or name in QUICK)
    ]
    ours = [
        {"system": system, "regime": regime.name, "mode": mode, "seed": seed} for regime in chosen
    ]
    others = [
        {"system": system, "regime": regime.name, "policy": policy, "peer": peer}
        | {"mode": mode, "seed": seed}
        for peer in peers
        for regime in chosen
        for policy in regime.policies
        if peer != "mbrl-lib" or (policy == "known" and regime.name in MBRL)
    ]
    floors = [
        {"system": system, "regime": regime.name, "floor": _floor.NAME, "mode": mode, "seed": seed}
        for regime in chosen
        if _floor.has_floor(regime)
    ]
    return ours, others, floors


def run(run: Run, *, peers: list[str], compute: bool) -> Tables:
    """Tables of one system, from cells that are computed, or from those that are there."""
    assert run.task is not None  # a benchmark with tasks
    own, theirs, floors = Found(), Found(), Found()
    if compute:
        for environment in filter(None, (_peers.ENVIRONMENT[peer] for peer in peers)):
            interpreter(environment)
    # a run that is stopped has whole seeds
    for seed in run.seeds:
        ours, others, plants = cells(run.task, run.mode, seed, peers)
        for found, asked, function in (
            (floors, plants, _floor.cell),
            (own, ours, _members.cell),
            (theirs, others, _peers.cell),
        ):
            if compute:
                found += zip(asked, run.cells(asked, function), strict=True)
            else:
                found += stored(run, asked, function)
    if not own:
        raise SystemExit(f"There are no finished cells of {run.task}: run without --finished.")
    return tables(run.task, own, theirs, floors)


def stored(run: Run, cells: list[Cell], function: Callable[..., Any]) -> Found:
    """Results of the cells that are finished."""
    folder = run.folder / "cells" / run.mode
    paths = [(cell, folder / f"{_name(cell)}.json") for cell in cells]
    return [
        (cell, read_json(path)["result"])
        for cell, path in paths
        if _finished(path, function.__qualname__)
    ]


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know, by system."""
    return {
        system: {
            "regimes": [vars(r) for (of, _), r in REGIMES.items() if of == system],
            "development seeds": DEVELOPMENT,
            "n_test": N_TEST[mode],
            "folds": _members.N_FOLDS,
            "gp_rows": _peers.GP_ROWS,
            "flight_steps": FLIGHT_STEPS if system == "flights" else None,
        }
        for system in SYSTEMS
    }


def _system(tables: Tables) -> str:
    return next(iter(tables)).partition("-")[0]


def draw(tables: Tables) -> "dict[str, Figure]":
    """Figures of one system."""
    system = _system(tables)
    scores = {system: tables[f"{system}-scores"]}
    found = {
        f"{system}-who-wins": who_wins(scores, "typical"),
        f"{system}-winners": winners(scores),
    }
    if f"{system}-curves" in tables:
        found[f"{system}-curves"] = curves(system, tables[f"{system}-curves"])
    if f"{system}-ratios" in tables:
        found[f"{system}-apart"] = apart(system, tables[f"{system}-ratios"])
    return found


@dataclass(frozen=True)
class Regimes(Benchmark):
    """A benchmark of several systems, with one map over all that have been run."""

    def main(self, arguments: list[str] | None = None) -> None:
        """Run from the command line."""
        own = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        names = list(_peers.ENVIRONMENT)
        own.add_argument("--peers", nargs="*", choices=names)
        own.add_argument("--finished", action="store_true")
        own.add_argument("--out", type=Path)
        own.add_argument("--quick", action="store_true")
        arguments = sys.argv[1:] if arguments is None else arguments
        asked, others = own.parse_known_args(arguments)
        root = asked.out or (Path("results") if asked.quick else RESULTS)
        if asked.quick and root.resolve().is_relative_to(RESULTS.resolve()):
            self._parser().error(f"a quick run never overwrites {RESULTS}: choose another --out.")
        if asked.quick:
            others = ["--quick", *others]
            if "--task" not in others and "--help" not in others:
                others += ["--task", SYSTEMS[0]]
        peers = ([] if asked.quick else names) if asked.peers is None else asked.peers
        bound = partial(run, peers=peers, compute=not asked.finished)
        Benchmark.main(replace(self, run=bound), ["--out", str(root), *others])

    def _parser(self) -> argparse.ArgumentParser:
        parser = super()._parser()
        # read before, and listed here
        parser.add_argument(
            "--peers",
            nargs="*",
            metavar="PEER",
            help=f"of {', '.join(_peers.ENVIRONMENT)} (default: all; with --quick none); their "
            "environments are made where they are missing",
        )
        parser.add_argument(
            "--finished", action="store_true", help="tables of the finished cells, computing none"
        )
        return parser

    def _store(self, run: Run, folder: Path) -> None:
        seeds = [DEVELOPMENT[0]] if run.mode == "quick" else list(SEEDS[: len(run.seeds)])
        super()._store(replace(run, seeds=seeds), folder)

    def _show(self, folder: Path, result: str) -> None:
        super()._show(folder, result)
        there = [name for name in SYSTEMS if (folder / f"{name}.json").is_file()]
        every = {name: read_tables(folder, name) for name in there}
        page = "\n".join(report(name, some) for name, some in every.items())
        (folder / f"{self.name}.md").write_text(page.rstrip() + "\n", encoding="utf-8")
        scores = {name: some[f"{name}-scores"] for name, some in every.items()}
        save(who_wins(scores, "typical"), folder / self.name, self.name)
        save(who_wins(scores, "cum"), folder / f"{self.name}-mean", self.name)
        save(winners(scores), folder / f"{self.name}-winners", self.name)


def save(figure: "Figure", path: Path, salt: str) -> None:
    """Store a figure as PNG and SVG; the same picture gives the same bytes."""
    import matplotlib.pyplot as plt

    _save_png(figure, path.with_suffix(".png"))
    with plt.rc_context({"svg.hashsalt": salt, "svg.fonttype": "none"}):
        figure.savefig(path.with_suffix(".svg"), bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


BENCHMARK = Regimes(
    "regimes",
    __doc__,
    run,
    lambda tables: report(_system(tables), tables),
    draw,
    settings,
    minutes=150,
    seeds=len(SEEDS),
    tasks=SYSTEMS,
    data=("crazyflie_lee_gains",),
)

if __name__ == "__main__":
    BENCHMARK.main()
