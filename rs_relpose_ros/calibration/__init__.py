"""Calibration: model, fit and posterior of the deviations, and the findings about them."""
