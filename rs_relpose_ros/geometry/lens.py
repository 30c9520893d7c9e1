"""Lenses: distortion of normalised points, its inverse, and its derivatives.

A point of the camera frame at depth z has the normalised coordinates ``n = (x, y) / z``. The lens
moves it to ``d = D(n)``, and the raw pixel is ``u = cx + fx d_x, v = cy + fy d_y``. All models
have one form: a radial profile R of their own, and the tangential and thin-prism terms of OpenCV,

    D(n) = R(|n|^2) n + tangential(n) + prism(n)

To add a model, write the kernel of its profile and its row of `DISTORTION_MODELS`. The camera, the
calibrations and the checks use these two only.

``cv2.undistortPoints`` is not used: it stops after five fixed-point steps, with errors of pixels
if the distortion is strong, and the calls that iterate longer differ between OpenCV 4 and 5.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import NamedTuple

import numba
import numpy as np

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import dot
from rs_relpose_ros.jit import kernel, KernelInterface, small_kernel

# -- Deviations of a lens -------------------------------------------------------------------------

# Entries of a deviation of the lens (true minus assumed) and their sizes, in the order of all
# derivatives by the lens: logarithm of both focal lengths; logarithm of fy / fx, which moves fy;
# radial coefficients k1, k2, k3; tangential coefficients p1, p2; principal point cx, cy [px].
# [chosen: the order of `core.deviations`]
LENS_ENTRIES = (
    ('focal_log', 1),
    ('aspect', 1),
    ('distortion', 3),
    ('tangential', 2),
    ('principal_point', 2),
)
# Number of values of a deviation of the lens. [derived: sum of the sizes above]
N_LENS = 9
# Number of the radial coefficients that have derivatives. [derived: size of 'distortion']
_N_RADIAL = 3
# Place of the first tangential coefficient. [derived: the sizes before it]
_TANGENTIAL = 5
# Place of the principal point. [derived: the sizes before it]
_CENTER = 7


class ByLens(NamedTuple):
    """What pixels see, as vectors of C components, and its derivatives.

    The vectors are unit rays (C = 3) or normalised points (C = 2). The last axis of size 9 has the
    order of `LENS_ENTRIES`.
    """

    values: Array  # (N, C)
    by_pixel: Array  # (N, C, 2) [1/px]
    by_lens: Array  # (N, C, 9)
    by_pixel_by_lens: Array  # (N, C, 2, 9) derivative of `by_pixel` by the lens


# -- Distortion models by name --------------------------------------------------------------------

# Number of values that the kernel of a profile writes: R, 2 R' and 4 R'', where the derivatives
# are by the squared radius s; then G and 2 G' of each of k1, k2, k3, where G = dR/dk.
# [derived: 3 + 2 * 3]
_PROFILE = 9
# Index of the first G. [derived: the values before it]
_GAIN = 3


@small_kernel
def _series(k: Array, first: int, count: int, s: float) -> tuple[float, float, float]:
    """``k_first s + k_first+1 s^2 + ...`` of `count` coefficients, and two derivatives by s."""
    value = 0.0
    slope = 0.0
    half_bend = 0.0
    for m in range(count - 1, -2, -1):  # Horner's scheme of all three; no constant
        half_bend = half_bend * s + slope
        slope = slope * s + value
        value = value * s + (k[first + m] if m >= 0 else 0.0)
    return value, slope, 2.0 * half_bend


@kernel
def fisheye_profile(s: float, k: Array, out: Array) -> None:
    """OpenCV's fisheye model: the angle off the axis becomes the radius.

    ``R(s) = a(theta) / r`` with ``s = r^2``, ``theta = atan(r)`` and
    ``a = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)``; `k` (6,) has k1 to k4.
    """
    r = math.sqrt(s)
    if r < 1e-8:  # the quotients below are 0 / 0 on the axis
        out[0] = 1.0
        for m in range(1, _PROFILE):
            out[m] = 0.0
        return
    theta = math.atan(r)
    t2 = theta * theta
    wider = 1.0 + s  # d r / d theta
    series, slope, bend = _series(k, 0, 4, t2)
    angle = theta * (1.0 + series)
    by_theta = 1.0 + series + 2.0 * t2 * slope
    by_theta_2 = theta * (6.0 * slope + 4.0 * t2 * bend)
    out[0] = angle / r
    out[1] = (by_theta / wider - out[0]) / s
    by_theta_slope = (by_theta_2 / r - 2.0 * by_theta) / (wider * wider)
    out[2] = (by_theta_slope - 3.0 * out[1]) / s
    power = 1.0  # theta^(2 m + 2) of coefficient m
    for m in range(_N_RADIAL):
        power *= t2
        gain = power * theta / r
        out[_GAIN + 2 * m] = gain
        out[_GAIN + 1 + 2 * m] = ((2 * m + 3) * power / wider - gain) / s


def ideal_fisheye(points: Array) -> Array:
    """Undistorted points of the ideal fisheye: from the distorted points, Newton overshoots."""
    angles = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-8)
    return np.asarray(points * np.tan(np.minimum(angles, 1.5)) / angles)


@kernel
def rational_profile(s: float, k: Array, out: Array) -> None:
    """OpenCV's rational model, of which plumb_bob is the part without a denominator.

    ``R(s) = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)``; `k` (6,).
    """
    above, above_slope, above_bend = _series(k, 0, 3, s)
    below, below_slope, below_bend = _series(k, 3, 3, s)
    below += 1.0
    radial = (1.0 + above) / below
    slope = (above_slope - radial * below_slope) / below
    bend = (above_bend - 2.0 * slope * below_slope - radial * below_bend) / below
    out[0] = radial
    out[1] = 2.0 * slope
    out[2] = 4.0 * bend
    power = 1.0  # s^m of coefficient m
    for m in range(_N_RADIAL):
        gain_slope = (m + 1) * power
        power *= s
        gain = power / below
        out[_GAIN + 2 * m] = gain
        out[_GAIN + 1 + 2 * m] = 2.0 * (gain_slope - gain * below_slope) / below


# Compiled code calls profile_at(address, s, k, out). [derived: `DistortionModel.profile`]
_PROFILE_KERNEL = KernelInterface(numba.void, 0.0, np.empty(1), np.empty(1))
profile_at = _PROFILE_KERNEL.call


class CompiledLens(NamedTuple):
    """Distortion of one camera in the form that kernels take."""

    profile: int  # address of the compiled kernel of the radial profile
    radial: Array  # (6,) coefficients of the profile
    sideways: Array  # (6,) tangential p1, p2 and thin-prism s1, s2, s3, s4
    bends_sideways: float  # 1, or 0 for a model without tangential coefficients


@dataclass(frozen=True, slots=True)
class DistortionModel:
    """A family of lenses, and how CameraInfo orders its coefficients."""

    name: str  # as in sensor_msgs/CameraInfo (REP-104)
    coefficient_counts: tuple[int, ...]  # the legal ones, in the order of CameraInfo and OpenCV
    # Kernel profile(s, k, out) that writes the `_PROFILE` values above; `k` (6,).
    profile: Callable[[float, Array, Array], None]
    radial: tuple[int, ...]  # places of the profile's coefficients in CameraInfo; k1, k2, k3 first
    sideways: tuple[int, ...] = ()  # places of p1, p2, s1, s2, s3, s4 in CameraInfo
    # A start of the inverse: undistorted points (N, 2) from the distorted points.
    first_guess: Callable[[Array], Array] = np.copy
    is_pinhole_at_zero: bool = True  # whether coefficients of zero distort nothing

    def lens(self, coefficients: tuple[float, ...]) -> CompiledLens:
        """Make the lens with these coefficients; the coefficients that are not given are zero."""
        given = np.zeros(12)
        given[: len(coefficients)] = coefficients
        radial = np.zeros(6)
        sideways = np.zeros(6)
        radial[: len(self.radial)] = given[list(self.radial)]
        sideways[: len(self.sideways)] = given[list(self.sideways)]
        bends_sideways = 1.0 if self.sideways else 0.0
        return CompiledLens(
            _PROFILE_KERNEL.address(self.profile), radial, sideways, bends_sideways
        )

    def moved(self, coefficients: tuple[float, ...], by: Array) -> tuple[float, ...]:
        """Coefficients with `by` (5,) added to k1, k2, k3, p1, p2: as many as that needs.

        A model that has fewer of them ignores the rest of `by`.
        """
        of_radial = zip(self.radial, by[:_N_RADIAL].tolist(), strict=False)
        of_tangential = zip(self.sideways, by[_N_RADIAL:].tolist(), strict=False)
        steps = {place: step for place, step in (*of_radial, *of_tangential) if step}
        if not steps:
            return coefficients
        needed = max(len(coefficients), 1 + max(steps))
        count = next(legal for legal in self.coefficient_counts if legal >= needed)
        values = [*coefficients, *[0.0] * (count - len(coefficients))]
        for place, step in steps.items():
            values[place] += step
        return tuple(values)


# The models have the names that CameraInfo gives them. [derived: sensor_msgs/CameraInfo, and the
# order of the coefficients in OpenCV]
DISTORTION_MODELS = {
    model.name: model
    for model in (
        DistortionModel(
            'plumb_bob', (0, 4, 5, 8), rational_profile, (0, 1, 4, 5, 6, 7), (2, 3, 8, 9, 10, 11)
        ),
        DistortionModel(
            'rational_polynomial',
            (8, 12),
            rational_profile,
            (0, 1, 4, 5, 6, 7),
            (2, 3, 8, 9, 10, 11),
        ),
        DistortionModel(
            'equidistant',
            (4,),
            fisheye_profile,
            (0, 1, 2, 3),
            first_guess=ideal_fisheye,
            is_pinhole_at_zero=False,
        ),
    )
}


# -- Kernels of all models ------------------------------------------------------------------------

# Depth below which a point does not lie in front of the camera, in the unit of the points; the
# quotients by the depth stay finite. [chosen: any value between rounding and a millimetre]
_NEAREST = 1e-9
# Distance of the assumed row from the projected one [px] at which the row of a ray is found. A
# larger one bends the derotated image, a smaller one costs rounds.
# [chosen: 0.001 to 0.05 would do]
_SETTLED = 0.01
# Rounds after which the row of a ray is given up: secants settle in a few, unless points cross the
# rows as fast as they are read. [chosen: any value in 8..30 would do]
_MOST_ROUNDS = 12


@kernel
def distort(x: float, y: float, lens: CompiledLens, profile: Array, out: Array) -> None:
    """Write D(x, y) and d D / d(x, y), row by row, into `out` (6,); `profile` (9,) is filled.

    The model of OpenCV (its documentation of the module calib3d): the radial profile R, the
    tangential distortion p1, p2, and the thin prism s1 to s4.
    """
    r2 = x * x + y * y
    profile_at(lens.profile, r2, lens.radial, profile)
    radial = profile[0]
    slope = profile[1]
    p1 = lens.sideways[0]
    p2 = lens.sideways[1]
    s1 = lens.sideways[2]
    s2 = lens.sideways[3]
    s3 = lens.sideways[4]
    s4 = lens.sideways[5]
    along_x = r2 + 2.0 * x * x
    along_y = r2 + 2.0 * y * y
    moved_x = x * radial + 2.0 * p1 * x * y + p2 * along_x
    moved_y = y * radial + p1 * along_y + 2.0 * p2 * x * y
    lifted_x = s1 + r2 * s2
    lifted_y = s3 + r2 * s4
    out[0] = moved_x + r2 * lifted_x
    out[1] = moved_y + r2 * lifted_y
    prism_x = s1 + 2.0 * r2 * s2
    prism_y = s3 + 2.0 * r2 * s4
    mixed = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    by_x = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    by_y = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    out[2] = by_x + 2.0 * x * prism_x
    out[3] = mixed + 2.0 * y * prism_x
    out[4] = mixed + 2.0 * x * prism_y
    out[5] = by_y + 2.0 * y * prism_y


@kernel
def project_points(points: Array, lens: CompiledLens) -> Array:
    """Distorted normalised points (N, 2) of points (N, 3); NaN behind the camera."""
    out = np.empty((points.shape[0], 2))
    profile = np.empty(_PROFILE)
    values = np.empty(6)
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        values[0] = math.nan
        values[1] = math.nan
        if z > _NEAREST:
            distort(x / z, y / z, lens, profile, values)
        out[i, 0] = values[0]
        out[i, 1] = values[1]
    return out


@kernel
def undistort_points(
    points: Array, first_guesses: Array, lens: CompiledLens
) -> tuple[Array, Array]:
    """Undistorted normalised points (N, 2) and their derivatives (N, 2, 2) by the distorted ones.

    NaN if there is no inverse. A root beyond the turning point of the polynomial is a mirror image
    and not an inverse.
    """
    n = points.shape[0]
    out = np.empty((n, 2))
    inverse = np.empty((n, 2, 2))
    profile = np.empty(_PROFILE)
    v = np.empty(6)
    for i in range(n):
        x = first_guesses[i, 0]
        y = first_guesses[i, 1]
        converged = False
        for _ in range(50):
            distort(x, y, lens, profile, v)
            error_x = points[i, 0] - v[0]
            error_y = points[i, 1] - v[1]
            determinant = v[2] * v[5] - v[3] * v[4]
            dx = (v[5] * error_x - v[3] * error_y) / determinant
            dy = (v[2] * error_y - v[4] * error_x) / determinant
            length = math.sqrt(dx * dx + dy * dy)
            # A step may not leave the region in which the model is monotonic.
            limit = 0.5 * (1.0 + math.sqrt(x * x + y * y))
            if length > limit:
                dx = dx * limit / length
                dy = dy * limit / length
            x = x + dx
            y = y + dy
            # The error after a step is about its square: 1e-9 px at any focal length.
            if length < 1e-8 * (1.0 + limit):
                converged = True
                break
        distort(x, y, lens, profile, v)
        determinant = v[2] * v[5] - v[3] * v[4]
        if not (converged and determinant > 0.0):
            x = math.nan
            y = math.nan
            determinant = math.nan
        of_point = inverse[i]
        out[i, 0] = x
        out[i, 1] = y
        of_point[0, 0] = v[5] / determinant
        of_point[0, 1] = -v[3] / determinant
        of_point[1, 0] = -v[4] / determinant
        of_point[1, 1] = v[2] / determinant
    return out, inverse


@kernel
def rays_with_jacobian(normalized: Array, by_pixel: Array) -> tuple[Array, Array]:
    """Unit rays (N, 3) through normalised points (N, 2), and their derivatives (N, 3, M).

    `by_pixel` (N, 2, M): derivatives of the points by the variables of the result's last axis.
    """
    n = normalized.shape[0]
    variables = by_pixel.shape[2]
    rays = np.empty((n, 3))
    jacobian = np.empty((n, 3, variables))
    for i in range(n):
        x = normalized[i, 0]
        y = normalized[i, 1]
        scale = 1.0 / math.sqrt(1.0 + x * x + y * y)
        ray = rays[i]
        of_ray = jacobian[i]
        ray[0] = x * scale
        ray[1] = y * scale
        ray[2] = scale
        for k in range(variables):
            # m = n / |n| with n = (x, y, 1): dm = (dn - m (m . dn)) / |n|.
            dx = by_pixel[i, 0, k]
            dy = by_pixel[i, 1, k]
            along = ray[0] * dx + ray[1] * dy
            of_ray[0, k] = (dx - ray[0] * along) * scale
            of_ray[1, k] = (dy - ray[1] * along) * scale
            of_ray[2, k] = -ray[2] * along * scale
    return rays, jacobian


@kernel
def project_rotating(
    rays: Array,
    rows: Array,
    rotations: Array,
    axis: int,
    row_count: int,
    intrinsics: tuple[float, float, float, float],
    lens: CompiledLens,
) -> Array:
    """`RollingShutterCamera.project_rotating` with `intrinsics` fx, fy, cx, cy.

    `axis`: the pixel coordinate that is the row. Row v images a ray that the orientation at its
    time projects into row v: a root of ``projected_row(v) - v``, by the secant method. Rotations
    are linear between their rows, and beyond.
    """
    fx, fy, cx, cy = intrinsics
    out = np.empty((len(rays), 2))
    rotated = np.empty(3)
    profile = np.empty(_PROFILE)
    values = np.empty(6)
    per_row = (len(rotations) - 1) / max(row_count - 1.0, 1.0)
    for n in range(len(rays)):
        row = rows[n]
        before = rows[n]
        ahead = 0.0
        slope = 0.0
        u = v = math.nan
        for step in range(_MOST_ROUNDS):
            place = row * per_row
            i = int(min(max(place, 0.0), len(rotations) - 2.0))
            share = place - i
            for j in range(3):
                first = dot(rotations[i, j], rays[n])
                second = dot(rotations[i + 1, j], rays[n])
                rotated[j] = first + share * (second - first)
            if not rotated[2] > _NEAREST:
                u = v = math.nan
                break
            x = rotated[0] / rotated[2]
            y = rotated[1] / rotated[2]
            distort(x, y, lens, profile, values)
            u = cx + fx * values[0]
            v = cy + fy * values[1]
            projected = v if axis == 1 else u
            if abs(projected - row) < _SETTLED:
                break
            if step == _MOST_ROUNDS - 1:
                u = v = math.nan
            # Derivative of the projected row by the assumed row.
            if step > 0 and row != before:
                slope = (projected - ahead) / (row - before)
            if not abs(slope) < 0.9:
                slope = 0.0
            before = row
            ahead = projected
            row += (projected - row) / (1.0 - slope)
        out[n, 0] = u
        out[n, 1] = v
    return out


# -- Derivatives by the lens ----------------------------------------------------------------------


@small_kernel
def _dot(m: Array, dn: Array) -> float:
    """``m . dn``, where the change dn of a normalised point has no third component."""
    return m[0] * dn[0] + m[1] * dn[1]


@kernel
def _bends(x: float, y: float, lens: CompiledLens, profile: Array, out: Array) -> None:
    """Write the second derivatives of D by (x, y) into `out` (2, 2, 2), component first."""
    slope = profile[1]
    bend = profile[2]
    p1 = lens.sideways[0]
    p2 = lens.sideways[1]
    r2 = x * x + y * y
    along_x = bend * x * x
    along_y = bend * y * y
    # The radial and the tangential parts do not depend on the order of the three indices.
    xxx = x * (3.0 * slope + along_x) + 6.0 * p2
    xxy = y * (slope + along_x) + 2.0 * p1
    xyy = x * (slope + along_y) + 2.0 * p2
    yyy = y * (3.0 * slope + along_y) + 6.0 * p1
    by_xx = (xxx, xxy)
    by_xy = (xxy, xyy)
    by_yy = (xyy, yyy)
    for c in range(2):
        square = 2.0 * lens.sideways[2 + 2 * c]
        fourth = 4.0 * lens.sideways[3 + 2 * c]
        mixed = by_xy[c] + 2.0 * fourth * x * y
        prism_x = square + fourth * (r2 + 2.0 * x * x)
        prism_y = square + fourth * (r2 + 2.0 * y * y)
        out[c, 0, 0] = by_xx[c] + prism_x
        out[c, 0, 1] = mixed
        out[c, 1, 0] = mixed
        out[c, 1, 1] = by_yy[c] + prism_y


@kernel
def _write_both(
    n: Array,
    A: Array,
    profile: Array,
    bends: Array,
    by_pixel: Array,
    by_lens: Array,
    bends_sideways: float,
    out: Array,
) -> None:
    """Write d2n / (du dq) of one point into `out` (2, 2, 9), as in `points_by_lens`."""
    for u in range(2):
        P = by_pixel[:, u]
        along_n = _dot(n, P)
        for c in range(2):
            out_cu = out[c, u]
            # dJ/dq through the point that moves.
            A_c0 = A[c, 0]
            A_c1 = A[c, 1]
            by_x = A_c0 * _dot(bends[0, 0], P) + A_c1 * _dot(bends[1, 0], P)
            by_y = A_c0 * _dot(bends[0, 1], P) + A_c1 * _dot(bends[1, 1], P)
            for q in range(N_LENS):
                out_cu[q] = -(by_x * by_lens[0, q] + by_y * by_lens[1, q])
            # dJ/dq through the coefficient: G I + 2 G' n n^T.
            even = _dot(A[c], P)
            along = _dot(A[c], n) * along_n
            for m in range(_N_RADIAL):
                gain = profile[_GAIN + 2 * m]
                slope = profile[_GAIN + 1 + 2 * m]
                out_cu[2 + m] -= gain * even + slope * along
            # dJ/dp1 = 2 [[y, x], [x, 3 y]], dJ/dp2 = 2 [[3 x, y], [y, x]].
            crossed = A[c, 0] * P[1] + A[c, 1] * P[0]
            of_p1 = n[0] * crossed + n[1] * (A[c, 0] * P[0] + 3.0 * A[c, 1] * P[1])
            of_p2 = n[1] * crossed + n[0] * (3.0 * A[c, 0] * P[0] + A[c, 1] * P[1])
            out_cu[_TANGENTIAL] -= 2.0 * bends_sideways * of_p1
            out_cu[_TANGENTIAL + 1] -= 2.0 * bends_sideways * of_p2
            # A longer focal length makes the step of a pixel smaller: A (d2d / (du dq)).
            out_cu[0] -= P[c]
            if u == 1:
                out_cu[1] -= P[c]


@kernel
def first_order_by_lens(
    distorted: Array,
    points: Array,
    by_distorted: Array,
    focal: tuple[float, float],
    lens: CompiledLens,
) -> tuple[Array, Array]:
    """Derivatives of normalised points n by the pixel (N, 2, 2) and by the lens (N, 2, 9).

    `points` (N, 2) are undistorted, and `by_distorted` (N, 2, 2) are their derivatives A by the
    distorted points d (N, 2), both as of `undistort_points`; `focal` is (fx, fy) [px]. With
    J = dD/dn, the equation ``D(n) = d`` holds for all pixels and lenses, so by a value q of the
    lens ``dn/dq = A (dd/dq - dD/dq)``.
    """
    count = len(points)
    by_pixel = np.empty((count, 2, 2))
    by_lens = np.empty((count, 2, N_LENS))
    profile = np.empty(_PROFILE)
    for i in range(count):
        x = points[i, 0]
        y = points[i, 1]
        A = by_distorted[i]
        r2 = x * x + y * y
        profile_at(lens.profile, r2, lens.radial, profile)
        mixed = 2.0 * x * y * lens.bends_sideways
        along_x = (r2 + 2.0 * x * x) * lens.bends_sideways
        along_y = (r2 + 2.0 * y * y) * lens.bends_sideways
        for c in range(2):
            of_c = by_lens[i, c]
            toward = _dot(A[c], points[i])
            of_c[0] = -_dot(A[c], distorted[i])
            of_c[1] = -A[c, 1] * distorted[i, 1]
            for m in range(_N_RADIAL):
                of_c[2 + m] = -profile[_GAIN + 2 * m] * toward
            of_c[_TANGENTIAL] = -(A[c, 0] * mixed + A[c, 1] * along_y)
            of_c[_TANGENTIAL + 1] = -(A[c, 0] * along_x + A[c, 1] * mixed)
            for u in range(2):
                step = A[c, u] / focal[u]
                by_pixel[i, c, u] = step
                of_c[_CENTER + u] = -step
    return by_pixel, by_lens


@kernel
def points_by_lens(
    distorted: Array,
    points: Array,
    by_distorted: Array,
    focal: tuple[float, float],
    lens: CompiledLens,
) -> ByLens:
    """Derivatives of normalised points n by the pixel, by the lens, and by both.

    The arguments are those of `first_order_by_lens`. Once more by the pixel u::

        d2n/(du dq) = -A (dJ/dq) dn/du + A (d2d / (du dq))
    """
    count = len(points)
    by_pixel, by_lens = first_order_by_lens(distorted, points, by_distorted, focal, lens)
    by_both = np.empty((count, 2, 2, N_LENS))
    profile = np.empty(_PROFILE)
    bends = np.empty((2, 2, 2))
    for i in range(count):
        x = points[i, 0]
        y = points[i, 1]
        profile_at(lens.profile, x * x + y * y, lens.radial, profile)
        _bends(x, y, lens, profile, bends)
        A = by_distorted[i]
        _write_both(
            points[i],
            A,
            profile,
            bends,
            by_pixel[i],
            by_lens[i],
            lens.bends_sideways,
            by_both[i],
        )
    return ByLens(points, by_pixel, by_lens, by_both)


@kernel
def rays_by_lens(points: ByLens) -> ByLens:
    """Unit rays and their derivatives, from normalised points and the derivatives of these.

    With ``m = n / |n|`` and ``h = 1 / |n|``: ``dm = h (dn - m (m . dn))``, and once more by q

        d2m = h (d2n - m (m . d2n) - m_q (m . dn) - m (m_q . dn)) - h (m . n_q) dm
    """
    rays, by_pixel = rays_with_jacobian(points.values, points.by_pixel)
    _, by_lens = rays_with_jacobian(points.values, points.by_lens)
    by_both = np.empty((len(rays), 3, 2, N_LENS))
    d2n = np.zeros(3)
    for i in range(len(rays)):
        m = rays[i]
        for q in range(N_LENS):
            m_q = by_lens[i, :, q]
            growth = _dot(m, points.by_lens[i, :, q])
            for u in range(2):
                dn = points.by_pixel[i, :, u]
                d2n[0] = points.by_pixel_by_lens[i, 0, u, q]
                d2n[1] = points.by_pixel_by_lens[i, 1, u, q]
                along = _dot(m, dn)
                along_by_lens = _dot(m, d2n) + _dot(m_q, dn)
                for c in range(3):
                    change = d2n[c] - m[c] * along_by_lens - m_q[c] * along
                    by_both[i, c, u, q] = m[2] * (change - growth * by_pixel[i, c, u])
    return ByLens(rays, by_pixel, by_lens, by_both)
