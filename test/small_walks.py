"""Short walks with small images, which are rendered in seconds."""

from pathlib import Path

from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import write_bag


def small_walk(duration: float) -> SimulationConfig:
    """A walk of some seconds; the readout takes 20 ms and the IMU's clock is 30 ms ahead."""
    return SimulationConfig(
        duration=duration,
        width=320,
        height=240,
        fx=225.0,
        edge_samples=1,
        plan=f'walk:{duration:g}',
        readout_time=0.02,
        time_offset=0.03,
        seed=5,
    )


def bag_of(config: SimulationConfig, folder: Path) -> Path:
    """The bag of a walk in a folder."""
    bag = folder / 'bag'
    write_bag(simulate(config), bag)
    return bag
