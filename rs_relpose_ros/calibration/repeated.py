"""Calibrations of one camera from several recordings, and how well they repeat.

A parameter of recording i is ``theta_i = mu + u_i + e_i + M_i d``: u_i varies between recordings
with the variance T, e_i is the error of the fit with the covariance S_i, and d are the doubts of
what is not estimated, which all recordings share. T is that of R. DerSimonian and N. Laird,
Controlled Clinical Trials 7, 1986. The estimate is the weighted mean with ``(S_i + T)^-1``; its
covariance is that for another recording of the camera, so that it contains T and the doubts.
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


def combined(fits: Sequence[Fit], lenses: Array, reference: int) -> Repeated:
    """Combine at least two fits; `lenses` (N, 7) are the lenses about which each was fitted.

    The parameters of the result are about the lens of fit `reference`. A prior counts in each
    fit: it pulls the mean no more than it pulled one of them.
    """
    free = np.logical_or.reduce([one.free for one in fits])
    R_first = fits[0].unknowns.R_cam_imu
    values = np.array([one.unknowns.parameters for one in fits])
    values[:, model.LENS] += lenses
    for value, one in zip(values, fits, strict=True):
        turn = one.unknowns.R_cam_imu @ R_first.T
        value[ROTATION] = log_so3(np.ascontiguousarray(turn))
    scatters = [one.covariance - one.by_doubt @ one.by_doubt.T for one in fits]
    between = np.zeros(GLOBAL)
    for k in np.flatnonzero(free):
        in_fits = [i for i, one in enumerate(fits) if one.free[k]]
        variances = np.array([scatters[i][k, k] for i in in_fits])
        between[k] = _variance_between(values[in_fits, k], variances)
    weights = np.zeros((len(fits), GLOBAL, GLOBAL))
    for weight, scatter, one in zip(weights, scatters, fits, strict=True):
        own = block_of(one.free)
        weight[own] = np.linalg.inv((scatter + np.diag(between))[own])
    whole = block_of(free)
    covariance = np.zeros((GLOBAL, GLOBAL))
    covariance[whole] = np.linalg.inv(weights.sum(axis=0)[whole])
    shares = covariance @ weights
    mean = np.einsum('nij,nj->i', shares, values)
    by_doubt = sum(share @ one.by_doubt for share, one in zip(shares, fits, strict=True))
    covariance += np.diag(between) + by_doubt @ by_doubt.T
    return Repeated(
        _moved(fits[reference], mean, R_first, lenses[reference], covariance, free),
        np.sqrt(between),
    )


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


def _variance_between(values: Array, variances: Array) -> float:
    """Variance between recordings of values (N,) with these variances; 0 if they agree."""
    count = len(values)
    if count < 2:
        return 0.0
    weights = 1.0 / variances
    total = weights.sum()
    mean = weights @ values / total
    beyond = weights @ (values - mean) ** 2 - (count - 1)
    scale = total - (weights**2).sum() / total
    return max(float(beyond / scale), 0.0) * of_few_groups(count) * count / (count - 1)
