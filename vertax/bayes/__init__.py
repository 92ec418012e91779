"""Posteriors: how well data determine the parameters, by the samplers of BlackJAX."""

from vertax._base.extras import requires_extra as _requires_extra

with _requires_extra("bayes", "Sampling a posterior"):
    from vertax.bayes._evidence import evidence as evidence
    from vertax.bayes._laplace import Laplace as Laplace
    from vertax.bayes._log_posterior import LogPosterior as LogPosterior
    from vertax.bayes._posterior import Posterior as Posterior
    from vertax.bayes._sample import sample as sample
