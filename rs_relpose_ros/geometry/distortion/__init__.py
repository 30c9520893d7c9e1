"""Lens distortion: a module for each model, and the registry of all (`models`)."""
