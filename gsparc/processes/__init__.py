"""Gaussian processes: priors whose covariance terms add, conditioned on rows."""
