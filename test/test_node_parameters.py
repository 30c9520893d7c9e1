"""Every parameter of the node, set as `ros2 param set` does: legal, illegal, live or read-only."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from rs_relpose_ros.config.declarations import Declared
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.node.params import NodeParameters

DECLARATIONS = {name: declared for name, _, declared in Parameters.declarations()}
DEFAULTS = {name: default for name, default, _ in Parameters.declarations()}
LIVE = [name for name, declared in DECLARATIONS.items() if declared.live]


@pytest.fixture(scope='module')
def node(module_ros_domain_id: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node('parameters', context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


@pytest.fixture(scope='module')
def changes() -> list[Parameters]:
    return []


@pytest.fixture(scope='module')
def parameters(node: Node, changes: list[Parameters]) -> NodeParameters:
    return NodeParameters(node, changes.append)


def illegal_values(name: str, declared: Declared) -> Iterator[Any]:
    """Of another type, and beyond each bound."""
    yield 5 if declared.kind is str else 'five'
    if declared.choices:
        yield 'none of them'
    if declared.kind is float:
        yield float('nan')
        yield from (bound + step for bound, step in ((declared.low, -1.0), (declared.high, 1.0))
                    if abs(bound) < 1e12)
    if declared.kind is int:
        yield int(declared.low) - 1
        yield int(declared.high) + 1


def other_value(name: str, declared: Declared) -> Any:
    """A legal one that is not the default."""
    if declared.kind is bool:
        return not DEFAULTS[name]
    middle = 0.3 * declared.low + 0.7 * declared.high
    assert declared.kind in (float, int), name
    return declared.kind(middle)


@pytest.mark.parametrize('name', DECLARATIONS)
def test_an_illegal_value_is_refused_with_its_reason(node, parameters, changes, name):
    before = len(changes)
    for value in illegal_values(name, DECLARATIONS[name]):
        [result] = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful, value
        assert name in result.reason, result.reason
        assert result.reason.count('\n') == 0
    assert (parameters.current, len(changes)) == (Parameters(), before)


@pytest.mark.parametrize('name', sorted(DECLARATIONS.keys() - set(LIVE)))
def test_what_the_node_was_built_with_is_read_only(node, parameters, name):
    value = DEFAULTS[name]
    if value is None:
        value = {'readout_time': 0.02, 'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0),
                 'camera_matrix': (5.0, 0.0, 2.0, 0.0, 5.0, 2.0, 0.0, 0.0, 1.0),
                 'distortion_coefficients': (0.1, 0.0, 0.0, 0.0)}[name]
    value = list(value) if isinstance(value, tuple) else value
    [result] = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert 'read-only' in result.reason


@pytest.mark.parametrize('name', LIVE)
def test_a_live_parameter_is_handed_on(node, parameters, changes, name):
    value, before = other_value(name, DECLARATIONS[name]), len(changes)
    assert value != DEFAULTS[name]
    [result] = node.set_parameters([Parameter(name, value=value)])
    assert result.successful, result.reason
    assert len(changes) == before + 1
    assert changes[-1] is parameters.current
    assert parameters.current.to_mapping() == {**Parameters().to_mapping(), name: value}
    assert node.get_parameter(name).value == value
    [result] = node.set_parameters([Parameter(name, value=DEFAULTS[name])])
    assert result.successful
    assert parameters.current == Parameters()


def test_several_at_once_are_all_set_or_none(node, parameters):
    result = node.set_parameters_atomically([
        Parameter('threshold', value=1.5), Parameter('min_inliers', value=1)])
    assert not result.successful
    assert 'min_inliers' in result.reason
    assert parameters.current == Parameters()


def test_a_parameter_cannot_be_taken_away(node, parameters):
    [result] = node.set_parameters([Parameter('threshold', Parameter.Type.NOT_SET)])
    assert not result.successful
    assert 'threshold' in result.reason
    assert parameters.current == Parameters()
