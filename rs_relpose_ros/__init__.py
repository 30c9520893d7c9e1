"""Relative pose of two rolling-shutter images, aided by an IMU."""
