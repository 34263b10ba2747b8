"""How Sphinx builds these pages; warnings are errors (`make docs`)."""

import os
import shutil
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from trajlearn._version import __version__

here = Path(__file__).parent

project = "trajlearn"
author = "The trajlearn developers"
copyright = f"2026, {author}"
version = release = __version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "numpydoc",
    "myst_nb",
]
exclude_patterns = ["_build", "_templates", "**.ipynb_checkpoints"]
templates_path = ["_templates"]
default_role = "py:obj"  # `names` in docstrings become links where there is something to link

# API reference: one generated page per public name; no parameter documented that is not there.
autosummary_generate = True
autodoc_typehints = "none"  # numpydoc's sections state types and shapes
numpydoc_show_class_members = False  # the template of a class lists them
numpydoc_validation_checks = {"PR02"}

# Guide and notebooks: executed on every build. An error in a cell is a warning, hence fatal, that
# shows its traceback (`nb_execution_raise_on_error` would hide it).
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_show_tb = True


def flights_at_hand() -> bool:
    """Whether the notebook on real flights can run without a download."""
    homes = (os.environ.get(name) for name in ("TRAJLEARN_FLIGHTS", "TRAJLEARN_DATA"))
    home = next(filter(None, homes), "~/trajlearn_data")
    return Path(home, "crazyflie_lee_gains").expanduser().is_dir()


# Without the flights its page shows the code alone.
nb_execution_excludepatterns = [] if flights_at_hand() else ["notebooks/real_flights.ipynb"]
nb_merge_streams = True

html_theme = "pydata_sphinx_theme"
html_title = f"trajlearn {release}"
html_theme_options = {
    "header_links_before_dropdown": 6,
    "navigation_with_keys": False,
    "show_toc_level": 2,
}
html_sidebars = {page: [] for page in ("guide/*", "notebooks/*", "glossary", "c*")}
html_show_sourcelink = False


def copy_notebooks(source: Path, target: Path) -> None:
    """Make `target` a fresh copy of `source`: Sphinx reads nothing outside its folder.

    The notebooks run there, next to the files they read, and may leave files behind.
    """
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, ignore=shutil.ignore_patterns(".*"))


def skip_inherited_boilerplate(
    app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out what every estimator has from scikit-learn: its pages say more than ours could."""
    made_by_routing = name.startswith("set_") and name.endswith("_request")
    if made_by_routing or (getattr(obj, "__module__", None) or "").startswith("sklearn."):
        return True
    return None


def setup(app: Sphinx) -> None:
    """Called by Sphinx once the settings above are read."""
    copy_notebooks(here.parent / "notebooks", here / "notebooks")
    app.connect("autodoc-skip-member", skip_inherited_boilerplate)
