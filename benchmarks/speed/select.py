"""What it costs to choose: a `HorizonSelector` beside its default members, each fitted by itself.

The logs are of the cartpole with measurement noise (3 % of the spread of each state), with its
controller known, or learned from the log. A fit of the selector judges the members on held-out
episodes and fits them on all; with `race` those leave early that are surely behind.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sklearn.base import clone

from benchmarks.speed._command import (
    Columns,
    Row,
    command_line,
    duration,
    one_thread,
    quartiles,
    result,
    times,
)
from benchmarks.speed._timing import Case, measure
from trajlearn import Cartpole, HorizonSelector, TrajectoryDataset
from trajlearn.dynamics._selection.default_members import default_members

NAME = "select"
GOAL = "1.5x"
NOISE = 0.03

COLUMNS: Columns = {
    "controller": lambda row: row["controller"],
    "what": lambda row: row["case"],
    "a fit": lambda row: duration(row["seconds"]),
    "of single fits": lambda row: times(row["ratio"]),
    "quartiles": quartiles,
    "goal": lambda row: row["goal"],
}


@dataclass(frozen=True)
class Effort:
    """How much to run; `max_steps` is that of every network, None its own choice."""

    rounds: int
    episodes: int
    n_steps: int
    max_steps: int | None = None
    controllers: Sequence[str] = ("known", "learned")


EFFORT = {
    "quick": Effort(rounds=1, episodes=20, n_steps=60, max_steps=150),
    "full": Effort(rounds=3, episodes=100, n_steps=200),
}


def run(mode: str, effort: Effort) -> dict[str, Any]:
    """Time the single fits in a row, and the selector with and without a race."""
    env = Cartpole()
    ds = env.collect(effort.episodes, effort.n_steps, random_state=0)
    ds = ds.add_noise(NOISE, of="std", random_state=1)
    rows: list[Row] = []
    with one_thread():
        for controller in effort.controllers:
            policy = env.policy if controller == "known" else "clone"
            members = _members(ds, policy, effort.max_steps)
            cases = [
                Case("single fits", _singles(members, ds)),
                Case("HorizonSelector", _selector(members, ds, race=True), goal=GOAL),
                Case("HorizonSelector, race=False", _selector(members, ds, race=False)),
            ]
            # a first fit is as fast as the next
            labels = {"controller": controller}
            rows += measure(cases, rounds=effort.rounds, warm=False, **labels)
    return result(NAME, mode, rows, asdict(effort) | {"noise": NOISE})


def _members(ds: TrajectoryDataset, policy: Any, max_steps: int | None) -> list[tuple[str, Any]]:
    members = default_members(ds, policy=policy)
    for _, member in members:
        if max_steps is not None and "estimator__max_steps" in member.get_params():
            member.set_params(estimator__max_steps=max_steps)
        member.set_params(random_state=0)
    return members


def _singles(members: list[tuple[str, Any]], ds: TrajectoryDataset) -> Callable[[], object]:
    return lambda: [clone(member).fit(ds) for _, member in members]


def _selector(
    members: list[tuple[str, Any]], ds: TrajectoryDataset, *, race: bool
) -> Callable[[], object]:
    return lambda: HorizonSelector(members, race=race, random_state=0).fit(ds)


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    command_line(NAME, __doc__ or "", run, EFFORT, COLUMNS, argv)


if __name__ == "__main__":
    main()
