import pytest
from sklearn.dummy import DummyRegressor
from sklearn.linear_model import LinearRegression, SGDRegressor

from tests import sklearn_checks


def pretend(monkeypatch, *outcomes):
    """Let check_estimator report these (check name, status) pairs."""
    results = [
        {"check_name": name, "status": status, "exception": ValueError("because")}
        for name, status in outcomes
    ]
    monkeypatch.setattr(sklearn_checks, "check_estimator", lambda *_, **__: results)


def test_prints_counts_and_reasons(monkeypatch, capsys):
    pretend(monkeypatch, ("check_a", "passed"), ("check_b", "skipped"))
    reasons = {"check_b": "needs a variable of the environment"}
    assert len(sklearn_checks.run_checks(LinearRegression(), allowed_skips=reasons)) == 2
    printed = capsys.readouterr().out
    assert "1 checks passed, 1 skipped, 0 failed" in printed
    assert "check_b: needs a variable" in printed


@pytest.mark.parametrize("status", ["failed", "xfail", "skipped"])
def test_fails_on_what_was_not_agreed(monkeypatch, status):
    pretend(monkeypatch, ("check_a", "passed"), ("check_b", status))
    with pytest.raises(AssertionError, match=f"check_b {status}: ValueError: because"):
        sklearn_checks.run_checks(LinearRegression(), allowed_skips={"check_c": "elsewhere"})


def test_a_failure_cannot_be_allowed(monkeypatch):
    pretend(monkeypatch, ("check_a", "passed"), ("check_b", "failed"))
    with pytest.raises(AssertionError, match="check_b failed"):
        sklearn_checks.run_checks(LinearRegression(), allowed_skips={"check_b": "it fails"})


def test_fails_if_slow_or_empty(monkeypatch):
    pretend(monkeypatch, ("check_a", "passed"))
    with pytest.raises(AssertionError, match="s of CPU, more than"):
        sklearn_checks.run_checks(LinearRegression(), allowed_skips={}, max_seconds=-1.0)
    pretend(monkeypatch)
    with pytest.raises(AssertionError, match="no check passed"):
        sklearn_checks.run_checks(LinearRegression(), allowed_skips={})


def test_refuses_tags_that_excuse():
    with pytest.raises(AssertionError, match="no_validation, poor_score"):
        sklearn_checks.run_checks(DummyRegressor(), allowed_skips={})

    class Unsteady(SGDRegressor):
        def __sklearn_tags__(self):
            tags = super().__sklearn_tags__()
            tags.non_deterministic = True
            return tags

    with pytest.raises(AssertionError, match="non_deterministic"):
        sklearn_checks.run_checks(Unsteady(), allowed_skips={})
