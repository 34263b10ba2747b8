import multiprocessing
import os
import signal
import time

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.control.plants import BOUNDS, HORIZON, Plant, cost, fly
from trajlearn import Trajectory
from trajlearn.control.random_search import RandomSearch
from trajlearn.exceptions import UnknownFileError


def search_of(**settings):
    return RandomSearch(
        **{"bounds": BOUNDS, "reward": cost, "horizon": HORIZON, "random_state": 0} | settings
    )


def told(search, n):
    for _ in range(n):
        search.tell(fly(search.ask()))
    return search


def alike(a, b):
    assert a.seed_ == b.seed_
    assert_array_equal(a.returns_, b.returns_)
    if len(a.returns_):
        assert a.trials_ == b.trials_
        assert a.history().equals(b.history())
    assert_array_equal(a.ask(), b.ask())


@pytest.mark.parametrize("n", [0, 1, 3])
@pytest.mark.parametrize("waiting", [False, True], ids=["after tell", "after ask"])
def test_a_resumed_search_is_the_one_that_was_saved(n, waiting, tmp_path):
    search = told(search_of(), n)
    if waiting:
        search.ask()
    search.save(tmp_path / "search.npz")
    # the seed of the file rules
    again = search_of(random_state=99).resume(tmp_path / "search.npz")
    alike(again, search)
    alike(told(again, 2), told(search, 2))


def changing():
    """A trial in which theta changes."""
    trial = fly([0.3, 0.3])
    theta = np.linspace(0, 1, HORIZON)[:, None] * [1.0, 0.5]
    return Trajectory(
        trial.states, actions=trial.actions, rewards=trial.rewards, params=theta, dt=0.1
    )


def test_crashes_returns_by_hand_and_changing_theta_survive(tmp_path):
    search = search_of().tell(fly([2.9, 0.5], start=(3.0, 0.0)))
    search.tell(fly([0.3, 0.3], length=2), reward=-7.0)
    search.tell(changing())
    search.save(tmp_path / "search.npz")
    again = search_of().resume(tmp_path / "search.npz")
    alike(again, search)
    assert_array_equal(again.trials_.terminated, [True, False, False])
    # what a missing step costs is no part of the file
    cheap = search_of(terminal_reward=0.0).resume(tmp_path / "search.npz")
    assert cheap.returns_[0] > again.returns_[0]


def test_another_search_names_what_differs(tmp_path):
    path = tmp_path / "search.npz"
    told(search_of(), 1).save(path)
    for settings, message in [
        ({"horizon": 7}, "horizon = 7 here, 6 there"),
        ({"bounds": [[0.0, 2.0], [-0.5, 1.0]]}, r"bounds = \[\[0.0, 2.0\], \[-0.5, 1.0\]\] here"),
        ({"bounds": [[0.0, 2.0]]}, "p = 1 here, 2 there"),
    ]:
        other = search_of(**settings)
        with pytest.raises(ValueError, match=message):
            other.resume(path)
        assert not hasattr(other, "returns_")

    class Other(RandomSearch):
        pass

    with pytest.raises(ValueError, match="holds a RandomSearch, not a Other"):
        Other(bounds=BOUNDS, reward=cost, horizon=HORIZON).resume(path)


def weighted(states):
    return 2.0 * cost(states)


@pytest.mark.parametrize(
    ("trials", "what"),
    [
        (lambda: [fly([0.3, 0.3])], r"trial 0 is -1.97\d+ with this one and was -0.98"),
        (lambda: [fly([2.9, 0.5], start=(3.0, 0.0))], "the sum of rewards of trial 0"),
        (lambda: [changing()], "the least step reward of trial 0"),
    ],
    ids=["whole", "crashed", "theta changes"],
)
def test_another_reward_is_noticed(trials, what, tmp_path):
    path = tmp_path / "search.npz"
    search_of().tell(trials()).save(path)
    other = search_of(reward=weighted)
    with pytest.raises(ValueError, match=what) as caught:
        other.resume(path)
    assert str(path) in caught.value.__notes__[0]
    assert not hasattr(other, "returns_")
    with pytest.raises(ValueError, match="reward is another one"):
        other.run(Plant(), 5, path=path)
    # as it was logged: the same reward by another way, in single precision
    logged = search_of(reward=lambda states: cost(states).astype(np.float32))
    logged.resume(path)
    if not np.isnan(logged.returns_).any():
        search_of(reward=None).resume(path)


def test_returns_given_by_hand_need_no_reward_again(tmp_path):
    path = tmp_path / "search.npz"
    search_of().tell(fly([0.3, 0.3]), reward=-7.0).save(path)
    assert search_of(reward=weighted).resume(path).returns_.tolist() == [-7.0]
    search_of().tell([fly([0.3, 0.3]), fly([0.4, 0.3])], reward=[-7.0, -6.0]).tell(
        fly([0.5, 0.3])
    ).save(path)
    with pytest.raises(ValueError, match="trial 2"):
        search_of(reward=weighted).resume(path)


def test_a_failing_resume_keeps_what_there_was(tmp_path):
    search = told(search_of(), 2)
    search_of(horizon=7, random_state=1).save(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="horizon"):
        search.resume(tmp_path / "other.npz")
    alike(search, told(search_of(), 2))


def test_files_that_are_none_of_ours(tmp_path):
    path = tmp_path / "search.npz"
    told(search_of(), 2).save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for size in rng.integers(0, len(whole), 10):
        path.write_bytes(whole[:size])
        with pytest.raises(UnknownFileError, match=r"search\.npz"):
            search_of().resume(path)
    trials = told(search_of(), 1).trials_
    trials.save(path)
    with pytest.raises(UnknownFileError, match=r"npz: this is not a search"):
        search_of().resume(path)
    np.savez(path, header=np.array([object()]))
    with pytest.raises(UnknownFileError, match="damaged"):
        search_of().resume(path)
    with pytest.raises(FileNotFoundError):
        search_of().resume(tmp_path / "nowhere.npz")


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "search.npz"
    told(search_of(), 1).save(path)
    before = path.read_bytes()
    write = np.savez

    def dies_half_way(handle, **arrays):
        write(handle, **dict(list(arrays.items())[:2]))
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", dies_half_way)
    with pytest.raises(OSError, match="no space left"):
        told(search_of(), 3).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["search.npz"]


# -- run(path=) ---------------------------------------------------------------------------------


class Mortal(Plant):
    """A simulator that fails in one trial."""

    def __init__(self, last):
        super().__init__()
        self.last = last

    def rollout(self, *args, **kwargs):
        if len(self.flown) == self.last:
            raise OSError("the simulator went away")
        return super().rollout(*args, **kwargs)


@pytest.mark.parametrize("logs", [0, 2])
def test_a_script_that_stopped_is_started_again(logs, tmp_path):
    path = tmp_path / "search.npz"

    def script(env):
        search = search_of(random_state=None)
        for _ in range(logs):
            search.tell(fly([0.3, 0.3]))
        return search.run(env, 5, path=path)

    env = Mortal(3)
    with pytest.raises(OSError, match="went away"):
        script(env)
    stopped = search_of().resume(path)
    # saved after the ask: what was going to be tried is known
    waiting = stopped.ask()
    search = script(second := Plant())
    assert len(env.flown) == 3
    assert len(second.flown) == 2
    assert_array_equal(second.flown[0][1], waiting)
    assert len(search.returns_) == 5 + logs
    never_stopped = search_of(random_state=None)
    never_stopped.resume(path)
    alike(never_stopped, search)
    # finished: nothing is left to do
    assert len(script(third := Plant()).returns_) == 5 + logs
    assert not third.flown


def test_one_search_may_run_again_with_the_same_file(tmp_path):
    search = search_of()
    for _ in range(3):
        search.run(Plant(), 1, path=tmp_path / "search.npz")
    assert len(search.returns_) == 3
    alike(search_of().resume(tmp_path / "search.npz"), search)
    # told in memory only: the file is behind and is written anew
    search.tell(fly([0.3, 0.3])).run(Plant(), 1, path=tmp_path / "search.npz")
    assert len(search_of().resume(tmp_path / "search.npz").returns_) == 5


def test_run_does_not_write_over_another_search(tmp_path):
    path = tmp_path / "search.npz"
    told(search_of(), 2).save(path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="other trials"):
        search_of().tell(fly([0.3, 0.3])).run(Plant(), 1, path=path)
    with pytest.raises(ValueError, match="horizon"):
        search_of(horizon=7).run(Plant(), 1, path=path)
    assert path.read_bytes() == before


def killed_after_ask(start, path):
    """Two trials of a search, in a process that is killed after it asked for a third and saved."""
    context = multiprocessing.get_context("fork")  # an import of the package takes seconds
    here, there = context.Pipe()

    def script():
        search = start()
        told(search, 2).ask()
        search.save(path)
        there.send("asked")
        time.sleep(60)

    child = context.Process(target=script)
    child.start()
    try:
        assert here.poll(30)
        assert here.recv() == "asked"
    finally:
        child.kill()
        child.join()
    assert child.exitcode == -signal.SIGKILL


def test_a_process_killed_between_ask_and_tell_loses_nothing(tmp_path):
    killed_after_ask(search_of, tmp_path / "search.npz")
    resumed = search_of(random_state=None).resume(tmp_path / "search.npz")
    never_stopped = told(search_of(), 2)
    for _ in range(3):
        gains = resumed.ask()
        assert_array_equal(gains, never_stopped.ask())
        resumed.tell(fly(gains))
        never_stopped.tell(fly(gains))
    alike(resumed, never_stopped)
