"""A node that may have threads of its own beside the executor."""

from __future__ import annotations

from abc import abstractmethod

from rclpy.node import Node


class StoppableNode(Node):
    """What `run_node` runs."""

    @abstractmethod
    def stop(self) -> bool:
        """End what runs beside the executor; whether it did. Call it before `destroy_node`."""
