"""Calibration of a recording: reading, steps, results and their files."""
