"""Draws epipolar_lines.jpg: a pair of the bundled bag with OpenCV's epipolar lines and ours.

PYTHONPATH=. python docs/images/epipolar_lines.py

The pair with the median error of OpenCV's 5-point (RANSAC, 1 px) among the pairs whose direction
of translation lies in the image; the lower one of two medians.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.methods import opencv_five_point, Pose, undistorted
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import sensor_model
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import Sensor
from rs_relpose_ros.offline.replay import read_truth, Replay
from rs_relpose_ros.offline.truth import PairErrors
from rs_relpose_ros.pipeline.pair import PairResult

Array = NDArray[np.float64]

BAG = Path('bags/hand_held')
SIZE = np.array([640.0, 480.0])
LINES = 24
DISTANCES = np.geomspace(1.5, 3000.0, 400)   # along a ray [baselines]
STILL = FrameMotion(np.zeros(3))
NAMES = 'OpenCV 5-point, which assumes a global shutter', 'this package'


def curves(origins: Array, rays: Array, pose: Pose | RelativePose, velocity2: Array,
           motion2: FrameMotion, sensor: Sensor) -> list[Array]:
    """Pixels in image 2 of the points along rays (N, 3) from origins (N, 3) of camera 1."""
    found = []
    for origin, ray in zip(origins, rays, strict=True):
        in_second = (origin + DISTANCES[:, None] * ray - pose.t) @ pose.R
        times = np.zeros(len(DISTANCES))
        for _ in range(4):
            observed = in_second - times[:, None] * velocity2
            rays = observed / np.linalg.norm(observed, axis=1)[:, None]
            pixels = sensor.project(rays, times, motion2)
            times = np.nan_to_num(sensor.camera.row_times(pixels[:, 1]))
        pixels[in_second[:, 2] < 0.1] = np.nan
        found.append(pixels)
    return found


def distance(point: Array, curve: Array) -> float:
    """Distance of a point to a polyline [px]."""
    start, step = curve[:-1], np.diff(curve, axis=0)
    share = np.clip(np.sum((point - start) * step, axis=1)
                    / np.maximum(np.sum(step**2, axis=1), 1e-12), 0.0, 1.0)
    return float(np.nanmin(np.linalg.norm(start + share[:, None] * step - point, axis=1)))


def draw(axis: Axes, result: PairResult, lines: list[Array], chosen: NDArray[np.int64], title: str,
         epipole: Array, true_epipole: Array) -> None:
    """Image 2 with the curves of some matches, the matches, and the position of camera 1."""
    image = result.image2
    assert image is not None
    height, width = image.shape
    axis.imshow(image, cmap='gray', alpha=0.65)
    for k in chosen:
        axis.plot(*lines[k].T, color='#0072B2', linewidth=0.9)
    axis.plot(*result.matches.points2[chosen].T, 'o', color='#E69F00', markersize=3.5,
              label='matched corners, each with its line')
    axis.plot(*epipole, 'x', color='#D55E00', markersize=13, markeredgewidth=2.5,
              label='estimated direction of translation')
    axis.plot(*true_epipole, '+', color='#00E000', markersize=17, markeredgewidth=2.5,
              label='true direction of translation')
    axis.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axis.set_title(title, fontsize=10)


def direction(R: Array, t: Array, sensor: Sensor) -> Array:
    """Pixel (2,) of image 2 towards which the camera moves."""
    towards = R.T @ t
    return np.asarray(sensor.camera.project((towards * np.sign(towards[2]))[None])[0])


def main() -> None:
    """Choose the pair, and draw it."""
    parameters = read_parameters(BAG.with_suffix('.yaml'))
    with open_bag(BAG) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        replay = Replay(bag, topics, parameters, keep_images=True)
        pairs = [pair for pair in replay.pairs() if pair.pose]
        intrinsics = replay.intrinsics
    assert truth is not None and intrinsics is not None
    sensor = sensor_model(intrinsics, parameters.sensor)
    at_once = sensor._replace(camera=intrinsics.global_shutter_camera())

    found: list[tuple[PairErrors, PairResult, Pose]] = []
    for pair in pairs:
        pixels = [undistorted(points, at_once.camera)
                  for points in (pair.matches.points1, pair.matches.points2)]
        pose = opencv_five_point(pixels[0], pixels[1], at_once.camera, 1.0, estimator='RANSAC')
        true = truth.relative_pose(pair.reference_ns1, pair.reference_ns2)
        assert true is not None
        inside = np.abs(direction(*true, at_once) - SIZE / 2) < SIZE / 2
        if pose is not None and inside.all():
            errors = truth.errors(pose.R, pose.t, pair.reference_ns1, pair.reference_ns2)
            assert errors is not None
            found.append((errors, pair, pose))
    found.sort(key=lambda item: item[0].translation_error)
    errors, pair, pose = found[(len(found) - 1) // 2]
    ours, true = pair.pose, truth.relative_pose(pair.reference_ns1, pair.reference_ns2)
    own_errors = truth.errors(ours.R, ours.t, pair.reference_ns1, pair.reference_ns2)
    assert own_errors is not None and true is not None

    rays = at_once.camera.unproject(pair.matches.points1)
    opencv_lines = curves(np.zeros_like(rays), rays, pose, np.zeros(3), STILL, at_once)
    own_lines = curves(pair.row_times1[:, None] * ours.linear_velocity1, pair.rays1, ours,
                       ours.linear_velocity2, FrameMotion(ours.angular_velocity2), sensor)
    inliers = np.flatnonzero(ours.inliers)
    order = np.argsort(pair.matches.points2[inliers] @ (1.0, 0.37))
    chosen = inliers[order[np.linspace(0, len(order) - 1, LINES).astype(int)]]
    figure = Figure(figsize=(13.0, 5.9), dpi=100, layout='constrained')
    for axis, name, lines, errors_of, epipole in zip(
            figure.subplots(1, 2), NAMES, (opencv_lines, own_lines), (errors, own_errors),
            (direction(pose.R, pose.t, at_once), direction(ours.R, ours.t, at_once)), strict=True):
        off = np.median([distance(pair.matches.points2[k], lines[k]) for k in inliers])
        draw(axis, pair, lines, chosen,
             f'{name}\nerror of the translation {errors_of.translation_error:.2f} deg, of the '
             f'rotation {errors_of.rotation_error:.3f} deg; matches lie {off:.2f} px off',
             epipole, direction(*true, at_once))
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=3, fontsize=10)
    readout, interval = 1e3 * sensor.camera.readout_time, 1e3 * pair.interval
    figure.suptitle('an image pair: the epipolar lines of its matches, and the epipole '
                    f'(read out in {readout:.0f} ms, {interval:.0f} ms apart)', fontsize=12)
    figure.savefig(Path(__file__).with_suffix('.jpg'), pil_kwargs={'quality': 88})


if __name__ == '__main__':
    main()
