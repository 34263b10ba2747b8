"""The regimes, as data: what was logged, how well, how much of it, and by which controller."""

from dataclasses import dataclass

#: What a forecaster knows of the controller: its law, or nothing but the logged actions.
POLICIES = ("known", "unknown")


@dataclass(frozen=True)
class Regime:
    """One kind of log of one system.

    Attributes
    ----------
    name : str
        Unique within the system.
    system : {"cartpole", "reacher", "quadrotor", "flights"}
    gains : str
        Kind of cartpole, see `Cartpole`.
    noise : float
        Standard deviation of the measurement noise, as a fraction of that of each state (of the
        range of each state on the reacher).
    process : float
        The same of what every step adds to the state.
    acts_on_noise : bool
        Whether the controller acted on the noisy states that are logged, or on the true ones.
    n_train : int
        Training episodes.
    length : int
        Control steps of an episode.
    every : int
        Control steps from one logged state to the next.
    states : tuple of str
        Those that are logged; all if empty.
    policies : tuple of str
        Of `POLICIES`, those that make sense.
    """

    name: str
    system: str = "cartpole"
    gains: str = "stable"
    noise: float = 0.0
    process: float = 0.0
    acts_on_noise: bool = False
    n_train: int = 100
    length: int = 200
    every: int = 1
    states: tuple[str, ...] = ()
    policies: tuple[str, ...] = POLICIES


_CARTPOLE = (
    Regime("clean"),
    Regime("noise 1 %", noise=0.01),
    Regime("noise 3 %", noise=0.03),
    Regime("noise 10 %", noise=0.1),
    Regime("noise 30 %", noise=0.3),
    Regime("process .02", process=0.02),
    Regime("process .05", process=0.05),
    Regime("noise 3 %, process .02", noise=0.03, process=0.02),
    Regime("5 episodes", n_train=5),
    Regime("20 episodes", n_train=20),
    Regime("20 episodes, noise 3 %", n_train=20, noise=0.03),
    # without velocities the controller's law cannot be evaluated
    Regime("positions only", states=("x", "theta"), policies=("unknown",)),
    Regime("positions, noise 1 %", noise=0.01, states=("x", "theta"), policies=("unknown",)),
    Regime("logged every 5", every=5),
    Regime("logged every 10", every=10),
    Regime("acts on noise 3 %", noise=0.03, acts_on_noise=True),
    Regime("acts on noise 10 %", noise=0.1, acts_on_noise=True),
    Regime("periodic", gains="periodic"),
    # without limits, so that no episode ends early and none is selected
    Regime("unstable", gains="unstable", length=30),
)
_REACHER = {"system": "reacher", "length": 500}
_QUADROTOR = {"system": "quadrotor", "length": 500}
_OTHERS = (
    Regime("clean", **_REACHER),
    Regime("noise 1 %", noise=0.01, policies=("known",), **_REACHER),
    Regime("noise 3 %", noise=0.03, policies=("known",), **_REACHER),
    Regime("20 episodes", n_train=20, policies=("known",), **_REACHER),
    Regime("clean", policies=("known",), **_QUADROTOR),
    Regime("noise 3 %", noise=0.03, policies=("known",), **_QUADROTOR),
    # one fold of the flights a seed; what flies them is not known
    Regime("real flights", "flights", policies=("unknown",)),
)

#: In the order in which they are run.
REGIMES = {(regime.system, regime.name): regime for regime in (*_CARTPOLE, *_OTHERS)}
SYSTEMS = ("cartpole", "reacher", "quadrotor", "flights")
#: Seeds on which rules and settings were developed, and those that nothing was tried on.
DEVELOPMENT, FRESH = (10,), (33, 34, 35)
#: Regimes of the quick mode, of the cartpole.
QUICK = ("clean", "noise 3 %", "20 episodes, noise 3 %")
