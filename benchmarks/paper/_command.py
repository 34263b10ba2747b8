"""What the commands of this folder share: options, resumable cells, tables, figures, redrawing.

A benchmark is four functions: `run` gives tables, `report` and `draw` turn tables into text and
figures, `settings` says what a reader of the numbers must know. Tables are CSV files beside a
JSON file with the provenance, so that text and figures can be made again without running anything.
"""

import argparse
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from benchmarks._results import provenance, read_json, write_csv, write_json
from benchmarks._sweep import Cell, run_cells

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = Path(__file__).parent / "results"
# environment variable: worker processes inherit it, and the files of cells do not name it
_DATA = "TRAJLEARN_FLIGHTS"

Tables = dict[str, pd.DataFrame]


@dataclass(frozen=True)
class Run:
    """One run of a benchmark: how much of it, by how many workers, and where to.

    Attributes
    ----------
    name : str
        Of the benchmark and its folder.
    mode : {"full", "quick"}
    seeds : list of int
    root : Path
        Folder of the results of all benchmarks.
    n_jobs : int
        Processes of this machine.
    workers : dict
        Further arguments of `run_cells`: where else to compute.
    fresh : bool
        Whether to forget the cells of earlier runs.
    task : str, optional
        The one to run, of a benchmark with a result for each task.
    data : Path, optional
        Folder of the folders of recorded data. Cells find them by `data_folder`.
    """

    name: str
    mode: str
    seeds: list[int]
    root: Path
    n_jobs: int
    workers: dict[str, Any]
    fresh: bool = False
    task: str | None = None
    data: Path | None = None

    @property
    def folder(self) -> Path:
        """Where the results of this benchmark go."""
        return self.root / self.name

    def cells(
        self, cells: Iterable[Cell], function: Callable[..., Any], *, shared: str | None = None
    ) -> list[Any]:
        """Results of ``function(**cell)``, finished cells from disk.

        Benchmarks that need the same fits name the same `shared` folder and do them once.
        """
        folder = self.root / (shared or self.name) / "cells" / self.mode
        return run_cells(
            cells,
            function,
            folder,
            n_jobs=self.n_jobs,
            description=" ".join(filter(None, (self.name, self.task))),
            fresh=self.fresh,
            **self.workers,
        )


@dataclass(frozen=True)
class Benchmark:
    """What a module of this folder defines.

    Attributes
    ----------
    name : str
        As typed after ``trajlearn reproduce``.
    about : str
        The module's docstring, for ``--help``.
    run : callable
        ``run(run: Run) -> Tables``.
    report : callable
        ``report(tables) -> str``: Markdown, printed and stored.
    draw : callable
        ``draw(tables) -> dict`` from the stem of a file to a figure.
    settings : callable
        ``settings(mode) -> dict`` for the provenance.
    minutes : int
        That a full run takes on two cores, about.
    seeds : int
        Of a full run.
    publish : Path, optional
        Page of the documentation that the report of the committed results becomes.
    tasks : tuple of str
        Each has a result of its own, in files named after the task; ``--task`` chooses one.
        `run` finds it in ``run.task``, and `settings` gives a dict for each of them.
    data : tuple of str
        Folders of recorded data that it reads, inside the one that ``--data`` names.
    """

    name: str
    about: str
    run: Callable[[Run], Tables]
    report: Callable[[Tables], str]
    draw: Callable[[Tables], "dict[str, Figure]"]
    settings: Callable[[str], dict[str, Any]]
    minutes: int
    seeds: int = 3
    publish: Path | None = None
    tasks: tuple[str, ...] = ()
    data: tuple[str, ...] = ()

    def main(self, arguments: list[str] | None = None) -> None:
        """Run from the command line."""
        parser = self._parser()
        options = parser.parse_args(arguments)
        mode = "quick" if options.quick else "full"
        root = (options.out or (RESULTS if mode == "full" else Path("results"))).resolve()
        if mode == "quick" and root.is_relative_to(RESULTS.resolve()):
            parser.error(
                f"a quick run never overwrites the results that the documentation quotes, in "
                f"{RESULTS}: choose another folder with --out."
            )
        folder = root / self.name
        seeds = list(range(1 if options.quick else options.seeds))
        workers = {"scheduler": options.scheduler, "local_workers": options.local_workers}
        data = self._data(parser, options.data) if self.data else None
        whole = Run(self.name, mode, seeds, root, options.n_jobs, workers, options.fresh, data=data)
        tasks = [options.task] if self.tasks and options.task else self.tasks or [None]
        for run in [replace(whole, task=task) for task in tasks]:
            if not options.redraw:
                self._store(run, folder)
            self._show(folder, run.task or self.name)
        if mode == "quick" and not options.redraw:
            print(
                "This was the quick mode: one seed, short training. The full run, about "
                f"{self.minutes} minutes on two cores: .venv/bin/trajlearn reproduce {self.name}"
            )

    def _data(self, parser: argparse.ArgumentParser, folder: Path | None) -> Path | None:
        """The folder of recorded data, told to the workers as well."""
        if folder is not None:
            missing = [name for name in self.data if not (folder / name).is_dir()]
            if missing:
                parser.error(f"--data {folder} has no folder {' and no folder '.join(missing)}.")
            os.environ[_DATA] = str(folder.resolve())
        return Path(os.environ[_DATA]) if os.environ.get(_DATA) else None

    def _store(self, run: Run, folder: Path) -> None:
        """Run, and write the tables and what a reader must know of them."""
        tables, settings = self.run(run), self.settings(run.mode)
        for stem, table in tables.items():
            write_csv(folder / f"{stem}.csv", table)
        facts = provenance(run.mode, run.seeds, **(settings[run.task] if run.task else settings))
        write_json(folder / f"{run.task or self.name}.json", facts | {"tables": list(tables)})

    def _show(self, folder: Path, result: str) -> None:
        """Text and figures of the tables as they are on disk: redrawing gives the same."""
        import matplotlib.pyplot as plt

        plt.switch_backend("Agg")
        tables = read_tables(folder, result)
        text = self.report(tables)
        published = self.publish is not None and folder.parent == RESULTS.resolve()
        page = self.publish if published else folder / f"{result}.md"
        page.write_text(text.rstrip() + "\n", encoding="utf-8")
        for stem, figure in self.draw(tables).items():
            _save_png(figure, folder / f"{stem}.png")
            # the same picture gives the same bytes: no date, no random names
            with plt.rc_context({"svg.hashsalt": self.name, "svg.fonttype": "none"}):
                path = folder / f"{stem}.svg"
                figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
            plt.close(figure)
        print(f"\n{text.rstrip()}\n\nWritten to {folder}.")

    def _parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            prog=f"trajlearn reproduce {self.name}",
            description=self.about,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            epilog="Every finished cell is stored at once: a run that was stopped goes on where "
            "it was.",
        )
        add = parser.add_argument
        if self.tasks:
            add("--task", choices=self.tasks, help="(default: all)")
        if self.data:
            add(
                "--data",
                type=Path,
                metavar="FOLDER",
                help=f"holds {', '.join(self.data)} (default: that of the environment variable "
                f"{_DATA}, which workers on other machines need; else what is missing is "
                "downloaded)",
            )
        add("--quick", action="store_true", help="one seed, short training: minutes")
        add("--seeds", type=_positive, default=self.seeds, help="(default: %(default)s)")
        add("--n-jobs", type=int, default=2, help="processes (default: %(default)s)")
        where = parser.add_mutually_exclusive_group()
        where.add_argument(
            "--local-workers", type=_positive, help="this many processes of a Dask cluster here"
        )
        where.add_argument(
            "--scheduler",
            metavar="ADDRESS",
            help="a Dask cluster, such as tcp://node:8786, whose workers run in the same checkout",
        )
        add("--out", type=Path, help="folder of the results of all benchmarks")
        add("--fresh", action="store_true", help="forget the cells of earlier runs")
        add("--redraw", action="store_true", help="text and figures from the stored results")
        return parser


def data_folder(name: str) -> Path | None:
    """Folder of recorded data by its name, in any worker; None lets a loader download it."""
    folder = os.environ.get(_DATA)
    return Path(folder) / name if folder else None


def _save_png(figure: "Figure", path: Path) -> None:
    """Store a figure in few colours: a quarter of the bytes, and no difference to be seen."""
    from PIL import Image

    with BytesIO() as raw:
        figure.savefig(raw, format="png", dpi=130, bbox_inches="tight")
        Image.open(raw).convert("RGB").quantize(128).save(path, optimize=True)


def read_tables(folder: Path, name: str) -> Tables:
    """Tables that a benchmark (or one of its tasks, by name) has stored in a folder."""
    try:
        stems = read_json(folder / f"{name}.json")["tables"]
        return {stem: pd.read_csv(folder / f"{stem}.csv") for stem in stems}
    except FileNotFoundError as error:
        raise SystemExit(
            f"There are no results in {folder} ({Path(error.filename).name} is missing): "
            "run without --redraw first."
        ) from None


def markdown(table: pd.DataFrame) -> str:
    """A table as Markdown; numbers keep two significant digits, a missing one is a blank."""

    def entry(value: Any) -> str:
        if isinstance(value, float):
            return "" if value != value else f"{value:.2g}"
        return "" if value is None else str(value)

    head = [str(name) for name in table.columns]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(map(entry, row)) + " |" for row in table.itertuples(index=False)]
    return "\n".join(lines)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value
