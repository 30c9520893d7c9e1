"""Solvers without linear velocities: calibrated 5-point, and 3-point with gravity.

5-point: Nister, *An Efficient Solution to the Five-Point Relative Pose Problem*, PAMI 2004, with
the roots of the degree-10 polynomial isolated by its derivatives, the essential matrix decomposed
by Horn's closed form (*Recovering Baseline and Orientation from 'Essential' Matrix*, 1990), and
every solution polished by Newton's method on the five constraints, which removes the rounding of
the elimination.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import kernel, small_kernel
from rs_relpose_ros.solvers import algebra, common
from rs_relpose_ros.solvers.common import Knowledge, Sample, Solutions

MAX_5PT = 10

# Monomials, the cubic ones in Nister's order: the first ten are eliminated.
_CUBIC = ['xxx', 'yyy', 'xxy', 'xyy', 'xxz', 'xx1', 'yyz', 'yy1', 'xyz', 'xy1',
          'xzz', 'xz1', 'x11', 'yzz', 'yz1', 'y11', 'zzz', 'zz1', 'z11', '111']
_QUADRATIC = ['xx', 'xy', 'xz', 'x1', 'yy', 'yz', 'y1', 'zz', 'z1', '11']
_ORDER = 'xyz1'


def _product_table(left: list[str], products: list[str]) -> NDArray[np.int64]:
    """Index in `products` of each monomial of `left` times each of x, y, z, 1."""
    return np.array([[products.index(''.join(sorted(m + v, key=_ORDER.index))) for v in _ORDER]
                     for m in left])


_TO_QUADRATIC = _product_table(list(_ORDER), _QUADRATIC)
_TO_CUBIC = _product_table(_QUADRATIC, _CUBIC)


@small_kernel
def _null_space(rows: Array, basis: Array) -> None:
    """Orthonormal basis (4, 9) of the null space of `rows` (5, 9), which are overwritten.

    The last four columns of Q of the transposed matrix.
    """
    diagonal, scales = np.empty(5), np.empty(5)
    algebra.triangularise(rows, 5, diagonal, scales)
    for c in range(4):
        for j in range(9):
            basis[c, j] = 0.0
        basis[c, 5 + c] = 1.0
        for k in range(4, -1, -1):
            algebra.reflect(rows[k], scales[k], k, basis[c])


@kernel
def _add_product(p: Array, q: Array, factor: float, table: NDArray[np.int64], out: Array) -> None:
    """Add `factor` times the product of a polynomial and a linear one, `q` (4,), to `out`."""
    for i in range(len(table)):
        for j in range(4):
            out[table[i, j]] += factor * p[i] * q[j]


@small_kernel
def _cubic_constraints(basis: Array, M: Array) -> None:
    """``det E = 0`` and ``(E E^T - trace(E E^T) / 2) E = 0`` in the 20 monomials: `M` (10, 20).

    ``E = x B_0 + y B_1 + z B_2 + B_3`` with the four rows of `basis`.
    """
    E = np.empty((9, 4))
    for c in range(4):
        for j in range(9):
            E[j, c] = basis[c, j]
    M[:] = 0.0
    minor = np.empty(10)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        minor[:] = 0.0
        _add_product(E[3 + j], E[6 + k], 1.0, _TO_QUADRATIC, minor)
        _add_product(E[3 + k], E[6 + j], -1.0, _TO_QUADRATIC, minor)
        _add_product(minor, E[i], 1.0, _TO_CUBIC, M[0])
    EET = np.zeros((9, 10))
    for i in range(3):
        for j in range(i, 3):
            for k in range(3):
                _add_product(E[3 * i + k], E[3 * j + k], 1.0, _TO_QUADRATIC, EET[3 * i + j])
            so3.copy_vector(EET[3 * i + j], EET[3 * j + i])
    for m in range(10):
        half_trace = 0.5 * (EET[0, m] + EET[4, m] + EET[8, m])
        for i in (0, 4, 8):
            EET[i, m] -= half_trace
    for i in range(3):
        for j in range(3):
            for k in range(3):
                _add_product(EET[3 * i + k], E[3 * k + j], 1.0, _TO_CUBIC, M[1 + 3 * i + j])


@kernel
def _eliminate(M: Array) -> float:
    """Gauss-Jordan with row pivoting: identity in rows and columns 4 to 9.

    Returns the largest of the other coefficients of these rows; infinite if it fails.
    """
    for k in range(10):
        pivot = k
        for i in range(k + 1, 10):
            if abs(M[i, k]) > abs(M[pivot, k]):
                pivot = i
        if not abs(M[pivot, k]) > 1e-300:
            return math.inf
        if pivot != k:
            for j in range(k, 20):
                M[k, j], M[pivot, j] = M[pivot, j], M[k, j]
        inverse = 1.0 / M[k, k]
        for j in range(k, 20):
            M[k, j] *= inverse
        for i in range(k + 1, 10):
            factor = M[i, k]
            for j in range(k + 1, 20):
                M[i, j] -= factor * M[k, j]
    for k in range(9, 4, -1):
        for i in range(4, k):
            factor = M[i, k]
            for j in range(10, 20):
                M[i, j] -= factor * M[k, j]
    largest = 0.0
    for i in range(4, 10):
        for j in range(10, 20):
            largest = max(largest, abs(M[i, j]))
    return largest


@small_kernel
def _reduced_constraints(basis: Array, M: Array) -> bool:
    """Constraints in `M` (10, 20) after elimination, with another `basis` (4, 9) if necessary.

    Rounding is proportional to the largest coefficient: beyond 1e4 (1 to 2 % of random problems,
    rarely in a second basis) another basis is used.
    """
    coefficient = math.inf
    for attempt in range(3):
        if attempt > 0:
            # A rotation by 60 degrees: the quaternion (1 + i + j + k) / 2 times (x, y, z, 1).
            for m in range(9):
                a, b, c, d = basis[0, m], basis[1, m], basis[2, m], basis[3, m]
                basis[0, m] = 0.5 * (a - b - c - d)
                basis[1, m] = 0.5 * (a + b - c + d)
                basis[2, m] = 0.5 * (a + b + c - d)
                basis[3, m] = 0.5 * (a - b + c + d)
        _cubic_constraints(basis, M)
        coefficient = _eliminate(M)
        if coefficient < 1e4:
            break
    return coefficient < math.inf


@kernel
def _multiply_add(p: Array, p_size: int, q: Array, q_size: int, factor: float, out: Array) -> None:
    """Add `factor` times the product of two polynomials in z to `out`."""
    for i in range(p_size):
        for j in range(q_size):
            out[i + j] += factor * p[i] * q[j]


@small_kernel
def _degree_10(M: Array, B: Array, p: Array) -> None:
    """The 3x3 matrix of polynomials in z, `B` (3, 3, 5), with ``B(z) (x, y, 1) = 0``; its det."""
    B[:] = 0.0
    for r in range(3):
        upper, lower = M[4 + 2 * r], M[5 + 2 * r]
        # upper - z lower: the leading monomials cancel.
        for c in range(3):
            first = 10 + 3 * c
            terms = 4 if c == 2 else 3
            for j in range(terms):
                power = terms - 1 - j
                B[r, c, power] += upper[first + j]
                B[r, c, power + 1] -= lower[first + j]
    p[:] = 0.0
    minor = np.empty(7)
    for r in range(3):
        i, j = (r + 1) % 3, (r + 2) % 3
        minor[:] = 0.0
        _multiply_add(B[i, 0], 4, B[j, 1], 4, 1.0, minor)
        _multiply_add(B[j, 0], 4, B[i, 1], 4, -1.0, minor)
        _multiply_add(minor, 7, B[r, 2], 5, 1.0, p)


@small_kernel
def _essential_matrix(B: Array, z: float, basis: Array, E: Array) -> bool:
    """E (3, 3) with ``|E| = sqrt(2)`` at a root z: (x, y, 1) is the null vector of B(z)."""
    V = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(4, -1, -1):
                V[i, j] = V[i, j] * z + B[i, j, k]
    (x, y, w), _ = algebra.null_direction(V)
    norm2 = 0.0
    for i in range(3):
        for j in range(3):
            m = 3 * i + j
            E[i, j] = x * basis[0, m] + y * basis[1, m] + w * (z * basis[2, m] + basis[3, m])
            norm2 += E[i, j] * E[i, j]
    if not 0.0 < norm2 < math.inf:
        return False
    E *= math.sqrt(2.0 / norm2)
    return True


@small_kernel
def _orthonormalise(R: Array) -> bool:
    """Nearest rotation by Newton's iteration of the polar decomposition; False if far away."""
    G = np.empty((3, 3))
    for _ in range(3):
        worst = 0.0
        for i in range(3):
            for j in range(3):
                gram = R[0, i] * R[0, j] + R[1, i] * R[1, j] + R[2, i] * R[2, j]
                G[i, j] = -0.5 * gram
                if i == j:
                    G[i, j] += 1.5
                    gram -= 1.0
                worst = max(worst, abs(gram))
        if not worst < 0.1:
            return False
        for i in range(3):
            row = (R[i, 0], R[i, 1], R[i, 2])
            for j in range(3):
                R[i, j] = row[0] * G[0, j] + row[1] * G[1, j] + row[2] * G[2, j]
        if worst < 1e-8:
            return True
    return True


@small_kernel
def _decompose(E: Array, sample: Sample, R: Array, x: Array) -> bool:
    """R and t (in `x`) of ``E = [t]x R`` with most points in front of both cameras.

    Horn: ``(t.t) R = cofactors(E) -+ [t]x E``, for t and -t.
    """
    t, length2 = algebra.null_direction(np.ascontiguousarray(E.T))
    if not length2 > 1e-20:
        return False
    scale = 1.0 / math.sqrt(length2)
    for i in range(3):
        x[i] = t[i] * scale
    candidate, best, sign = np.empty((3, 3)), -1, 1.0
    for twist in (1.0, -1.0):
        for i in range(3):
            i1, i2 = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                j1, j2 = (j + 1) % 3, (j + 2) % 3
                cofactor = E[i1, j1] * E[i2, j2] - E[i1, j2] * E[i2, j1]
                t_cross_E = x[i1] * E[i2, j] - x[i2] * E[i1, j]
                candidate[i, j] = cofactor - twist * t_cross_E
        if not _orthonormalise(candidate):
            continue
        front, behind = common.cheirality_votes(sample, candidate, x)
        votes = max(front, behind)
        if votes > best:
            best = votes
            sign = 1.0 if front >= behind else -1.0
            so3.copy_matrix(candidate, R)
    x *= sign
    return best >= 0


@kernel
def _linearise(sample: Sample, R: Array, t: Array, u: Array, v: Array, J: Array,
               right: Array) -> float:
    """Write ``-e``, ``e = (f_1 x R f_2) . t``, and ``J = de / d(theta, t_u, t_v)``; max |e|."""
    worst = 0.0
    for k in range(5):
        f1, h = sample.f1[k], so3.rotated(R, sample.f2[k])
        n = so3.cross(f1, h)
        by_theta = so3.cross(h, so3.cross(t, f1))
        for i in range(3):
            J[k, i] = by_theta[i]
        J[k, 3], J[k, 4] = so3.dot(n, u), so3.dot(n, v)
        right[k] = -so3.dot(n, t)
        worst = max(worst, abs(right[k]))
    return worst


@kernel
def _polish(sample: Sample, R: Array, t: Array) -> bool:
    """Newton's method on the constraints e, R by ``Exp(theta) R``, t on the sphere."""
    # Of e, with unit rays and unit t: rounding, and the largest value of a solution.
    converged, accepted = 1e-15, 1e-10
    steps = 4
    J, step, pivots = np.empty((5, 5)), np.empty(5), np.empty(5, dtype=np.int64)
    for attempt in range(steps + 1):
        basis = so3.tangent_basis(t)
        u, v = basis[:, 0], basis[:, 1]
        worst = _linearise(sample, R, t, u, v, J, step)
        if worst < converged or attempt == steps:
            return worst < accepted
        algebra.lu_factor(J, pivots)
        algebra.lu_solve(J, pivots, step)
        length2 = 0.0
        for k in range(5):
            length2 += step[k] * step[k]
        # Only rounding is corrected: a longer step is that of a singular J, or leads elsewhere.
        if not length2 < 0.01:
            return worst < accepted
        so3.copy_matrix(so3.exp_so3(step[:3]) @ R, R)
        length = so3.norm((1.0, step[3], step[4]))
        for i in range(3):
            t[i] = (t[i] + step[3] * u[i] + step[4] * v[i]) / length
    return False


@small_kernel
def _is_known(R: Array, x: Array, rotations: Array, vectors: Array) -> bool:
    """Whether a solution repeats one of `rotations` (K, 3, 3) and `vectors` (K, 9)."""
    for j in range(len(rotations)):
        gap = 0.0
        for i in range(3):
            gap += abs(rotations[j, i, 0] - R[i, 0]) + abs(rotations[j, i, 1] - R[i, 1])
            gap += abs(vectors[j, i] - x[i])
        if gap < 1e-9:
            return True
    return False


@kernel
def solve_5pt(sample: Sample, _known: Knowledge, out: Solutions) -> int:
    """The calibrated 5-point problem: one decomposition of every real essential matrix.

    Of its four decompositions it is the one with most points in front of both cameras. For
    derotated rays see section 'Angular 5-point algorithm' of the paper, and
    `rs_relpose_ros.solvers.angular` for the method.
    """
    rows = np.empty((5, 9))
    for k in range(5):
        for i in range(3):
            for j in range(3):
                rows[k, 3 * i + j] = sample.f1[k, i] * sample.f2[k, j]  # f_1^T E f_2 = 0
    basis, M = np.empty((4, 9)), np.empty((10, 20))
    _null_space(rows, basis)
    if not _reduced_constraints(basis, M):
        return 0
    B, p, roots = np.empty((3, 3, 5)), np.empty(11), np.empty(10)
    _degree_10(M, B, p)
    largest = 0.0
    for k in range(11):
        largest = max(largest, abs(p[k]))
    if not 0.0 < largest < math.inf:
        return 0
    p *= 1.0 / largest
    # A double root that rounding has made a conjugate pair counts; Newton's method decides.
    found = algebra.real_roots(p, 1e-4, roots)
    E = np.empty((3, 3))
    count = 0
    for k in range(found):
        R, x = out.R[count], out.x[count]
        if _essential_matrix(B, roots[k], basis, E) and _decompose(E, sample, R, x) \
                and _polish(sample, R, x) \
                and not _is_known(R, x, out.R[:count], out.x[:count]):
            count += 1
    return count


# Angular 3-point solver: derotated rays and gravity known, yaw and translation unknown.

MAX_3PT = 4
DEGREE = 2
HALF_ANGLE, NODES = algebra.half_angle_matrix(DEGREE), algebra.half_angle_nodes(DEGREE)


@small_kernel
def _triple(a: Array, b: Array, c: Array) -> float:
    """``a . (b x c)``."""
    return so3.dot(a, so3.cross(b, c))


@kernel
def solve_angular_3pt(sample: Sample, known: Knowledge, out: Solutions) -> int:
    """The normals ``n = f_1 x R f_2`` of three matches are in one plane, perpendicular to t.

    With gravity on z in both frames ``R = A_1^T Rz(psi) A_2``, and the determinant of the 3x3
    matrix of normals (section 'Angular 3-point algorithm') is a trigonometric polynomial of degree
    2 in psi: five samples give a polynomial of degree 4 in the tangent of the half angle. For the
    global shutter this is the upright 3-point problem of Fraundorfer et al. (ECCV 2010).

    The model is exact for a global shutter and for a constant velocity.
    """
    rays = common.align_rays(sample, known)
    n, dn = np.empty((3, 3)), np.empty((3, 3))
    samples = np.empty(NODES.shape[0])
    for k in range(NODES.shape[0]):
        c, s, weight = algebra.sample_angle(NODES[k], rays.zoom)
        common.normals_at_yaw(rays, c, s, n, dn)
        samples[k] = _triple(n[0], n[1], n[2]) * weight**DEGREE
    angles, half_gaps = np.empty(MAX_3PT), np.empty(MAX_3PT)
    found = algebra.angles_of_zeros(samples, HALF_ANGLE, rays.zoom, angles, half_gaps)
    count = 0
    for k in range(found):
        psi = angles[k]
        common.normals_at_yaw(rays, math.cos(psi), math.sin(psi), n, dn)
        if half_gaps[k] == 0.0:
            # A Newton step on the determinant removes the rounding of the polynomial.
            slope = (_triple(dn[0], n[1], n[2]) + _triple(n[0], dn[1], n[2])
                     + _triple(n[0], n[1], dn[2]))
            step = _triple(n[0], n[1], n[2]) / slope
            if abs(step) < 1e-4:
                psi -= step
                common.normals_at_yaw(rays, math.cos(psi), math.sin(psi), n, dn)
        direction, length2 = algebra.null_direction(n)
        if not length2 > 1e-28:
            continue
        t, scale = so3.rotated_back(known.align1, direction), 1.0 / math.sqrt(length2)
        for i in range(3):
            out.x[count, i] = scale * t[i]
        common.rotation_from_yaw(rays.centre + psi, known, out.R[count])
        common.point_forward(sample, out.R[count], out.x[count])
        count += 1
    return count
