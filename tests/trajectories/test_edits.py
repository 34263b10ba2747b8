"""New datasets from old ones: against a plain loop over episodes, and by their invariants."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from sklearn.model_selection import GroupKFold

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.edits import concatenate

SEEDS = st.integers(0, 2**32 - 1)
STEPS = st.integers(1, 9)
PER_STATE, PER_STEP = ("states", "times", "references"), ("actions", "rewards")


def by_step(episode):
    """Theta of every step (T, p), also where it is constant."""
    params = episode.params
    return None if params is None else np.broadcast_to(params, (len(episode), params.shape[-1]))


def assert_part(part, whole, start, length):
    """`part` is the stretch of `length` steps of `whole` that begins at its state `start`."""
    for name in PER_STATE:
        if getattr(whole, name) is not None:
            expected = getattr(whole, name)[start : start + length + 1]
            np.testing.assert_array_equal(getattr(part, name), expected)
    for name in PER_STEP:
        if getattr(whole, name) is not None:
            expected = getattr(whole, name)[start : start + length]
            np.testing.assert_array_equal(getattr(part, name), expected)
    if whole.params is not None:
        np.testing.assert_array_equal(by_step(part), by_step(whole)[start : start + length])
    np.testing.assert_equal(part.time_origin, whole.time_origin)
    assert part.context == whole.context
    assert part.terminated == (whole.terminated and start + length == len(whole))


def assert_sound(ds):
    """What the constructor would have accepted, in the form it would have kept."""
    again = TrajectoryDataset(list(ds), **ds.names)
    assert again == ds
    assert not ds.states.flags.writeable
    assert len(set(ds.ids.tolist())) == len(ds)


# -- truncate and window ------------------------------------------------------------------------


@given(seed=SEEDS, max_steps=STEPS)
def test_truncate_keeps_the_beginning(make_dataset, seed, max_steps):
    ds = make_dataset(seed)
    short = ds.truncate(max_steps)
    assert_sound(short)
    assert short.ids.tolist() == ds.ids.tolist()
    for part, whole in zip(short, ds, strict=True):
        assert part.group == whole.group
        assert_part(part, whole, 0, min(len(whole), max_steps))


@given(seed=SEEDS, length=STEPS, stride=st.none() | STEPS)
def test_windows_are_stretches_of_their_episode(make_dataset, seed, length, stride):
    ds = make_dataset(seed)
    assume(ds.lengths.max() >= length)
    windows = ds.window(length, stride=stride)
    assert_sound(windows)
    step = length if stride is None else stride
    expected = [
        (i, start)
        for i, episode in enumerate(ds)
        for start in range(0, len(episode) - length + 1, step)
    ]
    assert windows.ids.tolist() == [f"{ds.ids[i]}:{start}" for i, start in expected]
    for part, (i, start) in zip(windows, expected, strict=True):
        assert_part(part, ds[i], start, length)
        assert part.group == (ds[i].id if ds.group is None else ds[i].group)


def test_windows_tile_and_share_the_state_between_them():
    ds = TrajectoryDataset.from_arrays([np.arange(8.0)[:, None]], terminated=[True])
    windows = ds.window(3)
    assert [item.states.ravel().tolist() for item in windows] == [[0, 1, 2, 3], [3, 4, 5, 6]]
    assert not windows.terminated.any()
    assert ds.window(3, stride=2).terminated.tolist() == [False, False, True]


def test_group_splits_never_part_the_windows_of_an_episode():
    ds = TrajectoryDataset.from_arrays(np.zeros((6, 21, 1)))
    windows = ds.window(4)
    for train, test in GroupKFold(3).split(windows, groups=windows.group):
        assert not {i.split(":")[0] for i in windows.ids[train]} & {
            i.split(":")[0] for i in windows.ids[test]
        }


def test_windows_of_a_bootstrap_sample_have_ids_of_their_own_but_one_group():
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 5, 1)), ids=["a", "b"])
    windows = ds[[0, 0]].window(2)
    assert windows.ids.tolist() == [0, 1, 2, 3]
    assert windows.group.tolist() == ["a"] * 4


def test_no_window_fits_or_the_request_makes_no_sense():
    ds = TrajectoryDataset.from_arrays([np.zeros((4, 1)), np.zeros((6, 1))])
    assert len(ds.window(5)) == 1
    with pytest.raises(InvalidEpisodeError, match=r"no episode has 6 steps \(the longest has 5\)"):
        ds.window(6)
    for wrong in (0, -1):
        with pytest.raises(ValueError, match=f"length == {wrong}, must be >= 1"):
            ds.window(wrong)
        with pytest.raises(ValueError, match=f"stride == {wrong}, must be >= 1"):
            ds.window(2, stride=wrong)
        with pytest.raises(ValueError, match=f"max_steps == {wrong}, must be >= 1"):
            ds.truncate(wrong)
        with pytest.raises(ValueError, match=f"k == {wrong}, must be >= 1"):
            ds.decimate(wrong)
    with pytest.raises(TypeError, match="max_steps must be an instance"):
        ds.truncate(2.5)


# -- decimate -----------------------------------------------------------------------------------


@given(seed=SEEDS, k=st.integers(1, 3))
def test_decimate_without_changes_of_theta(make_dataset, seed, k):
    ds = make_dataset(seed)
    assume(not ds.params_vary and ds.lengths.min() >= k)
    slow = ds.decimate(k)
    assert_sound(slow)
    assert slow.ids.tolist() == ds.ids.tolist()
    for part, whole in zip(slow, ds, strict=True):
        count = len(whole) // k
        for name in PER_STATE:
            if getattr(whole, name) is not None:
                expected = getattr(whole, name)[: count * k + 1 : k]
                np.testing.assert_array_equal(getattr(part, name), expected)
        if whole.actions is not None:
            np.testing.assert_array_equal(part.actions, whole.actions[: count * k : k])
        if whole.rewards is not None:
            means = [whole.rewards[j * k : j * k + k].mean() for j in range(count)]
            np.testing.assert_allclose(part.rewards, means, rtol=1e-12)
        assert (part.terminated, part.context) == (whole.terminated, whole.context)
        np.testing.assert_equal(part.params, whole.params)
    if k == 1:
        assert slow == ds


@given(
    seed=SEEDS, k=st.integers(1, 4), lengths=st.lists(st.integers(8, 20), min_size=1, max_size=4)
)
def test_a_decimated_step_never_spans_a_change_of_theta(seed, k, lengths):
    rng = np.random.default_rng(seed)
    # Stretches of at least 4 steps, so that something is left of every episode.
    theta = [np.repeat(rng.integers(0, 3, t), rng.integers(4, 7, t))[:t, None] for t in lengths]
    ds = TrajectoryDataset.from_arrays(
        [rng.normal(size=(t + 1, 1)) for t in lengths],
        params=theta,
        terminated=[True] * len(lengths),
    )
    slow = ds.decimate(k)
    assert_sound(slow)
    kept = set()
    for part in slow:
        i = int(str(part.id).split(":")[0])
        rows = np.searchsorted(ds[i].times, part.times)
        np.testing.assert_array_equal(part.states, ds[i].states[rows])
        assert (np.diff(rows) == k).all()
        for theta_kept, row in zip(by_step(part), rows, strict=False):
            assert (by_step(ds[i])[row : row + k] == theta_kept).all()
        assert part.group in (None, i)
        if part.terminated:
            assert len(ds[i]) - rows[-1] < k
        kept.add(i)
    assert kept == set(range(len(ds)))


def test_changes_on_the_grid_need_no_split_others_do():
    theta = np.array([0.0, 0, 1, 1, 1, 2, 2, 2])[:, None]
    ds = TrajectoryDataset.from_arrays(
        [np.arange(9.0)[:, None]], params=[theta], terminated=[True], ids=["a"]
    )
    assert ds.truncate(5).decimate(2).ids.tolist() == ["a"]
    np.testing.assert_array_equal(ds.truncate(5).decimate(2).step_params[:, 0], [0, 1])
    slow = ds.decimate(2)
    assert slow.ids.tolist() == ["a:0", "a:2", "a:5"]
    assert slow.group.tolist() == ["a", "a", "a"]
    assert [item.states.ravel().tolist() for item in slow] == [[0, 2], [2, 4], [5, 7]]
    assert slow.params[:, 0].tolist() == [0, 1, 2]
    assert slow.terminated.tolist() == [False, False, True]


def test_decimate_refuses_to_lose_an_episode():
    ds = TrajectoryDataset.from_arrays([np.zeros((5, 1)), np.zeros((3, 1))], ids=["a", "b"])
    with pytest.raises(InvalidEpisodeError, match="episode b is shorter than 3 steps"):
        ds.decimate(3)
    restless = TrajectoryDataset.from_arrays(
        np.zeros((1, 5, 1)), params=np.arange(4.0)[None, :, None]
    )
    with pytest.raises(InvalidEpisodeError, match="episode 0: every stretch of constant theta"):
        restless.decimate(2)
    assert restless.decimate(1) == restless


# -- resample -----------------------------------------------------------------------------------


@given(seed=SEEDS)
def test_resampling_at_its_own_dt_changes_nothing(make_dataset, seed):
    ds = make_dataset(seed, regular=True)
    same = ds.resample(ds.times[1] - ds.times[0])
    assert_sound(same)
    assert len(same) == len(ds)
    np.testing.assert_allclose(same.times, ds.times, rtol=1e-12)
    for field in ("states", "references", "actions"):
        if getattr(ds, field) is not None:
            np.testing.assert_allclose(getattr(same, field), getattr(ds, field), rtol=1e-12)
    if ds.rewards is not None:
        scale = np.abs(ds.rewards).max()
        np.testing.assert_allclose(same.rewards, ds.rewards, rtol=1e-9, atol=1e-12 * scale)
    np.testing.assert_equal(same.step_params, ds.step_params)
    for field in ("ids", "group", "terminated", "time_origin"):
        np.testing.assert_equal(getattr(same, field), getattr(ds, field))
    np.testing.assert_equal(same.context, ds.context)


def uneven(rng, n=4):
    """Episodes of irregular times with states linear in time."""
    times = [
        rng.normal() + np.cumsum(rng.uniform(0.05, 1.0, rng.integers(6, 15))) for _ in range(n)
    ]
    return TrajectoryDataset.from_arrays(
        [np.column_stack([2 * t - 1, 5 - t]) for t in times],
        times=times,
        actions=[rng.normal(size=(len(t) - 1, 1)) for t in times],
        rewards=[rng.normal(size=len(t) - 1) for t in times],
        references=[t[:, None] for t in times],
        params=rng.normal(size=(n, 1)),
        terminated=rng.random(n) < 0.5,
        time_origin=rng.normal(size=n),
    )


@given(seed=SEEDS, dt=st.floats(0.01, 1.5))
def test_resample_against_a_loop_over_times(seed, dt):
    ds = uneven(np.random.default_rng(seed))
    assume(min(item.times[-1] - item.times[0] for item in ds) > dt)
    even = ds.resample(dt)
    assert_sound(even)
    for new, old in zip(even, ds, strict=True):
        assert new.times[0] == old.times[0]
        np.testing.assert_allclose(np.diff(new.times), dt, rtol=1e-9)
        assert old.times[-1] - dt < new.times[-1] <= old.times[-1] + 1e-6 * dt
        np.testing.assert_allclose(new.states[:, 0], 2 * new.times - 1, atol=1e-5 * dt)
        np.testing.assert_allclose(new.references[:, 0], new.times, atol=1e-5 * dt)
        for t, action in zip(new.times, new.actions, strict=False):
            in_force = [old.actions[j] for j in range(len(old)) if old.times[j] <= t + 1e-6 * dt]
            np.testing.assert_array_equal(action, in_force[-1])
        for j, reward in enumerate(new.rewards):
            begin, end = new.times[j : j + 2]
            shares = np.clip(
                np.minimum(old.times[1:], end) - np.maximum(old.times[:-1], begin), 0, None
            )
            np.testing.assert_allclose(reward, shares @ old.rewards / dt, atol=1e-5)
        assert (new.terminated, new.params, new.time_origin) == (
            old.terminated,
            old.params,
            old.time_origin,
        )


def test_round_off_does_not_hold_the_previous_action_one_step_longer():
    # 0.1 added up falls short of the multiples of 0.1 by a few units in the last place.
    times = np.cumsum(np.full(101, 0.1))
    ds = TrajectoryDataset.from_arrays(
        [times[:, None]], times=[times], actions=[np.arange(100.0)[:, None]]
    )
    np.testing.assert_array_equal(ds.resample(0.1).actions, ds.actions)
    np.testing.assert_array_equal(ds.resample(0.2).actions, ds.actions[::2])


def test_resample_and_decimate_agree_on_a_uniform_log():
    rng = np.random.default_rng(0)
    ds = TrajectoryDataset.from_arrays(
        rng.normal(size=(3, 13, 2)),
        actions=rng.normal(size=(3, 12, 1)),
        rewards=rng.normal(size=(3, 12)),
        dt=0.02,
    )
    fast, slow = ds.resample(0.06), ds.decimate(3)
    for field in ("states", "times", "actions", "rewards"):
        np.testing.assert_allclose(getattr(fast, field), getattr(slow, field), atol=1e-12)


@given(seed=SEEDS, dt=st.floats(0.1, 1.2))
def test_a_resampled_step_never_spans_a_change_of_theta(seed, dt):
    rng = np.random.default_rng(seed)
    theta = [np.repeat(rng.integers(0, 3, 20), rng.integers(4, 7, 20))[:20, None] for _ in range(3)]
    ds = TrajectoryDataset.from_arrays(
        rng.normal(size=(3, 21, 1)), params=theta, dt=0.5, group=["x", "y", "z"]
    )
    even = ds.resample(dt)
    assert_sound(even)
    for part in even:
        i = int(str(part.id).split(":")[0])
        assert part.group == "xyz"[i]
        begins, ends = ds[i].times[:-1], ds[i].times[1:]
        for value, begin, end in zip(by_step(part), part.times, part.times[1:], strict=False):
            tolerance = 1e-5 * dt
            touched = (begins < end - tolerance) & (ends > begin + tolerance)
            assert (by_step(ds[i])[touched] == value).all()


def test_resample_refuses_what_has_no_answer():
    ds = TrajectoryDataset.from_arrays([np.zeros((9, 1)), np.zeros((3, 1))], ids=["a", "b"])
    with pytest.raises(InvalidEpisodeError, match=r"episode b is shorter than dt = 2\.5"):
        ds.resample(2.5)
    for wrong in (0.0, -1.0):
        with pytest.raises(ValueError, match=r"dt == .* must be > 0"):
            ds.resample(wrong)
    for wrong in (np.inf, np.nan):
        with pytest.raises(ValueError, match="must be finite"):
            ds.resample(wrong)


# -- select, noise ------------------------------------------------------------------------------


@given(seed=SEEDS, data=st.data())
def test_select_states_changes_the_states_only(make_dataset, seed, data):
    ds = make_dataset(seed)
    names = data.draw(st.lists(st.sampled_from(ds.state_names), min_size=1, unique=True))
    chosen = ds.select_states(names)
    assert_sound(chosen)
    assert chosen.state_names == tuple(names)
    for name, column in zip(names, chosen.states.T, strict=True):
        np.testing.assert_array_equal(column, ds.states[:, ds.state_names.index(name)])
    assert ds.select_states(ds.state_names) == ds
    for field in ("times", "actions", "rewards", "references", "step_params", "group"):
        np.testing.assert_equal(getattr(chosen, field), getattr(ds, field))


def test_select_states_names_what_is_wrong():
    ds = TrajectoryDataset.from_arrays(np.zeros((1, 3, 2)), state_names=["angle", "speed"])
    assert ds.select_states("speed").state_names == ("speed",)
    with pytest.raises(ValueError, match=r"'angel'.*Did you mean 'angle'\?"):
        ds.select_states(["angel"])
    for wrong in ([], ["angle", "angle"]):
        with pytest.raises(ValueError, match="at least one state, and each once"):
            ds.select_states(wrong)


@pytest.mark.parametrize("of", ["std", "range"])
def test_noise_has_the_size_asked_for_and_is_independent(of):
    rng = np.random.default_rng(0)
    states = np.concatenate([rng.uniform(-1, 1, (50, 400, 2)), np.ones((50, 400, 1))], axis=2)
    ds = TrajectoryDataset.from_arrays(states * [1.0, 50.0, 1.0], actions=np.zeros((50, 399, 1)))
    noisy = ds.add_noise(0.05, of=of, random_state=3)
    noise = noisy.states - ds.states
    spread = {"std": 1 / np.sqrt(3), "range": 2.0}[of]
    np.testing.assert_allclose(
        noise.std(axis=0), 0.05 * spread * np.array([1.0, 50.0, 0.0]), rtol=0.03, atol=1e-12
    )
    assert np.abs(noise[:, :2].mean(axis=0) / noise[:, :2].std(axis=0)).max() < 0.03
    assert np.abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 0.03
    assert np.abs(np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]) < 0.03
    assert noisy.select_states(["s2"]) == ds.select_states(["s2"])
    np.testing.assert_array_equal(noisy.actions, ds.actions)


def test_noise_is_seeded():
    ds = TrajectoryDataset.from_arrays(np.random.default_rng(0).normal(size=(3, 9, 2)))
    assert ds.add_noise(0.1, random_state=1) == ds.add_noise(0.1, random_state=1)
    assert ds.add_noise(0.1, random_state=1) != ds.add_noise(0.1, random_state=2)
    assert ds.add_noise(0.0) == ds
    with pytest.raises(ValueError, match=r"fraction == -0\.1, must be >= 0"):
        ds.add_noise(-0.1)
    with pytest.raises(ValueError, match="must be finite"):
        ds.add_noise(np.nan)
    with pytest.raises(ValueError, match="of = 'mean': choose"):
        ds.add_noise(0.1, of="mean")


# -- concatenate --------------------------------------------------------------------------------


@given(seed=SEEDS, data=st.data())
def test_cutting_and_joining_gives_the_dataset_back(make_dataset, seed, data):
    ds = make_dataset(seed)
    assume(len(ds) > 1)
    cut = data.draw(st.integers(1, len(ds) - 1))
    assert ds[:cut].concatenate(ds[cut:]) == ds
    assert concatenate(*(ds[[i]] for i in range(len(ds)))) == ds
    assert ds.concatenate() == ds


def test_ids_that_clash_are_numbered_all():
    ds = TrajectoryDataset.from_arrays(np.zeros((2, 3, 1)), ids=["a", "b"])
    assert ds.concatenate(ds).ids.tolist() == [0, 1, 2, 3]
    numbered = TrajectoryDataset.from_arrays(np.zeros((2, 3, 1)))
    assert ds.concatenate(numbered).ids.tolist() == ["a", "b", "0", "1"]
    texts = TrajectoryDataset.from_arrays(np.zeros((1, 3, 1)), ids=["0"])
    assert texts.concatenate(numbered).ids.tolist() == [0, 1, 2]


def test_constant_and_changing_theta_can_be_joined():
    constant = TrajectoryDataset.from_arrays(np.zeros((1, 3, 1)), params=[[5.0]], ids=["a"])
    changing = TrajectoryDataset.from_arrays(
        np.zeros((1, 3, 1)), params=[[[1.0], [2.0]]], ids=["b"]
    )
    both = constant.concatenate(changing)
    assert both.params_vary
    assert both.step_params[:, 0].tolist() == [5.0, 5.0, 1.0, 2.0]
    assert both[[0]] == constant


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"actions": np.zeros((2, 2, 1))}, r"differ in action_names: \[\] in the first, \['a0'\]"),
        (
            {"rewards": np.zeros((2, 2))},
            "differ in rewards: missing in the first, given in number 3",
        ),
        ({"params": np.zeros((2, 1))}, "differ in param_names"),
        ({"references": np.zeros((2, 3, 1))}, "differ in reference_names"),
        ({"state_names": ["x"]}, r"differ in state_names: \['s0'\] in the first, \['x'\]"),
        ({"group": [1, 2]}, "differ in group: text in the first, whole numbers"),
        ({"group": None}, "differ in group: text in the first, None"),
        ({"context": {"motor": ["a", "b"]}}, "differ in context"),
    ],
)
def test_datasets_of_different_fields_are_not_joined(fields, match):
    plain = {"states": np.zeros((2, 3, 1)), "group": ["x", "y"]}
    ds = TrajectoryDataset.from_arrays(**plain)
    other = TrajectoryDataset.from_arrays(**(plain | fields))
    with pytest.raises(ValueError, match=match):
        ds.concatenate(ds, other)
    with pytest.raises(TypeError, match="joins datasets, got Trajectory"):
        ds.concatenate(ds[0])


# -- assign -------------------------------------------------------------------------------


def full():
    rng = np.random.default_rng(0)
    return TrajectoryDataset.from_arrays(
        [rng.normal(size=(t + 1, 2)) for t in (3, 5)],
        actions=[rng.normal(size=(t, 1)) for t in (3, 5)],
        rewards=[rng.normal(size=t) for t in (3, 5)],
        references=[rng.normal(size=(t + 1, 1)) for t in (3, 5)],
        params=[[1.0, 2.0], [3.0, 4.0]],
        times=[np.arange(4.0) + 7, np.arange(6.0) ** 2],
        time_origin=[7.5, np.nan],
        context={"kind": ["a", "b"]},
        group=["x", "y"],
        terminated=[True, False],
        ids=["one", "two"],
        state_names=["p", "v"],
        param_names=["kp", "kd"],
        reference_names=["set"],
    )


def test_assign_replaces_what_is_named_and_nothing_else():
    ds = full()
    assert ds.assign() == ds
    other = ds.assign(params=[9.0, 8.0])
    np.testing.assert_array_equal(other.params, [[9.0, 8.0]] * 2)
    assert other.param_names == ("kp", "kd")
    assert other.assign(params=ds.params) == ds
    ramp = [np.arange(4.0)[:, None], np.arange(6.0)[:, None]]
    np.testing.assert_array_equal(ds.assign(references=ramp)[1].references, ramp[1])
    assert ds.assign(references=ramp).reference_names == ("set",)


def test_assign_renames_where_the_width_changes_and_removes_on_none():
    ds = full()
    assert ds.assign(params=[[1.0], [2.0]]).param_names == ("theta0",)
    assert ds.assign(params=[[1.0], [2.0]], param_names=["k"]).param_names == ("k",)
    bare = ds.assign(params=None, references=None, actions=None, group=None, context=None)
    assert not bare.has_params
    assert bare.references is None
    assert bare.actions is None
    assert bare.context == {}
    np.testing.assert_array_equal(bare.states, ds.states)


def test_assign_keeps_theta_by_step_and_takes_one_context_for_all():
    ds = full().assign(params=[np.arange(6.0).reshape(3, 2), np.arange(10.0).reshape(5, 2)])
    assert ds.params_vary
    assert ds.assign(group=["u", "v"]).params_vary
    assert ds.assign(context={"kind": "c"}).context["kind"].tolist() == ["c", "c"]


def test_assign_refuses_what_does_not_fit():
    ds = full()
    with pytest.raises(TypeError, match="states"):
        ds.assign(states=np.zeros((2, 4, 2)))
    with pytest.raises(InvalidEpisodeError, match="references"):
        ds.assign(references=np.zeros((2, 3, 1)))
    with pytest.raises(InvalidEpisodeError):
        ds.assign(params=[[1.0, np.nan], [1.0, 1.0]])
    for params in (5.0, [1.0, 2.0, 3.0]):
        with pytest.raises(InvalidEpisodeError, match=r"give 2 for all episodes \(kp, kd\)"):
            ds.assign(params=params)
