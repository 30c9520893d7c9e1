"""Landmarks and pixels of global shutters of a pair, against a scene that shares no code."""

from __future__ import annotations

from dataclasses import replace

import message_builders as build
import numpy as np
import pytest
from simulated_pairs import SENSOR, simulated_flight

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.landmarks import landmarks
from rs_relpose_ros.messages.outgoing import inlier_records, pair_messages
from rs_relpose_ros.messages.published_pair import match_records


@pytest.mark.parametrize('seed', range(3))
def test_exact_matches_give_the_truth(seed):
    flight = simulated_flight(seed)
    for pair, truth, baseline in zip(flight.pairs, flight.true_landmarks, flight.baselines,
                                     strict=True):
        found = pair.landmarks
        np.testing.assert_allclose(found.points * baseline, truth.points, rtol=1e-8)
        np.testing.assert_allclose(found.pixels1, truth.pixels1, atol=1e-7)
        np.testing.assert_allclose(found.pixels2, truth.pixels2, atol=1e-7)
        # While the rows are read, turning and moving shift pixels by more than either alone.
        assert np.linalg.norm(pair.matches.points1 - truth.pixels1, axis=1).max() > 3.0


def test_rays_that_are_parallel_have_pixels_and_no_point():
    pair = simulated_flight(1).pairs[0]
    parallel = pair.rays1 @ pair.pose.R
    found = landmarks(pair.pose, pair.rays1, parallel, pair.row_times1, pair.row_times2,
                      SENSOR.camera)
    assert np.isnan(found.points).all()
    # Turned to the stamped row, as a camera that only turns sees them.
    np.testing.assert_allclose(found.pixels1, SENSOR.camera.project(pair.rays1), atol=1e-9)
    np.testing.assert_allclose(found.pixels2, SENSOR.camera.project(parallel), atol=1e-9)


def test_outliers_have_none():
    pair = simulated_flight(2).pairs[0]
    inliers = np.arange(len(pair.matches)) % 3 > 0
    found = landmarks(replace(pair.pose, inliers=inliers), pair.rays1, pair.rays2, pair.row_times1,
                      pair.row_times2, SENSOR.camera)
    for values in found:
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), inliers)


def test_published_records_tell_of_points_that_are_not_known():
    pair = simulated_flight(0).pairs[0]
    points = pair.landmarks.points.copy()
    points[3] = np.nan
    pair = replace(pair, landmarks=pair.landmarks._replace(points=points))
    cloud = pair_messages(pair, build.rosbags_types).matches
    assert not cloud.is_dense
    records = match_records(cloud)
    assert np.isnan(records['x']).nonzero()[0].tolist() == [3]
    assert records.tobytes() == inlier_records(pair).tobytes()
    broken = inlier_records(pair)
    broken['u1_gs'][5] = np.nan
    cloud.data = np.frombuffer(broken.tobytes(), dtype=np.uint8)
    with pytest.raises(InputError, match='must be finite'):
        match_records(cloud)
