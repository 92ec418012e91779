"""Posteriors: how well data determine the parameters, by the samplers of BlackJAX."""

from vertax._base.extras import requires_extra as _requires_extra

with _requires_extra("bayes", "Sampling posteriors"):
    from vertax.bayes._log_posterior import LogPosterior as LogPosterior
