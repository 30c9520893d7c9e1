"""The vector of deviations: one order, and selections of it."""

import numpy as np
import pytest

from rs_relpose_ros.core import radial
from rs_relpose_ros.core.deviations import (
    ENTRIES,
    LIVE,
    N_DEVIATIONS,
    OFFLINE,
    PARTS,
    Selection,
)
from rs_relpose_ros.geometry import lens
from rs_relpose_ros.geometry.camera import RollingShutterCamera


def test_parts_of_the_vector_follow_one_another():
    everything = Selection.of(*(entry.name for entry in ENTRIES))
    ends = [0, *(part.stop for part in everything.parts.values())]
    assert [part.start for part in everything.parts.values()] == ends[:-1]
    assert sum(entry.size for entry in ENTRIES) == N_DEVIATIONS


def test_a_selection_is_the_basis_of_its_values():
    chosen = Selection.of('time_offset', gyro_scale=np.ones((3, 1)))
    assert chosen.basis.shape == (N_DEVIATIONS, 2) and chosen.size == 2
    everything = Selection.of(*(entry.name for entry in ENTRIES))
    np.testing.assert_array_equal(everything.basis, np.eye(N_DEVIATIONS))
    values = chosen.basis @ [0.01, 0.2]
    assert values[everything.index('time_offset')] == 0.01
    assert values[everything.part('gyro_scale')].tolist() == [0.2] * 3
    assert np.count_nonzero(values) == 4
    assert chosen.sigmas.tolist() == [0.05, 0.2]
    assert chosen.mask('gyro_scale').tolist() == [False, True]


def test_values_of_a_camera_are_its_width_and_shapes_of_its_lens():
    camera = RollingShutterCamera(
        width=640, height=480, fx=450.0, fy=450.0, cx=320.0, cy=240.0, readout_time=0.0
    )
    basis = LIVE.of_camera(camera)
    at_lens = np.ix_(range(N_DEVIATIONS)[PARTS['distortion']], range(LIVE.size))
    shapes = basis[at_lens][:, LIVE.part('distortion')]
    # The first one is k1 alone. The others displace points by 2 % of the radius at the corner, and
    # are independent of it by the prior.
    assert shapes[:, 0].tolist() == [1.0, 0.0, 0.0]
    radius = radial.corner_radius(camera)
    prior = radial.prior_covariance(radius)
    scaled = shapes * radial.WRONG_SIGMA
    weights = scaled.T @ np.linalg.inv(prior) @ scaled
    np.testing.assert_allclose(weights[1:, 1:], np.eye(2), atol=1e-6)
    np.testing.assert_allclose(weights[0, 1:], 0.0, atol=1e-6 * weights[0, 0])
    center = basis[PARTS['principal_point'], LIVE.part('principal_point')]
    np.testing.assert_array_equal(center, 640 * np.eye(2))


def test_the_order_is_the_order_of_the_table_whoever_selects():
    named = Selection.of('readout_time', 'axes')
    assert named.part('axes') == slice(0, 3) and named.index('readout_time') == 3
    for selection in (LIVE, OFFLINE):
        order = [entry.name for entry in ENTRIES if entry.name in selection.parts]
        assert list(selection.parts) == order


def test_deviations_of_the_lens_have_its_order_and_follow_one_another():
    names = [name for name, _ in lens.LENS_ENTRIES]
    sizes = {entry.name: entry.size for entry in ENTRIES}
    first = list(sizes).index(names[0])
    assert list(sizes.items())[first : first + len(names)] == list(lens.LENS_ENTRIES)


def test_names_that_are_none_and_places_of_several_values_are_refused():
    with pytest.raises(ValueError, match='tilt'):
        Selection.of('axes', 'tilt')
    with pytest.raises(ValueError, match='axes'):
        LIVE.index('axes')
