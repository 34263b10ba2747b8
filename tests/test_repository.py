"""Promises of the repository itself: versions, layout, citations, light import."""

import importlib
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from numpydoc.validate import validate
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import trajlearn

ROOT = Path(__file__).parents[1]
MAX_LINES = 500
HEAVY = ("botorch", "gpytorch", "gymnasium", "matplotlib", "minari", "mujoco", "pandas")
SOURCE_COMMENT = re.compile(r"<!--\s*source:\s*(.*?)\s*-->", re.DOTALL)


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def constraints():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"==[\w.]+", str(pin.specifier)) for pin in pins)  # exact, no "+cpu"
    return {canonicalize_name(pin.name): str(pin.specifier)[2:] for pin in pins}


def citation_problems(text, root):
    """What is wrong with the result files that `text` names as sources, relative to `root`."""
    problems = []
    for source in SOURCE_COMMENT.findall(text):
        path = (root / source).resolve()
        if not path.is_file():
            problems.append(f"{source}: no such file")
        elif not path.is_relative_to(root / "benchmarks") or "results" not in path.parts:
            problems.append(f"{source}: not under the results of a benchmark")
        elif path.suffix != ".json" or json.loads(path.read_text()).get("mode") != "full":
            problems.append(f"{source}: not the result of a full run")
    return problems


def api_page_names():
    """Public names in the autosummaries of the API page."""
    page = (ROOT / "docs" / "api" / "index.rst").read_text()
    blocks = re.findall(r"\.\. autosummary::\n(?: +:.*\n)+\n((?: +\S+\n)+)", page)
    return [name for block in blocks for name in block.split()]


def test_version_is_single_sourced_and_in_the_changelog(project):
    from trajlearn._version import __version__

    assert "version" in project["dynamic"]
    assert "version" not in project
    assert str(Version(__version__)) == __version__
    assert trajlearn.__version__ == __version__
    sections = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert {"Unreleased", __version__} & set(sections)
    assert len(sections) == len(set(sections))


def test_constraints_cover_every_dependency_within_its_bounds(project, constraints):
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    wanted = [Requirement(line) for group in groups for line in group]
    for requirement in wanted:
        name = canonicalize_name(requirement.name)
        if name == "trajlearn":
            continue
        assert name in constraints, f"constraints.txt lacks {name}"
        assert requirement.specifier.contains(constraints[name]), requirement


def test_the_extra_all_takes_in_every_other_extra(project):
    extras = dict(project["optional-dependencies"])
    (everything,) = extras.pop("all")
    assert Requirement(everything).extras == set(extras)


def test_licence_and_type_marker_are_there():
    licence = (ROOT / "LICENSE").read_text()
    assert licence.startswith("BSD 3-Clause License")
    assert "The trajlearn developers" in licence
    assert (ROOT / "trajlearn" / "py.typed").is_file()


def test_ci_runs_make_test():
    run = ROOT / ".ci" / "run"
    assert os.access(run, os.X_OK)
    assert run.read_text().splitlines()[-1] == "make test"


@pytest.mark.parametrize(
    "path", sorted((ROOT / "trajlearn").rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT))
)
def test_module_is_small(path):
    assert len(path.read_text().splitlines()) <= MAX_LINES, "split it by idea"


def test_every_package_folder_is_a_package():
    folders = {path.parent for path in (ROOT / "trajlearn").rglob("*.py")}
    assert [str(f.relative_to(ROOT)) for f in folders if not (f / "__init__.py").is_file()] == []


def test_import_is_light():
    code = (
        "import sys, trajlearn; dir(trajlearn); "
        f"print(*[name for name in {HEAVY!r} if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


def test_public_names_import_from_the_top():
    assert len(trajlearn.__all__) == len(set(trajlearn.__all__))
    assert set(trajlearn.__all__) <= set(dir(trajlearn))
    for name in trajlearn.__all__:
        assert getattr(trajlearn, name) is not None
    with pytest.raises(AttributeError, match="NoSuchName"):
        _ = trajlearn.NoSuchName


@pytest.mark.parametrize("name", sorted(set(trajlearn.__all__) - {"__version__"}))
def test_public_docstring_is_complete(name):
    public = getattr(trajlearn, name)
    if isinstance(public, type) and issubclass(public, Exception):
        assert public.__doc__
        return
    errors = dict(validate(f"trajlearn.{name}")["errors"])
    # Summary there; parameters all documented, none unknown; an example.
    assert {code: errors[code] for code in ("GL08", "PR01", "PR02", "EX01") if code in errors} == {}


def test_api_page_lists_the_public_names():
    listed = api_page_names()
    assert len(listed) == len(set(listed))
    nested = {name for name in listed if "." in name}
    assert set(listed) - nested == set(trajlearn.__all__) - {"__version__"}
    for module in ("paper", "plotting", "testing"):
        public = set(importlib.import_module(f"trajlearn.{module}").__all__)
        here = {name.partition(".")[2] for name in nested if name.startswith(f"{module}.")}
        assert here <= public
        assert public <= here | set(listed)


def test_readme_and_docs_cite_full_results_only():
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    pages = [page for page in pages if not {"_build", "notebooks"} & set(page.parts)]
    texts = {page.relative_to(ROOT): page.read_text() for page in pages if page.is_file()}
    if not any(SOURCE_COMMENT.search(text) for text in texts.values()):
        pytest.skip("README and docs cite no result file yet")
    problems = {str(page): citation_problems(text, ROOT) for page, text in texts.items()}
    assert {page: found for page, found in problems.items() if found} == {}


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ('{"mode": "full"}', None),
        ('{"mode": "quick"}', "full run"),
        ("{}", "full run"),
        (None, "no such file"),
    ],
)
def test_citation_check_tells_quick_from_full(tmp_path, content, problem):
    source = "benchmarks/paper/results/table/task.json"
    if content is not None:
        (tmp_path / source).parent.mkdir(parents=True)
        (tmp_path / source).write_text(content)
    found = citation_problems(f"0.01\n<!-- source: {source} -->\n", tmp_path)
    assert len(found) == (problem is not None)
    assert all(problem in line for line in found)


def test_citation_check_takes_results_of_benchmarks_only(tmp_path):
    (tmp_path / "notes.json").write_text('{"mode": "full"}')
    (problem,) = citation_problems("<!-- source: notes.json -->", tmp_path)
    assert "not under the results" in problem
