"""The loop over frames, and the pipeline that tracks them and estimates keyframe pairs."""

from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
import math
import time
from typing import Any, Generic

import numpy as np

from rs_relpose_ros.calibration import findings
from rs_relpose_ros.calibration.assessment import configured_sigmas
from rs_relpose_ros.calibration.changes import BEYOND_JITTER
from rs_relpose_ros.calibration.findings import Configured
from rs_relpose_ros.calibration.posterior import PairData
from rs_relpose_ros.calibration.residual_maps import PairSums, View
from rs_relpose_ros.calibration.rotations import rotation_of_rays, RotationSums
from rs_relpose_ros.config.settings import ImuConfig, Parameters, sensor_model, SensorConfig
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.errors import MissingInputError, RsRelposeError
from rs_relpose_ros.estimator.estimate import estimate, evidence_for_inertial
from rs_relpose_ros.estimator.pair_problem import PairProblem
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.matches import Ids, Matches
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import STANDARD_GRAVITY
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between, Sensor
from rs_relpose_ros.imu.integration import FrameImu, ImuSlice
from rs_relpose_ros.pipeline import pair
from rs_relpose_ros.pipeline.monitor import (
    Applied,
    ConsistencyMonitor,
    Tracked,
)
from rs_relpose_ros.pipeline.pair import (
    Frame,
    Learned,
    Lesson,
    PairResult,
    Result,
    TrackHistory,
)
from rs_relpose_ros.pipeline.sequencer import (
    FrameRefused,
    SCATTER_FRAMES,
    Sequencer,
    stamp_scatter,
)
from rs_relpose_ros.pipeline.still_view import StillView
from rs_relpose_ros.tracking.features import make_tracker, Tracker
from rs_relpose_ros.tracking.images import Image

# Number of points, of the longest tracks, whose rotation is compared with the gyro. More points
# cost time and give no better rotation. [chosen: any value in 60..300 would do]
_ROTATION_POINTS = 120
# Number of frames from one comparison to the next. With one, the noise of the points is as large
# as the rotation; with many, few tracks are left. [chosen: a tenth of a second at 30 Hz]
_ROTATION_FRAMES = 3
# Last pairs whose largest jitter counts: late images come now and then. Fewer would publish pairs
# between them as exact, more would widen poses long after a busy moment. [chosen: 5 to 20 s]
_JITTER_PAIRS = 60
# Least time between two published pairs with too few matches [s]: in the dark each frame creates
# one. [chosen: two a second are enough for a display]
_UNMATCHED_PERIOD = 0.5
# Reason for a pair without the accelerometer. [derived: text for people]
_CONTRADICTED = 'images and accelerometer contradict each other (see health)'


@dataclass(slots=True, eq=False)
class _RotationStart:
    """An image that later ones are compared with, and the gyro's angle since."""

    stamp_ns: int
    ids: Ids  # (N,) of tracks
    rays: Array  # (N, 3) as measured
    by_gyro: Array = field(default_factory=lambda: np.zeros(3))  # (3,) [rad]
    frames: int = 0


class Processor(Generic[Result]):
    """Makes a result of each frame, in the order of their stamps and in one thread."""

    applied = Applied()  # tracked corrections for the next frame

    def prepare(self) -> None:
        """Work ahead of the next frame; `process` does it if it has not been called."""

    @abstractmethod
    def reset(self) -> None:
        """Forget the frames so far."""

    def gyro_only(self, parameters: Parameters) -> bool:
        """Whether the next frame is needed without gravity and specific force."""
        return False

    @abstractmethod
    def process(self, frame: Frame[Any], parameters: Parameters) -> Result | None:
        """Result of a frame, or None."""


class Pipeline(Processor[PairResult]):
    """Tracks frames against a reference keyframe and estimates the pose of each keyframe pair.

    Parameters that may change while running (declared `live`) are not kept: `process` gets the
    current ones with each frame. With `keep_images` results contain the current image. `tracker`
    replaces the tracker of the parameters.
    """

    def __init__(
        self, parameters: Parameters, keep_images: bool = False, tracker: Tracker | None = None
    ) -> None:
        missing = parameters.sensor.missing()
        if missing:
            raise MissingInputError('parameters are missing: ' + ', '.join(missing))
        self._keep_images = keep_images
        self._tracker = make_tracker(parameters.tracking) if tracker is None else tracker
        self._monitor = ConsistencyMonitor()
        self._still = StillView()
        self._sensor: Sensor | None = None
        self._readout = 0.0  # [s] of its camera, beyond the parameter
        self._stamps_ns: deque[int] = deque(maxlen=SCATTER_FRAMES)
        self._jitters: deque[float] = deque(maxlen=_JITTER_PAIRS)  # [s] of images on arrival
        self._lesson: Lesson | None = None  # of the last pair
        self._compare: Callable[[], None] | None = None  # after a pair
        self.reset()

    def reset(self) -> None:
        """Forget the reference keyframe: tracking restarts with the next frame."""
        self.prepare()  # live it is done by now
        self._tracker.reset()
        self._stamps_ns.clear()
        self._history: TrackHistory | None = None  # since the reference
        self._previous: Frame[Any] | None = None
        # The last derotated matches. They have the rays of the reference, and of the previous
        # image; each is None where these rays are not known.
        self._of_reference: Matches | None = None
        self._of_previous: Matches | None = None
        self._rotation: _RotationStart | None = None
        self._unmatched_ns: int | None = None  # of the last published pair with too few matches

    def process(self, frame: Frame[Any], parameters: Parameters) -> PairResult | None:
        """Track `frame`; the estimate of the keyframe pair that it creates, or None.

        Frames come in the order of their stamps. Tracking restarts with a frame whose intrinsics
        differ from the last one's, or that follows a gap of the gyro.
        """
        self.prepare()
        sensor = self._sensor_of(frame.intrinsics, parameters)
        self._stamps_ns.append(frame.stamp_ns)
        self._monitor.ahead.append(frame.ahead)
        history = self._history
        previous = self._previous
        step = frame.imu.since_previous
        # Without the gyro tracks are not predicted, and wrong ones that agree by chance pass.
        if history is None or previous is None or step is None:
            self._tracker.start(frame.image)
            self._still.start(frame.stamp_ns, frame.image)
            self._restart_from(frame)
            return None
        new = self._new_image(frame.stamp_ns, frame.image, frame.imu, previous.imu, sensor)
        if new is None:
            return None
        frame.imu_data = new
        step = new.since_previous
        assert step is not None
        predicted = self._predicted(previous.imu.motion, frame.imu.motion, step.rotation, sensor)
        passed = seconds_between(previous.stamp_ns, frame.stamp_ns)
        matches = self._tracker.track(frame.image, predicted, passed)
        self._previous = frame
        since = step if history.since is None else history.since.joined(step)
        history.add(frame.imu, since, matches)
        rays = self._derotate(
            matches,
            history.imu.motion,
            frame.imu.motion,
            sensor,
        )
        keyframe = pair.is_keyframe(
            parameters.keyframes,
            parallax=pair.parallax_of(rays, since, sensor),
            interval=pair.interval_of(history.imu, frame.imu),
            frames=len(history),
            tracked_fraction=self._tracker.tracked_fraction,
        )
        compare = partial(
            self._compare_rotations, frame.stamp_ns, matches, step.angle, sensor, keyframe
        )
        if not keyframe:
            compare()
            return None
        self._compare = compare
        result = self._pair(
            history,
            frame,
            sensor,
            parameters,
        )
        self._restart_from(frame)
        unmatched = result.pose.status is Status.TOO_FEW_MATCHES
        return None if unmatched and self._is_repeated(frame.stamp_ns) else result

    def _new_image(
        self, stamp_ns: int, image: Image, imu: FrameImu, previous: FrameImu, sensor: Sensor
    ) -> FrameImu | None:
        """IMU data of an image since the last new image; None if it repeats that image."""
        still = self._still
        masked = still.static.any()
        imu_of_new = still.imu_of_new(stamp_ns, image, imu, previous, sensor)
        if still.static.any() and not masked:
            # Measurements with the static part in view are no evidence of anything.
            self._monitor = ConsistencyMonitor()
        self._monitor.image_findings = still.findings()
        self._tracker.allow(still.allowed())
        return imu_of_new

    def _sensor_of(self, intrinsics: Intrinsics, parameters: Parameters) -> Sensor:
        """The sensor of the next frame; everything restarts with other intrinsics."""
        sensor = sensor_model(intrinsics, parameters.sensor, self.applied.readout_time)
        if self._sensor is None or intrinsics != self._sensor.intrinsics:
            self.reset()
            self._monitor = ConsistencyMonitor()
        if sensor != self._sensor:
            self._of_previous = None  # its row times belong to the camera before
        self._sensor = sensor
        self._readout = self.applied.readout_time
        return sensor

    def _is_repeated(self, stamp_ns: int) -> bool:
        """Whether a pair with too few matches follows another one: each frame creates one."""
        before_ns = self._unmatched_ns
        if before_ns is not None and seconds_between(before_ns, stamp_ns) < _UNMATCHED_PERIOD:
            return True
        self._unmatched_ns = stamp_ns
        return False

    def prepare(self) -> None:
        """Learn from a pair, assess the configuration, search new corners: it is published."""
        if self._lesson is not None:
            lesson = self._lesson
            self._lesson = None
            lesson()
        if self._compare is not None:
            compare = self._compare
            self._compare = None
            compare()
            self._monitor.assess()
            self._tracker.promote()

    @property
    def health(self) -> findings.Assessment:
        """Consistency of the configuration after all pairs so far."""
        self.prepare()
        return self._monitor.health

    @property
    def rotations(self) -> RotationSums:
        """Rotations by the images and by the gyro over the last seconds."""
        return self._monitor.rotations

    def _restart_from(self, frame: Frame[Any]) -> None:
        self._previous = frame
        self._history = TrackHistory(frame.stamp_ns, frame.imu)
        self._of_reference = None

    # -- rays and rotations --------------------------------------------------------------------

    def _predicted(
        self, previous: FrameMotion, current: FrameMotion, rotation: Array, sensor: Sensor
    ) -> Array | None:
        """Predicted pixels (N, 2) of the tracker's points in the current image, by the gyro.

        `rotation` (3, 3): ``R_1^T R_2`` since the previous image. None for a tracker without
        points.
        """
        points = self._tracker.points
        if not len(points):
            return None
        known = self._of_previous
        if known is not None and np.array_equal(known.points2, points):
            rays = known.rays[-1]
            row_times = known.row_times[-1]
        else:
            rays, row_times = sensor.derotated(points, previous)
        # f_2 = R^T f_1 for R = R_1^T R_2, in rows.
        return sensor.project(rays @ rotation, row_times, current)

    def _derotate(
        self, matches: Matches, motion1: FrameMotion, motion2: FrameMotion, sensor: Sensor
    ) -> Matches:
        """The matches of reference and current image with their rays, which are kept."""
        rays = pair.derotated(
            matches,
            motion1,
            motion2,
            sensor,
            self._of_reference,
        )
        self._of_reference = self._of_previous = rays
        return rays

    def _compare_rotations(
        self, stamp_ns: int, matches: Matches, by_gyro: Array, sensor: Sensor, keyframe: bool
    ) -> None:
        """Compare the rotation by the images over some frames with the rotation by the gyro.

        `by_gyro` (3,): angle since the previous image [rad]. A gyro in deg/s would turn by more
        than half a turn in these frames, which a rotation does not show.
        """
        before = self._rotation
        if before is not None:
            before.by_gyro = before.by_gyro + by_gyro
            before.frames = before.frames + 1
            # If tracks are lost, pairs are created early, and few tracks live longer.
            if not keyframe and before.frames < _ROTATION_FRAMES:
                return
        ids = matches.track_ids[:_ROTATION_POINTS]
        rays = sensor.camera.unproject(
            sensor.intrinsics.to_sensor(matches.points2[:_ROTATION_POINTS])
        )
        if before is not None:
            _, old, new = np.intersect1d(
                before.ids,
                ids,
                assume_unique=True,
                return_indices=True,
            )
            by_images = rotation_of_rays(before.rays[old], rays[new])
            if by_images is not None:
                self._monitor.rotations.add(
                    stamp_ns,
                    seconds_between(before.stamp_ns, stamp_ns),
                    by_images,
                    before.by_gyro,
                )
        self._rotation = _RotationStart(stamp_ns, ids, rays)

    # -- one pair ----------------------------------------------------------------------------

    def _pair(
        self, history: TrackHistory, frame: Frame[Any], sensor: Sensor, parameters: Parameters
    ) -> PairResult:
        """The pair, suppressed by the findings on the pairs before."""
        monitor = self._monitor
        matches = self._tracker.refined_matches()
        self._note_scatter(frame.imu_doubt.varying)
        problem = history.problem(
            frame.stamp_ns,
            matches,
            sensor,
            parameters,
            stamp_sigma=monitor.stamp_sigma,
        )
        monitor.acceleration.note_length(*_length_at_rest(frame.imu, parameters.imu))
        pose = self._estimated(problem, frame.stamp_ns)
        since = history.since
        assert since is not None
        configured = self._configured(
            frame.applied_offset_ns, frame.imu_doubt.common, since, sensor, parameters
        )
        stamps_ns = history.stamp_ns, frame.stamp_ns
        pose, published = self._doubted(pose, problem, since, stamps_ns, configured, parameters)
        rays = self._derotate(matches, history.imu.motion, frame.imu.motion, sensor)
        intrinsics = frame.intrinsics
        size = intrinsics.image_width, intrinsics.image_height
        view = View(*size, sensor.camera.readout_axis)
        sums_of = partial(PairSums.of, frame.stamp_ns, rays, pose, intrinsics.fx, view)
        self._lesson = Lesson(partial(self._learn, frame.stamp_ns, configured, sums_of))
        return replace(
            history.result(frame, rays, published, sensor, parameters),
            health=monitor.health,
            lesson=self._lesson,
            image2=frame.image if self._keep_images else None,
        )

    def _doubted(
        self,
        pose: RelativePose,
        problem: PairProblem,
        since: ImuSlice,
        stamps_ns: tuple[int, int],
        configured: Configured,
        parameters: Parameters,
    ) -> tuple[RelativePose, RelativePose]:
        """Show a pair to the monitor; its pose with all doubts, and the pose to publish.

        `stamps_ns`: of both frames. A pose that is withheld is published as none, with the reason.
        """
        monitor = self._monitor
        # The monitor also gets a pose that contradicts the IMU: it shows what is wrong.
        fitted = pose.diagnostics.rejected or pose
        known = fitted.rotation_known
        data = _measurement(problem, fitted, since, parameters) if known else None
        # A pair that may follow a moving object is no evidence, and has no pose.
        follows_object = False
        if data is not None and not monitor.has_other_unit:
            follows_object = monitor.second_motions.add(data, fitted)
        if follows_object:
            data = None
            if monitor.second_motions.has_come:
                monitor.restart()  # pairs before may have followed it, too
        may_be_step = monitor.clock_steps.add(stamps_ns, since, data, pose)
        if data is not None:
            is_allowed = monitor.deviates_as_allowed(configured)
            monitor.contradictions.add(pose, is_allowed=is_allowed)
        assessed = monitor.add_pair(stamps_ns[1], data, fitted, configured)
        if fitted is pose:
            pose = monitor.widened(stamps_ns, pose, assessed, parameters.imu)
        published = pose
        if parameters.pair.withhold_when_wrong:
            published = monitor.without_doubtful(
                pose,
                has_rate_doubt=problem.rate_doubt > 0.0,
                may_be_step=may_be_step,
                follows_object=follows_object,
            )
        return pose, published

    def _note_scatter(self, of_imu: float) -> None:
        """Note the scatter of the last stamps for the pair; `of_imu` [s]: that of the gyro's."""
        monitor = self._monitor
        scatter = stamp_scatter(self._stamps_ns)
        self._jitters.append(scatter.sigma if scatter.is_jitter else 0.0)
        monitor.jitter = max(self._jitters)
        monitor.stamp_sigma = math.hypot(max(scatter.sigma, monitor.jitter), of_imu)

    def _learn(
        self,
        stamp_ns: int,
        configured: Configured,
        sums_of: Callable[[Array | None], PairSums | None],
    ) -> Learned:
        """What the last pair tells of the configuration; updates the corrections.

        `sums_of` gives the sums of its residuals by the rotation of images against the gyro's.
        """
        monitor = self._monitor
        monitor.learn()
        of_images = None if monitor.latest is None else monitor.latest.images_by_deviation
        tracked = Tracked.of(monitor.calibration, configured)
        self._correct(stamp_ns, tracked, configured)
        latest = monitor.latest  # None after a step
        against_gyro = None if latest is None else latest.images_against_gyro
        sums = sums_of(against_gyro)
        monitor.residuals.add(sums)
        return Learned(of_images, against_gyro, sums, tracked, self.applied)

    def _correct(self, stamp_ns: int, tracked: Tracked, configured: Configured) -> None:
        """Move the corrections of the next frames towards the estimates, or by a step."""
        monitor = self._monitor
        steps = monitor.clock_steps
        change = monitor.change
        self.applied = self.applied.at(stamp_ns)
        if (wrong := steps.refuted()) is not None:
            self.applied = self.applied.after_step(-wrong.seconds, -(wrong.sigma**2))
            monitor.restart()
        elif (step := steps.found(BEYOND_JITTER * monitor.stamp_sigma)) is not None:
            self.applied = self.applied.after_step(step.seconds, step.sigma**2)
            sensor = _with_step(configured.sensor, step.seconds)
            monitor.follow_step(step, validate.replaced(configured, sensor=sensor))
        elif change is not None and change.entry == 'time_offset' and not steps.in_doubt:
            self.applied = self.applied.after_change(change, stamp_ns)
            monitor.follow_change(change, self.applied.drift)
        else:
            if not steps.in_doubt:
                self.applied = self.applied.moved(tracked, configured.sensor)
            return
        self._rotation = None  # the gyro since then is that of another time

    def _configured(
        self,
        applied_offset_ns: int,
        offset_sigma: float,
        since: ImuSlice,
        sensor: Sensor,
        parameters: Parameters,
    ) -> Configured:
        """The parameters of a pair, and the deviations that are applied to it.

        `offset_sigma` [s]: of the stamps of its gyro.
        """
        bias = np.array(parameters.imu.gyro_bias)
        before_ns, stamp_ns = list(self._stamps_ns)[-2:]
        from_reference = (
            seconds_between(before_ns, stamp_ns) - parameters.sensor.time_offset_reference_interval
        )
        offset_sigma = math.hypot(offset_sigma, math.sqrt(self.applied.stepped_variance))
        configured = Configured(
            _with_step(parameters.sensor, self.applied.stepped),
            sensor.camera,
            bias,
            configured_sigmas(parameters, from_reference, sensor.camera, offset_sigma),
            np.zeros(LIVE.size),
            parameters.imu.gyro_noise_density,
        )
        configured.active[LIVE.index('time_offset')] = applied_offset_ns / NANOSECONDS
        configured.active[LIVE.index('readout_time')] = configured.direction * self._readout
        configured.active[LIVE.part('gyro_bias')] = (
            parameters.sensor.R_cam_imu.T @ since.bias - bias
        )
        return configured

    def _estimated(self, problem: PairProblem, stamp_ns: int) -> RelativePose:
        """The pose, without the accelerometer if the images contradict it."""
        inertial = problem.inertial[-1]
        acceleration = self._monitor.acceleration
        acceleration.report(stamp_ns, inertial or problem.no_inertial)
        if inertial is None:
            return estimate(problem)
        used = acceleration.uses(None)
        if used:
            pose = estimate(problem)
            evidence = pose.diagnostics.inertial_evidence
        else:
            pose = estimate(problem.without_inertial(_CONTRADICTED))
            evidence = evidence_for_inertial(pose, problem)
        if evidence is not None:
            self._monitor.add_acceleration(stamp_ns, evidence)
            if used and not acceleration.uses(evidence):
                pose = estimate(problem.without_inertial(_CONTRADICTED))
        return pose


def _length_at_rest(imu: FrameImu, config: ImuConfig) -> tuple[float, float]:
    """Length of the specific force at rest [m/s^2], and 1 sigma of its difference from gravity."""
    by_scale = config.accel_scale_sigma * STANDARD_GRAVITY
    return imu.at_rest, math.hypot(by_scale, config.accel_bias_sigma, imu.at_rest_sigma)


def _with_step(sensor: SensorConfig, seconds: float) -> SensorConfig:
    """The configuration after a step of the time offset; its error is tracked from then on."""
    if not seconds:
        return sensor
    offset = sensor.time_offset + seconds
    return validate.replaced(sensor, time_offset=offset, track_time_offset=True)


def _measurement(
    problem: PairProblem, fitted: RelativePose, since: ImuSlice, parameters: Parameters
) -> PairData:
    """A pair as the consistency monitor gets it."""
    return PairData(
        problem.matches.points1,
        problem.matches.points2,
        problem.camera,
        problem.motions[0],
        problem.motions[-1],
        float(problem.seconds[-1]),
        fitted.R,
        fitted.t,
        since,
        parameters.sensor.R_cam_imu,
        problem.config.gyro_sigma,
        problem.config.stamp_sigma,
    )


# -- The loop over frames -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class FrameFailed:
    """A frame with an error in its processing: the processor restarts with the next one."""

    stamp_ns: int | None  # None if no frame had been taken yet
    error: Exception  # of the package (`RsRelposeError`), or, live, a programming error

    @property
    def reason(self) -> str:
        """Message of the error."""
        return str(self.error)


Outcome = Frame[Result] | FrameRefused | FrameFailed


class FrameLoop(Generic[Result]):
    """Takes frames from its sequencer and lets a processor work on them.

    Nodes, replay and warm-up fill `sequencer`, from any thread, and call `step`, from one.
    `parameters` may be replaced from any thread and are active from the next step on: no object
    called by `step` keeps a value that may change while running. `offline`, `colors` and `clock`
    are those of `Sequencer`. Offline, programming errors leave `step`; live they are an outcome.
    """

    def __init__(
        self,
        parameters: Parameters,
        processor: Processor[Result],
        *,
        offline: bool = False,
        colors: bool = False,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.parameters = parameters
        self.sequencer = Sequencer(
            parameters,
            offline=offline,
            colors=colors,
            clock=clock,
        )
        self._processor = processor
        self._offline = offline

    def close(self) -> None:
        """End of the input: `step` returns what is left, then None."""
        self.sequencer.close()

    def step(self, timeout: float = 0.0) -> Outcome[Result] | None:
        """The next frame with its result; None if none is ready within `timeout` seconds."""
        stamp_ns: int | None = None
        processor = self._processor
        try:
            # The result of the step before is published: no subscriber waits meanwhile.
            started = time.perf_counter()
            processor.prepare()
            prepared = time.perf_counter() - started
            # Between two frames, so that the offset of a frame depends only on those before it.
            self.sequencer.apply(processor.applied)
            self.sequencer.gyro_only = processor.gyro_only(self.parameters)
            frame = self.sequencer.take(timeout)
            if not isinstance(frame, Frame):
                return frame
            stamp_ns = frame.stamp_ns
            if frame.restart:
                processor.reset()
            started = time.perf_counter()
            frame.result = processor.process(frame, self.parameters)
            frame.seconds = prepared + time.perf_counter() - started
            return frame
        except Exception as error:
            processor.reset()
            if self._offline and not isinstance(error, RsRelposeError):
                raise
            return FrameFailed(stamp_ns, error)


class FrontEnd(FrameLoop[PairResult]):
    """The loop that makes keyframe pairs; it takes the arguments of `FrameLoop` and `Pipeline`."""

    def __init__(
        self,
        parameters: Parameters,
        *,
        offline: bool = False,
        keep_images: bool = False,
        tracker: Tracker | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._pipeline = Pipeline(parameters, keep_images, tracker)
        super().__init__(
            parameters,
            self._pipeline,
            offline=offline,
            clock=clock,
        )

    @property
    def health(self) -> findings.Assessment:
        """Consistency of the configuration after all pairs so far: each is published before."""
        return self._pipeline.health

    @property
    def rotations(self) -> RotationSums:
        """Rotations by the images and by the gyro over the last seconds."""
        return self._pipeline.rotations
