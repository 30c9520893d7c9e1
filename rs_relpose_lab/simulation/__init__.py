"""Simulated recordings: rolling-shutter images and IMU along a known motion."""

from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.simulation import simulate, Simulation

__all__ = ['Simulation', 'SimulationConfig', 'simulate']
