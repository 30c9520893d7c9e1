"""Covariances of a graph: against ``gtsam.Marginals``, and where its equations are bad."""

import gtsam
from gtsam.symbol_shorthand import B, L, V, X
import numpy as np
import pytest

from rs_relpose_ros.odometry.marginals import CommonCovariances, joint_covariance

KEYFRAMES = 8
# Values of the three unknowns of a keyframe, and of the one that all have in common.
SIZES = {X: 6, V: 3, B: 6, L: 4}


def graph_of_keyframes(rng, loop=(), *, rows=24, scale=1.0):
    """Linear factors of keyframes in a row, with a common unknown.

    `rows`: of the factor of two keyframes; with 15 they leave the first keyframe free. `scale`: of
    the factor of the first keyframe.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(L(0), rng.normal(size=SIZES[L]))
    keys = {k: [letter(k) for letter in (X, V, B)] for k in range(KEYFRAMES)}
    for own in keys.values():
        for key, letter in zip(own, (X, V, B), strict=True):
            values.insert(key, rng.normal(size=SIZES[letter]))
    for k, own in keys.items():
        after = keys.get(k + 1)
        if after is not None:
            graph.add(linear_factor([*own, *after, L(0)], rng, values, rows))
    for first, second in loop:
        graph.add(linear_factor([X(first), X(second), L(0)], rng, values, rows=5))
    graph.add(linear_factor([*keys[0], L(0)], rng, values, rows=19, scale=scale))
    return graph, values


def linear_factor(keys, rng, values, rows, scale=1.0):
    sizes = [len(values.atVector(key)) for key in keys]
    whole = 0.2 * rng.normal(size=(rows, sum(sizes)))
    whole += np.eye(*whole.shape, k=SIZES[X] + SIZES[V] + SIZES[B]) - np.eye(*whole.shape)
    parts = np.split(scale * whole, np.cumsum(sizes)[:-1], axis=1)
    blocks = [np.asfortranarray(part) for part in parts]

    def error(_, values, jacobians):
        if jacobians is not None:
            for number, block in enumerate(blocks):
                jacobians[number] = block
        return sum(block @ values.atVector(key) for key, block in zip(keys, blocks, strict=True))

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), keys, error)


def by_gtsam(graph, values, keys):
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(keys)
    return np.block([[joint.at(a, b) for b in keys] for a in keys])


@pytest.mark.parametrize('loop', [(), ((1, 6), (2, 7), (1, 4))])
def test_common_covariances_are_those_of_all_factors(loop):
    graph, values = graph_of_keyframes(np.random.default_rng(3), loop)
    covariances = CommonCovariances(graph, values)
    for k in range(KEYFRAMES):
        keys = [X(k), V(k), B(k), L(0)]
        expected = by_gtsam(graph, values, keys)
        np.testing.assert_allclose(covariances.of(keys), expected, rtol=1e-9, atol=1e-11)
    for first, second in loop:  # a loop is a factor, too
        keys = [X(second), X(first)]
        expected = by_gtsam(graph, values, keys)
        np.testing.assert_allclose(covariances.of(keys), expected, rtol=1e-9, atol=1e-11)


def test_the_covariance_of_unknowns_without_a_common_factor():
    graph, values = graph_of_keyframes(np.random.default_rng(4))
    keys = [V(6), X(1), L(0)]
    expected = by_gtsam(graph, values, keys)
    np.testing.assert_allclose(
        joint_covariance(graph, values, keys), expected, rtol=1e-9, atol=1e-11
    )


def test_the_covariance_of_equations_whose_squares_are_singular():
    """The first keyframe is known a hundred million times worse than the steps."""
    graph, values = graph_of_keyframes(np.random.default_rng(5), rows=15, scale=1e-8)
    last = KEYFRAMES - 1
    keys = [X(last), V(last), B(last), L(0)]
    with pytest.raises(RuntimeError):
        gtsam.Marginals(graph, values)
    ordering = gtsam.Ordering()
    others = [key for key in gtsam.Values.keys(values) if key not in keys]
    for key in [*others, *keys]:
        ordering.push_back(key)
    A, _ = graph.linearize(values).jacobian(ordering)
    size = sum(SIZES.values())
    back = np.linalg.inv(A)[-size:]  # as many equations as unknowns
    expected = back @ back.T
    found = joint_covariance(graph, values, keys)
    sigmas = np.sqrt(np.diag(expected))
    apart = (found - expected) / np.outer(sigmas, sigmas)
    assert np.abs(apart).max() < 1e-5
