"""Covariances of unknowns of a graph of gtsam, each from one elimination of its equations.

``gtsam.Marginals`` eliminates all equations when it is made, and again for each joint covariance
of more than two unknowns.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import gtsam
import numpy as np

from rs_relpose_ros.geometry import Array


def joint_covariance(graph: Any, values: Any, keys: Sequence[int]) -> Array:
    """Covariance of some unknowns, in their order, given all factors of a graph.

    Cholesky's factors square the condition of the equations, which is too large after a loss:
    position and heading are known to decimetres then, each step to fractions of a millimetre.
    """
    linear = graph.linearize(values)
    try:
        marginal = linear.marginal(list(keys))
        information = marginal.augmentedHessian(_ordering(keys))[:-1, :-1]
        root = np.linalg.cholesky(information)
    except (RuntimeError, np.linalg.LinAlgError):
        return _covariance_by_qr(linear, values, keys)
    back = np.linalg.inv(root)
    return np.asarray(back.T @ back)


def _covariance_by_qr(linear: Any, values: Any, keys: Sequence[int]) -> Array:
    """The same from the equations themselves."""
    others = [key for key in gtsam.Values.keys(values) if key not in keys]
    A, _ = linear.jacobian(_ordering([*others, *keys]))
    zeros = values.zeroVectors()
    size = sum(len(zeros.at(key)) for key in keys)
    root = np.linalg.qr(A).R[-size:, -size:]
    back = np.linalg.inv(root)
    return np.asarray(back @ back.T)


def _ordering(keys: Iterable[int]) -> Any:
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


class _Conditional(NamedTuple):
    """An unknown given its parents: ``R x + sum S_p x_p`` is noise of unit variance."""

    key: int
    parents: list[int]
    R: Array  # (n, n), upper triangular
    S: Array  # (n, m), of all parents one after the other


class CommonCovariances:
    """Covariances of unknowns that a factor has in common, for all factors of a graph.

    The elimination gives each unknown by those that are eliminated after it and have factors in
    common with it, its parents: ``x = G x_parents + R^-1 e`` with unit noise e. From the last
    unknown back to the first one, the covariance with the parents follows from theirs,

        cov(x, parents) = G cov(parents)    cov(x) = G cov(parents) G^T + R^-1 R^-T

    which needs no other covariances, as the parents are parents of each other (K. Takahashi, J.
    Fagan and M. Chen, *Formation of a Sparse Bus Impedance Matrix and its Application to Short
    Circuit Study*, PICA 1973).
    """

    def __init__(self, graph: Any, values: Any) -> None:
        """`graph`: of gtsam, linearised at `values`."""
        self._blocks: dict[tuple[int, int], Array] = {}
        net = graph.linearize(values).eliminateSequential()
        for number in reversed(range(net.size())):
            self._add(_conditional(net.at(number)))

    def _add(self, one: _Conditional) -> None:
        back = np.linalg.inv(one.R)
        covariance = back @ back.T
        if one.parents:
            by_parents = -back @ one.S
            with_parents = by_parents @ self.of(one.parents)
            covariance += with_parents @ by_parents.T
            column = 0
            for parent in one.parents:
                width = len(self._blocks[parent, parent])
                block = with_parents[:, column : column + width]
                self._blocks[one.key, parent] = block
                self._blocks[parent, one.key] = block.T
                column += width
        self._blocks[one.key, one.key] = covariance

    def of(self, keys: Sequence[int]) -> Array:
        """Covariance of some unknowns, in their order."""
        rows = [np.hstack([self._blocks[row, column] for column in keys]) for row in keys]
        return np.vstack(rows)


def _conditional(conditional: Any) -> _Conditional:
    """A conditional of gtsam, whose equations have unit noise."""
    key, *parents = conditional.keys()
    R, S = conditional.R(), conditional.S()
    model = conditional.get_model()
    if model is not None:
        precision = 1.0 / model.sigmas()[:, None]
        R, S = precision * R, precision * S
    return _Conditional(key, parents, R, S)
