"""Stamps of the IMU that repeat, come late, leave gaps or jump: counted, and of no harm."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.frame import Frame
from rs_relpose_ros.front_end.sequencer import ReadyFrame, Refusal, Sequencer
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.imu.integration import integrate_rotation
from rs_relpose_ros.imu.samples import ImuSample

MS = 1_000_000
CALIBRATION = Intrinsics(width=32, height=20, fx=30.0, fy=30.0, cx=16.0, cy=10.0,
                          image_width=32, image_height=20)


def sequencer():
    return Sequencer(Parameters.from_mapping(
        {'readout_time': 0.02, 'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0)}), offline=True)


def sample(ms):
    return ImuSample(round(ms * MS), (0.1, 0.5, 0.01 * ms), (0.0, -9.8, 0.0))


def taken(order, frame_ms=100.0):
    """Outcome of a frame, and the counts, of samples that came in this order [ms]."""
    made = sequencer()
    for ms in order:
        made.add_imu(sample(ms))
    made.add_frame(Frame(round(frame_ms * MS), np.zeros((20, 32), np.uint8), 'camera',
                         CALIBRATION))
    return made.take(), made.counts()


STEADY = [5.0 * k for k in range(60)]


@pytest.mark.parametrize('order, repeated, late, gaps', [
    (STEADY, 0, 0, 0),
    ([ms for ms in STEADY for _ in range(2)], 60, 0, 0),
    ([*STEADY[:20], STEADY[21], STEADY[20], *STEADY[22:]], 0, 1, 0),
    ([*STEADY[:40], *STEADY[55:]], 0, 0, 1),
], ids=['steady', 'repeated', 'late', 'gap'])
def test_what_is_wrong_is_counted_and_changes_no_frame_elsewhere(order, repeated, late, gaps):
    ready, counts = taken(order)
    assert (counts.imu_repeated, counts.imu_late, counts.imu_gaps) == (repeated, late, gaps)
    reference, _ = taken(STEADY)
    assert isinstance(ready, ReadyFrame)
    assert np.array_equal(ready.imu.motion.knot_rotations, reference.imu.motion.knot_rotations)


def test_a_gap_within_the_rows_is_refused():
    refused, _ = taken([ms for ms in STEADY if not 100.0 < ms < 170.0])
    assert refused.cause is Refusal.IMU_GAP


def test_stamps_that_jump_back_start_anew():
    made = sequencer()
    for ms in STEADY:
        made.add_imu(sample(5000.0 + ms))
    for ms in STEADY:
        made.add_imu(sample(ms))
    made.add_frame(Frame(100 * MS, np.zeros((20, 32), np.uint8), 'camera', CALIBRATION))
    assert isinstance(made.take(), ReadyFrame)
    assert made.counts().clock_jumps == 1


def test_two_topics_are_not_late_to_each_other():
    made = sequencer()
    for ms in STEADY:
        made.add_imu(ImuSample(round(ms * MS), (0.1, 0.5, 0.0), None))
        made.add_imu(ImuSample(round((ms - 2.0) * MS), None, (0.0, -9.8, 0.0)))
    assert made.counts().imu_late == 0


def test_rows_and_frames_are_integrated_alike():
    """`FrameMotion.from_gyro` and `integrate_rotation`: one rule for a rate that changes."""
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(2 * MS, 8 * MS, 9))
    rates = 3.0 * rng.normal(size=(9, 3))
    motion = FrameMotion.from_gyro((stamps - stamps[0]) * 1e-9, rates)
    for k in range(1, 9):
        rotation, _ = integrate_rotation(stamps[:k + 1], rates[:k + 1], ImuConfig())
        np.testing.assert_allclose(motion.knot_rotations[k], rotation, atol=1e-12)
    # And not the midpoint rule.
    midpoint = Rotation.identity()
    for k in range(8):
        midpoint = midpoint * Rotation.from_rotvec(
            0.5 * (rates[k] + rates[k + 1]) * (stamps[k + 1] - stamps[k]) * 1e-9)
    assert np.abs(midpoint.as_matrix() - motion.knot_rotations[8]).max() > 1e-5
