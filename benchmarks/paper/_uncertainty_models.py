"""Models whose uncertainty is compared, by name, and the forecasts that each fit gives."""

from dataclasses import dataclass, field
from typing import Any

from benchmarks.paper._models import QUICK_STEPS, build
from trajlearn import GPRegressor, OneStepRegressor, TransitionRelabeler

#: Rows behind an exact Gaussian process; the sparse one takes all.
GP_ROWS = 800
GP_SPARSE = {"n_inducing": 100, "max_fit_rows": 1500}
#: Particles behind a standard deviation that is sampled; a Gaussian process has `GP_PARTICLES`.
PARTICLES = {"full": 20, "quick": 10}
GP_PARTICLES = 10
#: Episodes for calibration and test, of the forecasts that have all of them.
CALIBRATION = {"full": 200, "quick": 60}
TEST = {"full": 1000, "quick": 100}


@dataclass(frozen=True)
class Variant:
    """One way to forecast with a fitted model.

    Attributes
    ----------
    name : str
        In tables and legends.
    parameters : dict
        Of the estimator, set before the forecast.
    actions : {"auto", "logged"}
    most : int, optional
        Episodes of calibration and of test at most, where a forecast is dear.
    task : str, optional
        The only one where it can be afforded.
    """

    name: str
    parameters: dict[str, Any] = field(default_factory=dict)
    actions: str = "auto"
    most: int | None = None
    task: str | None = None

    def sizes(self, mode: str) -> tuple[int, int]:
        """Episodes for calibration and test."""
        n, m = CALIBRATION[mode], TEST[mode]
        return (n, m) if self.most is None else (min(n, self.most), min(m, self.most))

    def particles(self, mode: str) -> int | None:
        """Particles behind a standard deviation; None where no particles are drawn."""
        sampled = self.name.startswith(("P", "GP", "LSTM"))
        if not sampled or self.parameters.get("propagation") in ("moment", "unscented"):
            return None
        return int(self.parameters.get("n_particles", PARTICLES[mode]))


#: What each fit is asked for: all variants of one entry share it.
VARIANTS = {
    "P": [Variant("P"), Variant("P, logged actions", actions="logged", most=200)],
    "PE": [
        Variant("PE"),
        Variant("PE, logged actions", actions="logged", most=200),
    ],
    "PE, propagated": [
        Variant("PE, ts1", {"propagation": "ts1"}, most=100),
        Variant("PE, expectation", {"propagation": "expectation"}, most=100),
        Variant("PE, moment", {"propagation": "moment"}, most=100),
        Variant("PE, unscented", {"propagation": "unscented"}, most=100),
    ],
    "GP, exact": [Variant("GP, exact", {"n_particles": GP_PARTICLES}, most=20)],
    "GP, sparse": [
        Variant("GP, sparse", {"n_particles": GP_PARTICLES}, most=100),
        # the exact moments take time in proportion to the inducing points and states, squared
        Variant("GP, sparse, moment", {"propagation": "moment"}, most=40, task="cartpole"),
    ],
    "LSTM": [Variant("LSTM")],
    "TP": [Variant("TP")],
    "TPE": [Variant("TPE")],
    "T": [Variant("T")],
}
#: Fits of the simulated quadrotor.
FLYING = ["P", "PE", "TPE", "T"]
QUICK = ["P", "PE", "LSTM", "TP", "T"]
#: Variants that small sets of calibration episodes are tried on.
SMALL = ["PE", "T"]
#: How the models are called in text.
DESCRIPTIONS = {
    "P": "one network of one step with a Gaussian output, trained on the beta-likelihood (beta "
    "0.5); particles (TSinf), actions recomputed by the policy",
    "P, logged actions": "the same fit; it replays the actions of the log, which a planner would "
    "not know",
    "PE": "an ensemble of five such networks",
    "PE, logged actions": "the same fit, replaying the log",
    "PE, ts1": "the same fit, as are the next three: particles that draw a member at every step",
    "PE, expectation": "particles that draw from one Gaussian of all members",
    "PE, moment": "a Gaussian a member, propagated by the slopes of the step",
    "PE, unscented": "a Gaussian a member, propagated by sigma points",
    "GP, exact": f"a Gaussian process of one step on {GP_ROWS:,} rows",
    "GP, sparse": f"the same with {GP_SPARSE['n_inducing']} inducing points on all rows, its "
    f"hyper-parameters found on {GP_SPARSE['max_fit_rows']:,} of them",
    "GP, sparse, moment": "the same fit with the exact moments instead of particles",
    "LSTM": "a recurrent network with a Gaussian output, trained on the beta-likelihood (beta 0.5)",
    "TP": "one trajectory network trained on the plain likelihood, as in the paper",
    "TPE": "an ensemble of five trajectory networks, trained on the beta-likelihood (beta 0.5): "
    "it differs from TP in the likelihood, too",
    "T": "one trajectory network trained on the squared error, and a second one for the variance "
    "of its residuals",
}


def estimator_of(fit: str, policy: Any, *, mode: str, seed: int) -> Any:
    """Estimator of an entry of `VARIANTS`, with our settings."""
    if fit.startswith("GP"):
        exact = "exact" in fit
        learner = GPRegressor(
            max_exact=GP_ROWS, n_restarts=0, max_iter=50, **({} if exact else GP_SPARSE)
        )
        rows = TransitionRelabeler(max_rows=GP_ROWS if exact else None)
        return OneStepRegressor(learner, relabeler=rows, policy=policy, random_state=seed)
    if fit == "LSTM":
        model = build("LSTM", "default", policy=policy, mode=mode, seed=seed)
        return model.set_params(probabilistic=True, n_particles=PARTICLES[mode])
    if fit.startswith("P"):
        model = build("PE", "default", policy=policy, mode=mode, seed=seed)
        members = 1 if fit == "P" else 5
        return model.set_params(n_particles=PARTICLES[mode], estimator__n_members=members)
    model = build("T", "default", policy=policy, mode=mode, seed=seed)
    if mode == "quick":
        # beside the mean, a variance has to be learnt
        model.set_params(estimator__max_steps=2 * QUICK_STEPS)
    return model.set_params(**_OF_T[fit])


_OF_T: dict[str, dict[str, Any]] = {
    "TP": {"estimator__probabilistic": True, "estimator__nll_beta": 0.0},
    "TPE": {"estimator__probabilistic": True, "estimator__n_members": 5},
    "T": {"estimator__probabilistic": "separate"},
}
