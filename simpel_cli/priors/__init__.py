"""Priors over functions: simulator draws plus gap GP, Gaussian processes, and scales by marginal likelihood."""
