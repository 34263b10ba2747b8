"""The command line: ``trajlearn reproduce NAME`` and ``trajlearn reproduce --list``."""

import ast
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["main"]

# where the modules that reproduce results live, in a source checkout
_FOLDERS = ("paper", "regimes")

app = typer.Typer(
    help="Long-term dynamics of controlled systems: reproduce results of the project.",
    no_args_is_help=True,
    add_completion=False,
)


@app.callback()
def _root() -> None:
    """Long-term dynamics of controlled systems: reproduce results of the project."""


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    epilog="Further options go to the benchmark: trajlearn reproduce NAME --help lists them.",
    add_help_option=False,
)
def reproduce(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="What to reproduce.")] = None,
    listing: Annotated[bool, typer.Option("--list", help="List what there is.")] = False,
    wants_help: Annotated[bool, typer.Option("--help", help="Show help.")] = False,
) -> None:
    """Run one of the modules of benchmarks/ from a source checkout."""
    if name is None and not listing:
        typer.echo(context.get_help())
        raise typer.Exit(0 if wants_help else 2)
    known = _benchmarks(_checkout())
    if listing:
        width = max(map(len, known), default=0)
        for key, path in sorted(known.items()):
            typer.echo(f"{key:{width}}  {_summary(path)}")
        return
    if name not in known:
        typer.echo(f"There is nothing called {name!r}; choose from {', '.join(sorted(known))}.")
        raise typer.Exit(2)
    path = known[name]
    module = ".".join(path.relative_to(_checkout()).with_suffix("").parts)
    arguments = [*context.args, *(["--help"] if wants_help else [])]
    done = subprocess.run([sys.executable, "-m", module, *arguments], cwd=_checkout(), check=False)
    raise typer.Exit(done.returncode)


def _checkout() -> Path:
    """Root of the source checkout this package runs from."""
    root = Path(__file__).resolve().parent.parent
    if not (root / "benchmarks").is_dir():
        typer.echo(
            "`trajlearn reproduce` runs the modules of benchmarks/, which are not part of an "
            "installed package. Clone the source, then run it from there."
        )
        raise typer.Exit(2)
    return root


def _benchmarks(root: Path) -> dict[str, Path]:
    """Name to file: a public module of benchmarks/paper or benchmarks/regimes."""
    return {
        path.stem.replace("_", "-"): path
        for folder in _FOLDERS
        for path in sorted((root / "benchmarks" / folder).glob("[a-z]*.py"))
    }


def _summary(path: Path) -> str:
    """First line of a module's docstring, without importing it."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


def main() -> None:
    """Entry point of the ``trajlearn`` command."""
    app()
