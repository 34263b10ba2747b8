"""Members that leave the race are surely behind, and are never chosen."""

import numpy as np
import pytest
from sklearn.frozen import FrozenEstimator

from tests.dynamics.crossing import Off, decays
from trajlearn.dynamics._selection.losses import horizon_losses
from trajlearn.dynamics._selection.race import enough_to_race, in_the_race
from trajlearn.dynamics.selector import HorizonSelector

NAN = np.nan
GOOD, BAD = Off(0.0, 0.1), Off(0.5, 0.5)


def selector(*members, **settings):
    names = [f"m{i}" for i in range(len(members))]
    return HorizonSelector(list(zip(names, members)), **{"random_state": 0, **settings})


def judged(model):
    """Episodes by which each member was judged."""
    return model.report(by="member")["n_episodes"].to_dict()


def stays(*members, n=20, n_kept=1, noise=0.1, bandwidth=0.0):
    """Which of members with errors like these (H,) stay."""
    rng = np.random.default_rng(0)
    size = np.array(members, dtype=float)[:, None]
    errors = size * np.exp(noise * rng.normal(size=(len(size), n, size.shape[2])))
    return in_the_race(horizon_losses(errors, np.arange(n), bandwidth), n_kept).tolist()


# -- who stays ----------------------------------------------------------------------------


def test_who_is_worse_everywhere_leaves():
    assert stays([1.0] * 6, [3.0] * 6) == [True, False]


def test_who_is_better_somewhere_stays():
    assert stays([1, 1, 1, 9, 9, 9], [9, 9, 9, 1, 1, 1], [20] * 6) == [True, True, False]
    assert stays([1] * 6, [0.3, 9, 9, 9, 9, 9]) == [True, True]


def test_who_is_as_good_stays_where_it_is_unsure():
    # the same but for chance: who is ahead is not known
    assert stays([1.0] * 6, [1.0] * 6, noise=1.0) == [True, True]
    # behind by little, and by less than chance explains
    assert stays([1.0] * 6, [1.01] * 6, n=40, noise=0.1) == [True, True]
    # worse over all, but perhaps better at the first step
    assert stays([1.0] * 6, [1.0, 5, 5, 5, 5, 5], n=5, noise=1.0) == [True, True]


def test_what_is_slightly_better_at_most_is_not_waited_for():
    assert stays([1.0] * 6, [0.97, 5, 5, 5, 5, 5], noise=0.01) == [True, False]
    assert stays([1.0] * 6, [0.7, 5, 5, 5, 5, 5], noise=0.01) == [True, True]


def test_nobody_leaves_where_nobody_was_judged():
    errors = np.ones((2, 20, 6))
    errors[1] = 5.0
    assert in_the_race(horizon_losses(errors, np.arange(20), 0.0), 1).tolist() == [True, False]
    errors[:, :, 4:] = NAN
    assert in_the_race(horizon_losses(errors, np.arange(20), 0.0), 1).tolist() == [True, True]


def test_who_forecasts_fewer_steps_drives_nobody_out():
    errors = np.ones((2, 20, 6))
    errors[1] = 5.0
    errors[0, :, 4:] = NAN
    assert in_the_race(horizon_losses(errors, np.arange(20), 0.0), 1).tolist() == [True, True]
    assert in_the_race(horizon_losses(errors[::-1], np.arange(20), 0.0), 1).tolist() == [True, True]


def test_the_best_few_stay_in_any_case():
    members = [1.0] * 6, [9.0] * 6, [3.0] * 6
    assert stays(*members) == [True, False, False]
    assert stays(*members, n_kept=2) == [True, False, True]


def test_units_are_groups_not_episodes():
    assert enough_to_race(np.arange(5))
    assert not enough_to_race(np.repeat(np.arange(4), 9))


# -- the selector -------------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["pick", "blend"])
def test_the_choice_is_that_of_all_folds(rule):
    ds = decays(40, noise=0.05)
    members = [Off(0.0, 0.2), Off(0.2, 0.0), Off(0.5, 0.5), Off(diverges=0.5), Off(0.6, 0.6)]
    whole = selector(*members, rule=rule, race=False, n_blended=2).fit(ds)
    raced = selector(*members, rule=rule, n_blended=2).fit(ds)
    np.testing.assert_array_equal(raced.choice_, whole.choice_)
    assert raced.best_ == whole.best_
    np.testing.assert_allclose(raced.weights_, whole.weights_, atol=0.01)
    assert set(judged(whole).values()) == {40}
    assert judged(raced) == {"m0": 40, "m1": 40, "m2": 10, "m3": 10, "m4": 10}


def test_who_left_costs_a_fit_and_is_told_as_what_it_is():
    fits = []

    class Counts(Off):
        def _learn(self, ds):
            fits.append((self.early, len(ds)))

    ds = decays(40, noise=0.05)
    model = selector(Counts(0.0, 0.1), Counts(0.5, 0.5)).fit(ds)
    assert fits == [(0.0, 30), (0.5, 30), *[(0.0, 30)] * 3, (0.0, 40)]
    table = model.cv_errors_.set_index(["member", "horizon"])
    assert (table.loc["m0", "n_episodes"] == 40).all()
    assert (table.loc["m1", "n_episodes"] == 10).all()
    assert np.isfinite(table["loss"]).all()
    members = model.report(by="member")
    assert members.loc["m1", "loss"] > members.loc["m0", "loss"]
    assert members.loc["m1", "error"] == pytest.approx((0.5 / np.ptp(ds.states)) ** 2, rel=0.1)
    # how far behind it is, on the episodes that both were judged by
    report = model.report()
    assert report["second"].tolist() == ["m1"]
    assert (report["standard_errors"] > 2).all()
    assert model.diagnosis()


def test_who_is_close_leaves_after_the_second_fold_or_not_at_all():
    ds = decays(20, noise=0.0)
    close = Off(0.11, 0.11, by_param=True)
    model = selector(Off(0.1, 0.1, by_param=True), close, BAD).fit(ds)
    assert judged(model)["m2"] < 20
    assert judged(model)["m0"] == 20


def test_with_few_episodes_nobody_leaves():
    for n in (2, 5):
        assert set(judged(selector(GOOD, BAD).fit(decays(n))).values()) == {n}
    # two folds of three hold out six
    assert judged(selector(GOOD, BAD).fit(decays(12))) == {"m0": 12, "m1": 6}
    assert judged(selector(GOOD, BAD).fit(decays(12), groups=np.arange(12) // 3))["m1"] == 12


def test_frozen_members_stay():
    frozen = FrozenEstimator(Off(0.5, 0.5).fit(decays(3)))
    assert judged(selector(GOOD, frozen, BAD).fit(decays(40))) == {"m0": 40, "m1": 40, "m2": 10}


@pytest.mark.parametrize("n_folds", [1, 2, 3])
def test_any_number_of_folds(n_folds):
    ds = decays(24)
    folds = [(np.setdiff1d(np.arange(24), test), test) for test in np.arange(24).reshape(-1, 8)]
    model = selector(GOOD, BAD, cv=folds[:n_folds]).fit(ds)
    assert judged(model) == {"m0": 8 * n_folds, "m1": 8}
    assert (model.predict(ds).lengths == 40).all()


def test_progress_tells_members_and_folds(capsys):
    selector(GOOD, BAD, verbose=1).fit(decays(40))
    shown = capsys.readouterr().err
    for part in ("2 of 2 members, fold 1", "1 of 2 members, folds 3-4 and all episodes", "6/6"):
        assert part in shown
