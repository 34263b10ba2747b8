"""How a one-step model carries its uncertainty along a roll-out.

A learner with a mean and a variance for one step, in E members, says nothing yet about the
tenth step: that takes a rule for what the members stand for and for how a spread of states goes
through the next step. `OneStepRegressor` has five, chosen by ``propagation=``. It is read when a
forecast is made: ``model.set_params(propagation="moment")`` changes the next one, without a fit.

============= ================================ ============================= ====================
propagation   a state at a step is             members                       evaluations a step
============= ================================ ============================= ====================
expectation   particles                        averaged: one Gaussian with   n_particles * E
                                               their mean and total
                                               variance, drawn from anew
ts1           particles                        one drawn for each particle   n_particles
                                               at every step
tsinf         particles                        one for each particle,        n_particles
                                               to the end
moment        a Gaussian a member              each its own, to the end      (2 d + 1) * E
unscented     a Gaussian a member              each its own, to the end      (2 d + 1) * E
============= ================================ ============================= ====================

Evaluations are rows of one member, for each start; d is the number of states (with the action
before among the inputs, of both). Linear algebra and the policy come on top.

The five agree on one step: mean and variance are those of the mixture of all members. From then on

- "tsinf" takes a member for a hypothesis about the plant, which is right or wrong for the whole
  forecast [1]_. Where members disagree about a drift, the spread grows in proportion to time.
- "ts1" [1]_ and "expectation" take the difference of the members for noise, which is another at
  every step: the spread grows with the root of time. "ts1" keeps the shape of their mixture,
  "expectation" its first two moments.
- "moment" propagates mean and covariance through the slopes of the learned mean at the mean, and
  adds the learned variance there [3]_: right for small spreads of smooth maps. Slopes are central
  differences of the whole step (policy, features, learner), 1/1000 of the training range to each
  side: any learner will do, but the slope of a forest of trees is zero, and where an actuator
  saturates the slope at the mean is that of no control at all, so that the spread of an unstable
  plant grows without end: particles know better.
- With a `GPRegressor` with the RBF kernel as learner, "moment" is the exact mean and covariance
  of the GP at a Gaussian input [2]_, with the uncertainty about the function in it: PILCO's
  model. Policy and scaling enter by their slopes. Those of the scalers' defaults are exact, those
  of features and of a policy that is not linear are not.
- "unscented" sends 2 d + 1 sigma points through the step [4]_ and takes mean and covariance of
  what comes out, with the learned variance averaged over them: right for the mean of a quadratic
  map, and blind to what is between the points. Their weights (`filterpy`'s
  `MerweScaledSigmaPoints` with alpha 1, beta 0, kappa max(3 - d, 0)) are never negative.

The particles are random: mean and variance of S of them are off by about 1 / sqrt(S) of the
spread. The Gaussians are not, but a distribution that splits or folds is no Gaussian.

The `mean` of a forecast never depends on what else is asked for. With particles it is one
roll-out that averages the members at every step; with "moment" and "unscented" it is the mean of
what is propagated, which a spread may shift (for a learner without a standard deviation, the
spread is taken to be zero). A policy that acts on noisy measurements
(``policy_sees="measurements"``) shifts it, too: the mean is then that of particles that differ by
what the policy sees, which are the same in every forecast. `std` comes from the particles or,
with "moment" and "unscented", from the mean of the members' covariances and the covariance of
their means. `samples` are whole paths, joint over time: the particles, or, with "moment" and
"unscented", draws of a member and then, step by step, of a Gaussian given the step before. For a
linear Gaussian system they have the distribution of the system itself.

A mean that leaves 1e6 training ranges is infinite from there on; a covariance that does, or a
particle, makes `std` infinite and leaves the mean. ``clip_states=`` clips particles, sampled paths
and what the learner predicts for the points of a Gaussian, but not the noise in its `std`.

References
----------
.. [1] K. Chua et al., "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
   Dynamics Models", NeurIPS 2018.
.. [2] M. P. Deisenroth and C. E. Rasmussen, "PILCO: A Model-Based and Data-Efficient Approach to
   Policy Search", ICML 2011.
.. [3] A. Girard et al., "Gaussian Process Priors with Uncertain Inputs: Application to
   Multiple-Step Ahead Time Series Forecasting", NeurIPS 2003.
.. [4] S. J. Julier and J. K. Uhlmann, "Unscented Filtering and Nonlinear Estimation", Proceedings
   of the IEEE 2004.
"""

__all__ = ["BY_GAUSSIANS", "PROPAGATIONS"]

BY_GAUSSIANS = frozenset({"moment", "unscented"})
PROPAGATIONS = BY_GAUSSIANS | {"expectation", "ts1", "tsinf"}
