"""ROS parameters of the nodes, declared from the settings."""

import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
import sys
from typing import Any

from rcl_interfaces import msg
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
import yaml

from rs_relpose_ros.config.settings import Declared, Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.nodes.inputs import SHUT_DOWN

# Prefix of the parameters by which rclpy overrides the QoS of a topic. [derived: rclpy]
_QOS = 'qos_overrides.'


class NodeParameters:
    """The node's parameters; keeps them valid while it runs.

    `on_change` gets the new `Parameters` after a live one was set. Raises InputError if a value of
    the parameter file or the command line is not legal.
    """

    def __init__(self, node: Node, on_change: Callable[[Parameters], None]) -> None:
        self._node = node
        self._on_change = on_change
        values = {
            name: _declare(node, name, default, declared)
            for name, default, declared in Parameters.declarations()
        }
        given = {name: value for name, value in values.items() if value is not None}
        self.current = Parameters.from_mapping(given)
        # Names of the parameters that the user has given: a calibration does not replace them.
        self._given = set(self.current.given())
        self._adopting = False
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def adopt(self, values: Mapping[str, Any]) -> None:
        """Set the live ones among `values` that the user has not given; InputError if illegal."""
        live = {name for name, _, declared in Parameters.declarations() if declared.live}
        new = [
            Parameter(name, value=list(value) if isinstance(value, tuple) else value)
            for name, value in values.items()
            if name in live - self._given
        ]
        self._adopting = True
        try:
            result = self._node.set_parameters_atomically(new)
        finally:
            self._adopting = False
        if not result.successful:
            raise InputError(f'the calibration cannot be used: {result.reason}')

    def _validate(self, parameters: list[Parameter]) -> msg.SetParametersResult:
        """Whether the new values are legal; without side effects, as others may refuse them."""
        try:
            self.current.updated(self._known(parameters))
        except InputError as error:
            return msg.SetParametersResult(successful=False, reason=str(error))
        return msg.SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        changed = self._known(parameters)
        if changed:
            self._given |= set() if self._adopting else set(changed)
            self.current = self.current.updated(changed)
            self._on_change(self.current)

    def _known(self, parameters: list[Parameter]) -> dict[str, Any]:
        """Values of our parameters; rclpy itself handles use_sim_time and QoS overrides."""
        ours = self.current.to_mapping()
        return {p.name: _plain(p.value) for p in parameters if p.name in ours}


def unknown_overrides(node: Node) -> list[str]:
    """A warning for each parameter that was given but does not exist: ROS ignores them."""
    messages = []
    for name in getattr(node, '_parameter_overrides', {}):
        if not node.has_parameter(name) and not name.startswith(_QOS):
            try:
                Parameters().updated({name: None})
            except InputError as error:
                messages.append(str(error))
    return messages


@contextmanager
def legal_qos() -> Iterator[None]:
    """Context in which topics are opened: an illegal QoS override raises InputError."""
    try:
        yield
    except SHUT_DOWN:
        raise
    except (ParameterException, RuntimeError) as error:
        raise InputError(f'a QoS override is not legal: {error}') from error


def unknown_qos_overrides(node: Node) -> list[str]:
    """A warning for each QoS override without a subscription; call it when all are made."""
    return [
        f'{name} is no QoS override of this node: it must be {_QOS}<full topic name>'
        '.subscription.<policy>, of a topic that it subscribes to'
        for name in getattr(node, '_parameter_overrides', {})
        if name.startswith(_QOS) and not node.has_parameter(name)
    ]


def _declare(node: Node, name: str, default: Any, declared: Declared) -> Any:
    try:
        parameter = node.declare_parameter(
            name, list(default) if isinstance(default, tuple) else default, _descriptor(declared)
        )
    except ParameterException as error:
        raise InputError(f'parameter {name} must be {declared.legal}: {error}') from error
    return _plain(parameter.value)


def _descriptor(declared: Declared) -> msg.ParameterDescriptor:
    unit = f' [{declared.unit}]' if declared.unit else ''
    descriptor = msg.ParameterDescriptor(
        description=declared.description + unit,
        additional_constraints=declared.legal,
        read_only=not declared.live,
        # YAML reads "0" and "[0, 0, 0, 1]" as integers; `Parameters` checks the types.
        dynamic_typing=True,
    )
    bounds = (max(declared.low, -sys.float_info.max), min(declared.high, sys.float_info.max))
    if declared.kind is float:
        descriptor.floating_point_range = [
            msg.FloatingPointRange(from_value=bounds[0], to_value=bounds[1], step=0.0)
        ]
    elif declared.kind is int:
        limit = 2**63 - 1
        low, high = (int(min(max(bound, -limit), limit)) for bound in bounds)
        descriptor.integer_range = [msg.IntegerRange(from_value=low, to_value=high, step=1)]
    return descriptor


def _plain(value: Any) -> Any:
    if isinstance(value, str) and value.startswith('['):
        with suppress(yaml.YAMLError):  # a list of floats and integers, by `ros2 param set`
            value = yaml.safe_load(value)
    return tuple(value) if isinstance(value, list | array.array) else value
