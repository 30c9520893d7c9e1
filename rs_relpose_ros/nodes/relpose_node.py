"""relpose_node: publishes the keyframe pairs of a rolling-shutter camera with an IMU."""

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.settings import PairConfig, Parameters
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.outgoing import DEBUG_IMAGE, PAIR_TOPICS
from rs_relpose_ros.nodes import diagnostics
from rs_relpose_ros.nodes.inputs import message_class, transform_broadcaster
from rs_relpose_ros.nodes.sensor_node import run_node, SensorNode
from rs_relpose_ros.pipeline.pair import Frame, PairResult
from rs_relpose_ros.pipeline.pipeline import FrontEnd
from rs_relpose_ros.pipeline.warm_up import warm_up_pipeline
from rs_relpose_ros.tracking.images import Pixels

NAME = 'relpose_node'

_DESCRIPTION = (
    'Relative poses of a rolling-shutter camera, aided by an IMU.\n\n'
    'subscribes: image (or image/compressed with image_transport:=compressed), '
    'camera_info, imu, accel\n'
    'publishes:  ~/relative_pose, ~/reference, ~/velocity, ~/matches, '
    '~/relative_rotation, ~/pairs,\n            ~/debug_image, ~/calibration, /diagnostics\n'
    'services:   ~/reset, ~/calibrate, ~/save_calibration')


class RelposeNode(SensorNode):
    """Relative poses of a rolling-shutter camera with an IMU."""

    task = diagnostics.RELATIVE_POSE

    def __init__(self) -> None:
        self._statistics = diagnostics.Statistics()
        self._timings: diagnostics.FrameTimings | None = None
        super().__init__(NAME, self._statistics)

    def _open_outputs(self, parameters: Parameters) -> None:
        self._outputs = PairPublishers(self, parameters.pair)
        self._log_health = diagnostics.HealthLog(self._info, self._warn, self._error)

    def _make_loop(self, parameters: Parameters) -> FrontEnd:
        files = parameters.pair
        if files.stamps_file and self._stamps is None:
            self._stamps = diagnostics.LineFile('stamps_file', files.stamps_file, self._error)
        if files.timings_file and self._timings is None:
            self._timings = diagnostics.FrameTimings(files.timings_file, self._error)
        # The images are for ~/debug_image; only references to them are kept.
        return FrontEnd(parameters, keep_images=True)

    def _warm_up(self) -> None:
        warm_up_pipeline(self._settings.current)
        if self._timings is not None:
            self._timings.start()

    def stop(self) -> bool:
        """End the worker; whether it did. Call it before `destroy_node`."""
        stopped = super().stop()
        for file in (self._stamps, self._timings):
            if file is not None and stopped:
                file.close()
        return stopped

    def _on_processed(self, frame: Frame[PairResult]) -> None:
        if frame.result is not None:
            config = self._settings.current.pair
            self._outputs.publish(frame.result, config)
            self._statistics.add_pair(frame.result, frame.ready_ns)
            self._outputs.publish_picture(frame.result, config)
            self._log_health(frame.result.health, withhold=config.withhold_when_wrong)
        if self._timings is not None:
            self._timings.add(frame)


# -- Topics ---------------------------------------------------------------------------------------

class PairPublishers:
    """Publishes pairs on the topics of the node, and as a transform with publish_tf."""

    def __init__(self, node: Node, config: PairConfig) -> None:
        self._pair = {
            name: node.create_publisher(message_class(msgtype), f'~/{name}', outgoing.PAIR_HISTORY)
            for name, msgtype in PAIR_TOPICS.items()}
        self._debug_image = node.create_publisher(
            message_class('sensor_msgs/msg/Image'), f'~/{DEBUG_IMAGE}', 2)
        self._transforms = (transform_broadcaster(node, 'publish_tf') if config.publish_tf
                            else None)

    def publish(self, result: PairResult, config: PairConfig) -> None:
        """Publish all that is known of a pair."""
        messages = outgoing.pair_messages(result, message_class, config.reference_frame)
        for topic, message in messages.items():
            self._pair[topic].publish(message)
        if self._transforms is not None and result.pose:
            # The camera has its parent in the robot's tree already, and a frame has only one: so
            # the reference is the child, by the pose's inverse. Its origin is one baseline away,
            # whose length in metres is unknown.
            quaternion = outgoing.quat_xyzw(result.pose.R)
            self._transforms.sendTransform(outgoing.transform_message(
                result.stamp_ns, result.frame_id, messages['relative_pose'].header.frame_id,
                quaternion * [-1.0, -1.0, -1.0, 1.0],
                -Rotation.from_quat(quaternion).inv().apply(result.pose.t), message_class))

    def publish_picture(self, result: PairResult, config: PairConfig) -> None:
        """Publish ~/debug_image of any pair, if it is subscribed."""
        if config.publish_debug_image and self._debug_image.get_subscription_count():
            self._debug_image.publish(outgoing.image_message(
                result.stamp_ns, result.frame_id, Pixels(draw_debug_image(result), 'bgr8'),
                message_class))


# -- ~/debug_image: tracks, inliers and row times -------------------------------------------------

Color = NDArray[np.uint8]

# Largest width [px]; wider images are reduced, because publishing large messages is slow.
_MAX_WIDTH = 960
_BAR_WIDTH = 14
_CAPTION_HEIGHT = 24
_OUTLIER = (255, 255, 0)
_WHITE = (255, 255, 255)
# Fractional bits of the coordinates that OpenCV draws at.
_SHIFT = 4


def draw_debug_image(result: PairResult) -> Color:
    """The current image (H, W, 3) in blue, green, red, with the matches of its pair.

    Each match is a line from its pixel in the reference keyframe to a dot at its current pixel.
    Inliers have the colour of their row time, explained by the bar on the left, outliers are cyan.
    A caption has the status. Needs the pair's images.
    """
    assert result.image2 is not None
    height, width = result.image2.shape
    scale = min(1.0, _MAX_WIDTH / width)
    size = (round(scale * width), round(scale * height))
    # Two thirds of the brightness, for the contrast of the lines.
    gray = cv2.resize(result.image2, size, interpolation=cv2.INTER_AREA) // 3 * 2
    canvas = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    points1, points2 = result.matches.points1, result.matches.points2
    inliers = result.pose.inliers
    if len(inliers) != len(points1):   # a pair without an estimate has none
        inliers = np.zeros(len(points1), dtype=bool)
    first, last = _span(result)
    colors = _colors(result.row_times2, first, last)
    # Pixel centres lie at integer coordinates.
    ends = np.round(((np.stack([points1, points2], axis=1) + 0.5) * scale - 0.5)
                    * (1 << _SHIFT)).astype(int)
    for (start, end), inlier, color in zip(ends.tolist(), inliers, colors, strict=True):
        color = color if inlier else _OUTLIER
        cv2.line(canvas, start, end, color, 1, cv2.LINE_AA, _SHIFT)
        cv2.circle(canvas, end, 2 << _SHIFT, color, -1, cv2.LINE_AA, _SHIFT)
    if len(points2):
        _draw_bar(canvas, result, first, last)
    return np.concatenate([canvas, _caption(result, int(inliers.sum()), size[0])])


def _span(result: PairResult) -> tuple[float, float]:
    """Least and largest row time [s] of the matches; they differ."""
    times = result.row_times2
    if len(times) == 0 or np.ptp(times) < 1e-6:
        return 0.0, 1.0
    return float(times.min()), float(times.max())


def _colors(times: NDArray[np.float64], first: float, last: float) -> list[tuple[int, ...]]:
    levels = np.clip(40 + 215 * (times - first) / (last - first), 0, 255).astype(np.uint8)
    if len(levels) == 0:
        return []
    return [tuple(color) for color in
            cv2.applyColorMap(levels[:, None], cv2.COLORMAP_PLASMA)[:, 0].tolist()]


def _draw_bar(canvas: Color, result: PairResult, first: float, last: float) -> None:
    """Colours of the rows, with the times of the first and the last row."""
    rows = result.matches.points2[:, 1]
    if np.ptp(rows) < 1.0:
        return
    scale = canvas.shape[1] / result.image2.shape[1]  # type: ignore[union-attr]
    of_rows = np.polyval(np.polyfit(rows, result.row_times2, 1), np.arange(len(canvas)) / scale)
    canvas[:, :_BAR_WIDTH] = np.array(_colors(of_rows, first, last), dtype=np.uint8)[:, None]
    for row, y in ((0, 14), (len(canvas) - 1, len(canvas) - 6)):
        cv2.putText(canvas, f'{1e3 * of_rows[row]:.1f} ms', (_BAR_WIDTH + 4, y),
                    cv2.FONT_HERSHEY_SIMPLEX, 0.42, _WHITE, 1, cv2.LINE_AA)


def _caption(result: PairResult, inliers: int, width: int) -> Color:
    pose = result.pose
    what = f'{pose.status.value} {pose.model}' if pose else pose.status.value
    text = (f'{what}: {inliers} of {len(result.matches.points1)} matches, parallax '
            f'{result.parallax:.1f} px, {1e3 * result.interval:.0f} ms')
    if pose:
        text += f', residual {pose.residual_rms:.2f} px'
    strip = np.zeros((_CAPTION_HEIGHT, width, 3), dtype=np.uint8)
    cv2.putText(strip, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _WHITE, 1, cv2.LINE_AA)
    return strip


main = partial(run_node, RelposeNode, NAME, _DESCRIPTION)
