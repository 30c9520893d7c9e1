"""Whether rows of the sensor are rows or columns of the image, by the matches of a recording.

Where a driver or a phone has turned the images by 90 degrees, the rows of the sensor are columns
of the image. The rotation of the camera during the readout tells the two apart: the matches are
fitted with either, and the losses of the same pairs are compared.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration import fit, model
from rs_relpose_ros.geometry import Array

if TYPE_CHECKING:  # its convolution imports much of SciPy, which no node needs
    from rs_relpose_ros.calibration.observations import Observations, Pair

# Gain in log-likelihood beyond which columns are certain. Turned images are rare: a smaller value
# would take noise of a global shutter for them, a larger one would miss them where the camera
# hardly rotates. [chosen: odds of exp(5) = 150 to 1; 3 to 10 would do]
_CERTAIN = 5.0
# Errors of the sum of the gains, 1 sigma each by the scatter of the pairs, that must be exceeded
# as well: a few pairs with an outlier decide nothing. [chosen: 2 to 4 would do]
_SIGMAS = 3.0


def is_certain(gains: Array) -> bool:
    """Whether gains in log-likelihood (P,) of P > 1 pairs by another hypothesis are no chance."""
    error_of_sum = math.sqrt(len(gains)) * float(np.std(gains, ddof=1))
    return bool(float(gains.sum()) > _CERTAIN + _SIGMAS * error_of_sum)


def along_other_axis(
    data: Observations, pairs: Sequence[Pair], found: fit.Fit, free: NDArray[np.bool_]
) -> tuple[Observations, model.Unknowns] | None:
    """The observations with rows along the other axis of the image, and their calibration.

    `found` is the fit to `pairs` with the axis of `data`. None unless the other axis fits better
    for certain.
    """
    turned = data.along(1 - data.camera.readout_axis)
    known = found.unknowns
    problem = turned.problem(pairs, float(known.parameters[model.OFFSET]))
    without_readout = known._replace(parameters=known.parameters.copy())
    without_readout.parameters[model.READOUT] = 0.0
    begin = fit.restarted(problem, without_readout, 2.0)
    other = fit.minimised(problem, begin, free, rounds=20, tolerance=0.3)
    noise = np.minimum(known.noise, other.unknowns.noise)
    losses, others = (
        fit.evaluate(one.problem, one.unknowns._replace(noise=noise)).losses
        for one in (found, other)
    )
    return (turned, other.unknowns) if is_certain(losses - others) else None
