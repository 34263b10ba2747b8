"""What holds for every test: one thread, no window, reproducible random examples, real data."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# In time: numpy and torch, which read these once, are imported by the tests only.
for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# scipy reads this once too: scikit-learn's check of array API input then runs instead of skipping.
os.environ.setdefault("SCIPY_ARRAY_API", "1")

# Examples that train a model are slow by nature: few of them, and no deadline on any.
settings.register_profile(
    "local", deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("ci", settings.get_profile("local"), derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread() -> None:
    import torch

    torch.set_num_threads(1)


# Real data lie beside the repository, never in it. Where they are, no test that needs them may be
# skipped, and every run says how many ran.
_GIVEN = os.environ.get("TRAJLEARN_TEST_DATA")
_DATA = Path(_GIVEN) if _GIVEN else Path(__file__).resolve().parents[2] / "shared" / "data"
_NEEDS_DATA = ("needs", "data")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers", "data: needs real data, from ../shared/data or the folder TRAJLEARN_TEST_DATA"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "data_folder" in getattr(item, "fixturenames", ()):
            item.add_marker("data")
        if item.get_closest_marker("data"):
            # Of all that is known about a test, this also reaches the main process of xdist.
            item.user_properties.append(_NEEDS_DATA)


@pytest.fixture(scope="session")
def data_folder() -> Callable[[str], Path]:
    """The folder of a data set by its name; skips the test where there are no data at all."""

    def folder_of(name: str) -> Path:
        if not _DATA.is_dir() and not _GIVEN:
            pytest.skip(f"no folder {_DATA}")
        if not (_DATA / name).is_dir():
            pytest.fail(f"{_DATA} is to hold the data of the tests, but has no folder {name}")
        return _DATA / name

    return folder_of


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    report: Any = yield
    if report.skipped and _NEEDS_DATA in item.user_properties and (_GIVEN or _DATA.is_dir()):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} was skipped although its data are in {_DATA}"
    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    reports = [
        report
        for several in terminalreporter.stats.values()
        for report in several
        # items that were deselected stand there, too
        if isinstance(report, pytest.TestReport)
        and _NEEDS_DATA in map(tuple, getattr(report, "user_properties", ()))
    ]
    skipped = {report.nodeid for report in reports if report.skipped}
    ran = {report.nodeid for report in reports} - skipped
    if ran or skipped:
        reason = f" (no folder {_DATA})" if skipped else ""
        terminalreporter.write_line(f"data tests: {len(ran)} ran, {len(skipped)} skipped{reason}")
    else:
        terminalreporter.write_line("data tests: none selected")
