"""Readout time, clock offset, axes, gyro bias and focal length from tracks and a gyro."""
