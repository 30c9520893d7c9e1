"""Minimal solvers: the paper's five algorithms and the global-shutter 5-point."""
