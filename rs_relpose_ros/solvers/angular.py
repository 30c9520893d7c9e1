"""The calibrated 5-point solver.

Nister, *An Efficient Solution to the Five-Point Relative Pose Problem*, PAMI 2004, with the roots
of the degree-10 polynomial isolated by its derivatives, and the essential matrix decomposed by
Horn's closed form (*Recovering Baseline and Orientation from 'Essential' Matrix*, 1990).
"""

import math

import numpy as np

from rs_relpose_ros.geometry import Array, Indices
from rs_relpose_ros.geometry.so3 import (
    copy_matrix,
    copy_vector,
    cross,
    exp_so3,
    log_so3,
    scale,
    subtract,
    write_column,
)
from rs_relpose_ros.jit import kernel, small_kernel
from rs_relpose_ros.solvers import algebra, common
from rs_relpose_ros.solvers.common import Knowledge, Sample, Solutions

# Most real solutions. [derived: degree of the polynomial in z]
MAX_5PT = 10

# Cubic monomials in Nister's order: the first ten are eliminated. [derived: the paper]
_CUBIC = [
    'xxx',
    'yyy',
    'xxy',
    'xyy',
    'xxz',
    'xx1',
    'yyz',
    'yy1',
    'xyz',
    'xy1',
    'xzz',
    'xz1',
    'x11',
    'yzz',
    'yz1',
    'y11',
    'zzz',
    'zz1',
    'z11',
    '111',
]
# Quadratic monomials, in any order. [chosen: any order would do]
_QUADRATIC = ['xx', 'xy', 'xz', 'x1', 'yy', 'yz', 'y1', 'zz', 'z1', '11']
# Linear monomials, in the order of the rows of the basis. [derived: E = x B_0 + ... + 1 B_3]
_ORDER = 'xyz1'


def _product_table(left: list[str], products: list[str]) -> Indices:
    """Index in `products` of each monomial of `left` times each of x, y, z, 1."""
    return np.array(
        [[products.index(''.join(sorted(m + v, key=_ORDER.index))) for v in _ORDER] for m in left]
    )


# Most steps that polish a solution, whose error is the rounding of the elimination before them.
# [chosen: any value in 4..15 would do]
_POLISHING = 6
# Products of two linear polynomials, and of a quadratic with a linear one. [derived: the lists]
_TO_QUADRATIC = _product_table(list(_ORDER), _QUADRATIC)
# The same of a quadratic monomial. [derived: the lists]
_TO_CUBIC = _product_table(_QUADRATIC, _CUBIC)


@kernel
def _reflect(unit: Array, vector: Array) -> None:
    """Reflect `vector` (n,) in place at the plane across a unit vector."""
    along = 0.0
    for i in range(len(unit)):
        along += unit[i] * vector[i]
    for i in range(len(unit)):
        vector[i] -= 2.0 * along * unit[i]


@small_kernel
def _null_space(rows: Array, basis: Array) -> None:
    """Write an orthonormal basis (4, 9) of the null space of `rows` (5, 9), which are overwritten.

    It is the last four columns of Q of the transposed matrix, by Householder reflections.
    """
    for k in range(5):
        row = rows[k]
        length2 = 0.0
        for i in range(9):
            row[i] = row[i] if i >= k else 0.0
            length2 += row[i] * row[i]
        row[k] += math.copysign(math.sqrt(length2), row[k])
        algebra.normalise(row)
        for j in range(k + 1, 5):
            _reflect(row, rows[j])
    basis[:] = 0.0
    for c in range(4):
        basis[c, 5 + c] = 1.0
        for k in range(4, -1, -1):
            _reflect(rows[k], basis[c])


@kernel
def _add_product(p: Array, q: Array, factor: float, table: Indices, out: Array) -> None:
    """Add `factor` times the product of a polynomial and a linear one, `q` (4,), to `out`."""
    for i in range(len(table)):
        for j in range(4):
            out[table[i, j]] += factor * p[i] * q[j]


@small_kernel
def _cubic_constraints(basis: Array, M: Array) -> None:
    """Write ``det E = 0`` and ``(E E^T - trace(E E^T) / 2) E = 0`` into `M` (10, 20).

    The columns are the 20 cubic monomials of ``E = x B_0 + y B_1 + z B_2 + B_3``, where B_0 to
    B_3 are the rows of `basis` (4, 9).
    """
    E = np.empty((9, 4))
    copy_matrix(basis.T, E)
    M[:] = 0.0
    minor = np.empty(10)
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        minor[:] = 0.0
        _add_product(E[3 + j], E[6 + k], 1.0, _TO_QUADRATIC, minor)
        _add_product(E[3 + k], E[6 + j], -1.0, _TO_QUADRATIC, minor)
        _add_product(minor, E[i], 1.0, _TO_CUBIC, M[0])
    EET = np.zeros((9, 10))
    for i in range(3):
        for j in range(i, 3):
            product = EET[3 * i + j]
            for k in range(3):
                _add_product(E[3 * i + k], E[3 * j + k], 1.0, _TO_QUADRATIC, product)
            copy_vector(product, EET[3 * j + i])
    diagonal = EET[::4]
    for m in range(10):
        half_trace = 0.5 * (diagonal[0, m] + diagonal[1, m] + diagonal[2, m])
        for i in range(3):
            diagonal[i, m] -= half_trace
    for i in range(3):
        for j in range(3):
            constraint = M[1 + 3 * i + j]
            for k in range(3):
                _add_product(EET[3 * i + k], E[3 * k + j], 1.0, _TO_CUBIC, constraint)


@small_kernel
def _reduced_constraints(basis: Array, reduced: Array) -> bool:
    """Eliminate the first ten monomials, and write the other ten columns into `reduced` (10, 10).

    Each row of `reduced` is a column. Rounding is proportional to the largest coefficient. If that
    exceeds 1e4, as in 1 to 2 % of random problems, another `basis` (4, 9) is used, in which it
    rarely does so again.
    """
    M = np.empty((10, 20))
    left = np.empty((10, 10))
    pivots = np.empty(10, np.int64)
    coefficient = math.inf
    for attempt in range(3):
        if attempt > 0:
            # A rotation by 60 degrees: the quaternion (1 + i + j + k) / 2 times (x, y, z, 1).
            for m in range(9):
                column = basis[:, m]
                a = column[0]
                b = column[1]
                c = column[2]
                d = column[3]
                column[0] = 0.5 * (a - b - c - d)
                column[1] = 0.5 * (a + b - c + d)
                column[2] = 0.5 * (a + b + c - d)
                column[3] = 0.5 * (a - b + c + d)
        _cubic_constraints(basis, M)
        copy_matrix(M[:, :10], left)
        algebra.lu_factor(left, pivots)
        coefficient = 0.0
        for j in range(10):
            kept = reduced[j]
            copy_vector(M[:, 10 + j], kept)
            algebra.lu_solve(left, pivots, kept)
            for value in kept[4:]:
                coefficient = max(coefficient, abs(value))
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
def _degree_10(reduced: Array, B: Array, p: Array) -> None:
    """Write the polynomials in z ``B(z) (x, y, 1) = 0``, `B` (3, 3, 5), and det B, `p` (11,)."""
    B[:] = 0.0
    for r in range(3):
        # Row 4 + 2 r less z times the next one: the leading monomials cancel.
        for c in range(3):
            polynomial = B[r, c]
            terms = 4 if c == 2 else 3
            for j in range(terms):
                power = terms - 1 - j
                column = reduced[3 * c + j]
                polynomial[power] += column[4 + 2 * r]
                polynomial[power + 1] -= column[5 + 2 * r]
    p[:] = 0.0
    minor = np.empty(7)
    for r in range(3):
        i = (r + 1) % 3
        j = (r + 2) % 3
        minor[:] = 0.0
        _multiply_add(B[i, 0], 4, B[j, 1], 4, 1.0, minor)
        _multiply_add(B[j, 0], 4, B[i, 1], 4, -1.0, minor)
        _multiply_add(minor, 7, B[r, 2], 5, 1.0, p)


@small_kernel
def _essential_matrix(B: Array, z: float, basis: Array, E: Array) -> bool:
    """Write E (3, 3) with ``|E| = sqrt(2)`` at a root z, where B(z) has the null vector (x, y, 1).

    Returns False if E is not finite.
    """
    V = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            V[i, j] = algebra.value(B[i, j], z)
    (x, y, w), _ = algebra.null_direction(V)
    norm2 = 0.0
    for i in range(3):
        for j in range(3):
            b = basis[:, 3 * i + j]
            entry = x * b[0] + y * b[1] + w * (z * b[2] + b[3])
            E[i, j] = entry
            norm2 += entry * entry
    if not 0.0 < norm2 < math.inf:
        return False
    E *= math.sqrt(2.0 / norm2)
    return True


@small_kernel
def _decompose(E: Array, sample: Sample, R: Array, x: Array) -> bool:
    """Write R and t (into `x`) of ``E = [t]x R`` with most points on one side of both cameras.

    By Horn, ``(t.t) R = cofactors(E) -+ [t]x E``, for t and for -t. Returns False if E has no
    translation.
    """
    t, length2 = algebra.null_direction(np.ascontiguousarray(E.T))
    unit = scale(1.0 / math.sqrt(length2), t)
    for i in range(3):
        x[i] = unit[i]
    candidate = np.empty((3, 3))
    best = -1
    for twist in (1.0, -1.0):
        for j in range(3):
            # Column of the cofactors less a column of [t]x E.
            cofactors = cross(E[:, (j + 1) % 3], E[:, (j + 2) % 3])
            twisted = scale(twist, cross(unit, E[:, j]))
            write_column(subtract(cofactors, twisted), candidate, 0, j)
        votes = max(common.cheirality_votes(sample, candidate, x))
        if votes > best:
            best = votes
            # The logarithm and the exponential remove the rounding.
            copy_matrix(exp_so3(log_so3(candidate)), R)
    return length2 > 1e-20


@kernel
def solve_5pt(sample: Sample, _known: Knowledge, out: Solutions) -> int:
    """Solve the calibrated 5-point problem: one pose for each real essential matrix.

    Of the four decompositions of a matrix, the pose is the one with most points in front of both
    cameras. For derotated rays see section 'Angular 5-point algorithm' of the paper, and for the
    method see `rs_relpose_ros.solvers.angular`.
    """
    rows = np.empty((5, 9))
    for k in range(5):
        row = rows[k]
        f1 = sample.f1[k]
        f2 = sample.f2[k]
        for i in range(3):
            for j in range(3):
                row[3 * i + j] = f1[i] * f2[j]  # f_1^T E f_2 = 0
    basis = np.empty((4, 9))
    reduced = np.empty((10, 10))
    _null_space(rows, basis)
    if not _reduced_constraints(basis, reduced):
        return 0
    B = np.empty((3, 3, 5))
    p = np.empty(11)
    angles = np.empty(10)
    gaps = np.empty(10)
    _degree_10(reduced, B, p)
    # A double root that rounding has made a conjugate pair counts; Newton's method decides.
    found = algebra.angles_of_zeros(p, 1.0, angles, gaps)
    E = np.empty((3, 3))
    x = np.zeros(9)
    factors = common.row_time_factors(sample)
    axes = np.eye(3)
    count = 0
    for k in range(found):
        R = out.R[count]
        if (
            _essential_matrix(B, math.tan(0.5 * angles[k]), basis, E)
            and _decompose(E, sample, R, x)
            and common.polish(sample, factors, axes, R, x[:3], int(_POLISHING))
            and not common.is_known(R, out.R[:count])
            and common.write_solution(sample, factors, R, x[:3], out.x[count])
        ):
            count += 1
    return count
