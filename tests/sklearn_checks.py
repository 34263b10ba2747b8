"""scikit-learn's own estimator checks, run once for an estimator and judged strictly."""

import time
from collections import Counter
from typing import Any

from sklearn.base import BaseEstimator
from sklearn.utils.estimator_checks import check_estimator

# A tag that would switch checks off; an estimator of ours may not carry any.
_EXCUSES = ("non_deterministic", "no_validation")


def run_checks(
    estimator: BaseEstimator, *, allowed_skips: dict[str, str], max_seconds: float = 45.0
) -> list[dict[str, Any]]:
    """Run `check_estimator`, print what came out, and fail on anything not agreed on.

    Parameters
    ----------
    estimator : estimator
        An instance, usually with default parameters.
    allowed_skips : dict
        Name of a check that may be skipped -> the reason. A check listed here that is not
        skipped is no error: skips depend on what is installed and on the environment.
    max_seconds : float, default=45
        Longest CPU time of the process that all checks together may take.

    Returns
    -------
    list of dict
        The results as `check_estimator` gives them.

    Raises
    ------
    AssertionError
        If a check failed, was expected to fail, or was skipped without being listed; if a tag
        excuses the estimator from checks; if the checks took longer than `max_seconds`.
    """
    name = type(estimator).__name__
    _refuse_excuses(estimator)
    started, cpu = time.perf_counter(), time.process_time()
    results = check_estimator(estimator, on_fail=None, on_skip=None)
    seconds, cpu = time.perf_counter() - started, time.process_time() - cpu

    counts = Counter(result["status"] for result in results)
    print(
        f"{name}: {counts['passed']} checks passed, {counts['skipped']} skipped, "
        f"{counts['failed'] + counts['xfail']} failed in {seconds:.1f} s ({cpu:.1f} s of CPU)"
    )
    problems = []
    for result in results:
        check, status, why = result["check_name"], result["status"], result["exception"]
        if status == "skipped" and check in allowed_skips:
            print(f"  skipped {check}: {allowed_skips[check]}")
        elif status != "passed":
            problems.append(f"{check} {status}: {type(why).__name__}: {why}")
    if not counts["passed"]:
        problems.append("no check passed: was any run?")
    if cpu > max_seconds:
        problems.append(f"the checks took {cpu:.1f} s of CPU, more than {max_seconds:g} s")
    if problems:
        raise AssertionError("\n".join([f"check_estimator({name}):", *problems]))
    return results


def _refuse_excuses(estimator: BaseEstimator) -> None:
    tags = estimator.__sklearn_tags__()
    carried = [name for name in _EXCUSES if getattr(tags, name)]
    if tags.regressor_tags is not None and tags.regressor_tags.poor_score:
        carried.append("poor_score")
    if carried:
        raise AssertionError(f"{type(estimator).__name__} carries the tags {', '.join(carried)}.")
