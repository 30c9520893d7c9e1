"""Calibrations of one camera from several recordings, and how well they repeat.

A parameter of recording i is ``theta_i = mu + u_i + e_i + M_i d``: u_i varies between recordings
with the variance T, e_i is the error of the fit with the covariance S_i, and d are the doubts of
what is not estimated, which all recordings share. T is that of R. DerSimonian and N. Laird,
Controlled Clinical Trials 7, 1986. The estimate is the weighted mean with ``(S_i + T)^-1``; its
covariance is that for another recording of the camera, so that it contains T and the doubts, which
are unknowns with a prior.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.calibration import model
from rs_relpose_ros.calibration.errors import of_few_groups
from rs_relpose_ros.calibration.fit import block_of, Fit, Flags
from rs_relpose_ros.calibration.model import GLOBAL, ROTATION
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3


class Repeated(NamedTuple):
    """The calibration that several recordings have in common."""

    fit: Fit  # that of the reference, with common parameters and their covariance
    between: Array  # (GLOBAL,) 1 sigma of the variation between recordings


class _Own(NamedTuple):
    """What N recordings say, each of its own, about the common parameters."""

    values: Array  # (N, GLOBAL)
    scatters: Array  # (N, GLOBAL, GLOBAL) covariance of each without the doubts
    # (N, GLOBAL, GLOBAL) the same by the Hessian with the prior, scaled: without the doubts, what
    # only the prior determines has no variance, and no inverse.
    shapes: Array
    by_doubt: Array  # (N, GLOBAL, m)
    free: Flags  # (N, GLOBAL) parameters that were fitted


def combined(
    fits: Sequence[Fit], lenses: Array, reference: int, intervals: Array | None = None
) -> Repeated:
    """Combine at least two fits; `lenses` (N, 9) are the lenses about which each was fitted.

    `intervals` (N,) are the median intervals between frames [s], at which the offset of each fit
    is. The offset of the result is that at the interval of `reference`, and its lens is about that
    of `reference`. A prior counts in each fit: it pulls the mean no more than it pulled one of
    them.
    """
    R_first = fits[0].unknowns.R_cam_imu
    own = _own(fits, lenses, R_first)
    if intervals is not None:
        own = _at_interval(own, intervals[reference] - intervals)
    between = _between(own)
    H, gradient, gains = _normal_equations(own, between)
    doubts = own.by_doubt.shape[2]
    free = np.asarray(own.free.any(axis=0))
    whole = block_of(np.append(free, np.ones(doubts, dtype=bool)))
    inverse = np.zeros_like(H)
    inverse[whole] = np.linalg.inv(H[whole])
    shares = (inverse @ gains)[:, :GLOBAL]
    scatters = shares @ (own.scatters + between) @ shares.transpose(0, 2, 1)
    by_doubt = inverse[:GLOBAL, GLOBAL:]
    covariance = scatters.sum(axis=0) + by_doubt @ by_doubt.T + between
    mean = (inverse @ gradient)[:GLOBAL]
    fit = _moved(fits[reference], mean, R_first, lenses[reference], covariance, free)
    return Repeated(fit, np.sqrt(np.diag(between)))


def _normal_equations(own: _Own, between: Array) -> tuple[Array, Array, list[Array]]:
    """Hessian, gradient, and the part of each recording in the latter by its parameters.

    The unknowns are the common parameters and the doubts, whose prior is their sigma of 1.
    """
    doubts = own.by_doubt.shape[2]
    size = GLOBAL + doubts
    H = np.zeros((size, size))
    H[GLOBAL:, GLOBAL:] = np.eye(doubts)
    gradient = np.zeros(size)
    gains = []
    for value, shape, by_doubt, fitted in zip(
        own.values, own.shapes, own.by_doubt, own.free, strict=True
    ):
        weight = np.zeros((GLOBAL, GLOBAL))
        block = block_of(fitted)
        weight[block] = np.linalg.inv((shape + between)[block])
        design = np.hstack([np.eye(GLOBAL), by_doubt])
        gain = design.T @ weight
        gains.append(gain)
        H += gain @ design
        gradient += gain @ value
    return H, gradient, gains


def _own(fits: Sequence[Fit], lenses: Array, R_first: Array) -> _Own:
    """Parameters of all fits about one lens and one rotation."""
    values = np.array([one.unknowns.parameters for one in fits])
    values[:, model.LENS] += lenses
    for value, one in zip(values, fits, strict=True):
        turn = one.unknowns.R_cam_imu @ R_first.T
        value[ROTATION] = log_so3(np.ascontiguousarray(turn))
    scatters = [one.covariance - one.by_doubt @ one.by_doubt.T for one in fits]
    shapes = map(_shape, fits, scatters)
    return _Own(
        values,
        np.array(scatters),
        np.array(list(shapes)),
        np.array([one.by_doubt for one in fits]),
        np.array([one.free for one in fits]),
    )


def _shape(one: Fit, scatter: Array) -> Array:
    """Inverse of the Hessian with the prior, scaled to the variances of the scatter."""
    shape = np.zeros((GLOBAL, GLOBAL))
    information = one.information + one.problem.prior[one.block]
    inverse = np.linalg.inv(information)
    ratios = np.diag(scatter[one.block]) / np.diag(inverse)
    shape[one.block] = float(np.median(ratios)) * inverse
    return shape


def _at_interval(own: _Own, longer: Array) -> _Own:
    """The offsets at intervals that are `longer` (N,) [s]."""
    moved = np.tile(np.eye(GLOBAL), (len(longer), 1, 1))
    moved[:, model.OFFSET, model.SLOPE] = longer
    return own._replace(
        values=np.einsum('nij,nj->ni', moved, own.values),
        scatters=moved @ own.scatters @ moved.transpose(0, 2, 1),
        shapes=moved @ own.shapes @ moved.transpose(0, 2, 1),
        by_doubt=moved @ own.by_doubt,
    )


def _between(own: _Own) -> Array:
    """Covariance (GLOBAL, GLOBAL) of the variation between recordings."""
    # Doubts move the fits of different motions differently, which is no variation.
    apart = own.by_doubt - own.by_doubt.mean(axis=0)
    covariances = own.shapes + apart @ apart.transpose(0, 2, 1)
    between = np.zeros((GLOBAL, GLOBAL))
    of_lens = np.arange(GLOBAL) >= model.LENS.start
    alone = np.flatnonzero(own.free.any(axis=0) & ~of_lens)
    for k in alone:
        some = own.free[:, k]
        values = own.values[some, k]
        variances = covariances[some, k, k]
        between[k, k] = _variance_between(values, variances)
    places = np.flatnonzero(own.free.all(axis=0) & of_lens)
    lens = np.ix_(places, places)
    own_lenses = np.array([covariance[lens] for covariance in covariances])
    between[lens] = _lens_between(own.values[:, places], own_lenses)
    return between


def _moved(
    fit: Fit, mean: Array, R_first: Array, lens: Array, covariance: Array, free: Flags
) -> Fit:
    """A fit at other parameters (GLOBAL,), whose axes are about `R_first`, with its own `free`."""
    parameters = mean.copy()
    parameters[model.LENS] -= lens
    turn = exp_so3(np.ascontiguousarray(parameters[ROTATION]))
    parameters[ROTATION] = 0.0
    held = free & ~fit.free
    parameters[held] = fit.unknowns.parameters[held]
    own = np.where(np.outer(fit.free, fit.free), covariance, 0.0)
    unknowns = fit.unknowns._replace(parameters=parameters, R_cam_imu=turn @ R_first)
    return replace(fit, unknowns=unknowns, covariance=own)


def _lens_between(values: Array, covariances: Array) -> Array:
    """Covariance (m, m) between recordings of m values (N, m) of the lens.

    Errors of focal length, coefficients and principal point are correlated: the variation has the
    shape of the errors of a fit, and single variances would take it apart.
    """
    count, size = values.shape
    if not size:
        return np.zeros((0, 0))
    weights = np.linalg.inv(covariances)
    typical = np.linalg.inv(weights.mean(axis=0))
    weighted = np.einsum('nij,nj->i', weights, values)
    off = values - typical @ weighted / count
    chi_square = float(np.einsum('ni,nij,nj->', off, weights, off))
    ratio = chi_square / ((count - 1) * size)
    return np.asarray(max(ratio - 1.0, 0.0) * typical)


def _variance_between(values: Array, variances: Array) -> float:
    """Variance between recordings of values (N,) with these variances; 0 if they agree."""
    count = len(values)
    if count < 2:
        return 0.0
    weights = 1.0 / variances
    total = weights.sum()
    mean = weights @ values / total
    chi_square = weights @ (values - mean) ** 2
    beyond = chi_square - (count - 1)
    scale = total - (weights**2).sum() / total
    variance = max(float(beyond / scale), 0.0)
    return variance * of_few_groups(count) * count / (count - 1)
