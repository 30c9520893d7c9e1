"""Robust estimation of one frame pair: hypotheses, consensus, refinement, covariance."""
