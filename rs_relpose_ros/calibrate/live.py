"""Calibration of a running camera: its tracks and gyro in memory, the fit in its own process."""

from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
import os
import pickle
from queue import Empty, Queue
import subprocess
import sys
import time
from typing import Any

from rs_relpose_ros.calibrate import stored
from rs_relpose_ros.calibrate.procedure import calibrated, warm_up_fit
from rs_relpose_ros.calibrate.recording import CalibrationInput, Recorder
from rs_relpose_ros.calibrate.result import CalibrationResult, parameter_file, quantities
from rs_relpose_ros.calibrate.stored import Calibrated, CameraId, Progress
from rs_relpose_ros.config.settings import Parameters, TRACKED_IN_IMAGES
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.messages.incoming import Role, stamp_ns
from rs_relpose_ros.messages.transforms import AXES_SIGMA
from rs_relpose_ros.pipeline.sequencer import Refusal, SequencerCounts

# Length of the recording at the first fit [s]. A shorter recording rarely determines anything, and
# a fit of it takes the core from the tracker. [chosen: any value in 5..10 would do]
_FIRST = 7.0
# Longest recording that is kept [s]; older data are dropped. A longer one costs memory and time of
# each fit, and its sigmas are no longer the limit. [chosen: any value in 40..120 would do]
_LONGEST = 60.0
# Length that is added before the next fit [s]. A larger value delays the end of the calibration, a
# smaller one repeats fits of the same data. [chosen: about the duration of a fit]
_STEP = 1.0
# Factor of the largest sigmas with which a running node accepts a value: the covariances of its
# poses contain this doubt, so poses start earlier. [chosen: any value in 1.5..3 would do]
_WIDER = 2.0
# The same factor where the doubt moves poses by less than their own sigma. [chosen: any value
# above the factor before, up to 5, would do]
_UNNOTICED = 3.0
# Length of the recording [s] from which the rotation of a transform suffices, since a vehicle with
# wheels turns about one axis only and never determines it. A smaller value would take the rotation
# of a transform from a camera that is still to be turned. [chosen: the duration of the motion that
# the user is asked for]
_WHEELS = 20.0
# Images that may wait to be tracked; more are left out. A larger value delays the fits behind the
# camera on a slow machine, a smaller one loses images while the tracker starts. [chosen: a quarter
# of a second of images]
_WAITING = 8
# Time without an image [s] after which a recording that is too short is reported. It must exceed
# the gaps of a slow transport. [chosen: any value in 1..5 would do]
_SILENCE = 2.0
# Images without a usable CameraInfo after which the lens counts as uncalibrated: the first
# CameraInfo may arrive after the first images. [chosen: half a second of images]
_WITHOUT_INFO = 15
# Consecutive unusable images after which the recording starts again because the images have
# another size, or goes on with a clock that was set back. A smaller value would restart at a burst
# of damaged images. [chosen: half a second of images]
_MOST_REFUSED = 15
# Niceness of the process of the fits: the node goes first, but a loaded machine still ends a fit.
# At 19 it would get no time there. [chosen: any value in 1..10 would do]
_NICE = 5


class LiveCalibration:
    """Takes the place of intake and frame loop until the calibration is known.

    The thread of the subscriptions calls `receive`, and the worker calls `step`. With
    `use_stored`, the file of the camera is used if there is one. `waits_for` names what another
    part will give, so that no fit is needed. `topic` is the topic of the images. `quat_prior` is
    the rotation IMU to camera of a transform, which is right within 5 deg.
    """

    # An uncalibrated CameraInfo is no problem here, because the lens is calibrated, too.
    camera_info_problem = ''

    def __init__(
        self, parameters: Parameters, *, use_stored: bool, waits_for: str = '', topic: str = ''
    ) -> None:
        self._parameters = parameters
        self._topic = topic
        self._use_stored = use_stored
        self.waits_for = waits_for
        self.quat_prior: tuple[float, ...] | None = None
        self._queue: Queue[tuple[Role, Any]] = Queue()
        # Images that `receive` put into the queue or left out, and that `step` took from it: each
        # number is written by one thread.
        self._put = self._left_out = self._taken = 0
        self._image_s = 0.0  # time of the last image on the monotonic clock
        self._short = 0.0  # length of a recording that was reported as too short [s]
        self._done = False
        self._camera: CameraId | None = None
        self._fits: _Fits | None = None
        self._restart()

    def _restart(self) -> None:
        self.close()
        self._recorder = Recorder(self._parameters.tracking, _LONGEST)
        self._images = self._refused = 0
        self._fitted_ns = 0  # stamp of the last image when the last fit began

    @property
    def intrinsics(self) -> Intrinsics | None:
        """Intrinsics of the last CameraInfo."""
        return self._recorder.intrinsics

    @property
    def warning(self) -> str:
        """What is wrong with the stamps of the gyro, which are corrected; empty for nothing."""
        return self._recorder.warning

    @property
    def fitting(self) -> bool:
        """Whether a fit runs."""
        return self._fits is not None and self._fits.recording is not None

    def waits_for_imu(self) -> bool:
        """False: a calibration does not need the samples in time."""
        return False

    def receive(self, role: Role, message: Any) -> RsRelposeError | None:
        """Hand a message over; its errors are returned by `step`."""
        configured = self._parameters.intrinsics.given
        if self._done or role is Role.ACCEL or (role is Role.CAMERA_INFO and configured):
            return None
        if role is Role.IMAGE:
            if self._put - self._taken >= _WAITING:
                self._left_out += 1
                return None
            self._put += 1
        self._queue.put((role, message))
        return None

    def counts(self) -> SequencerCounts:
        """Images that were used and left out."""
        return SequencerCounts(
            self._put + self._left_out, self._taken, Counter({Refusal.OVERLOAD: self._left_out})
        )

    def step(self, timeout: float = 0.0) -> Progress | Calibrated | RsRelposeError | None:
        """Use a message; returns the state after a fit, the error of the message, or None."""
        outcome: Progress | Calibrated | RsRelposeError | None = None
        try:
            message = self._queue.get(timeout=timeout)
            outcome = None if self._done else self._used(*message)
        except Empty:
            outcome = None if self._done else self._after_fit() or self._too_short()
        if isinstance(outcome, Calibrated):
            self._done = True
            self.close()
        return outcome

    def _used(self, role: Role, message: Any) -> Progress | Calibrated | RsRelposeError | None:
        if role is not Role.IMAGE:
            return self._recorder.add(role, message)
        self._taken += 1
        self._images += 1
        self._image_s = time.monotonic()
        error = self._recorder.add(role, message)
        self._refused = 0 if error is None else self._refused + 1
        if self._refused > _MOST_REFUSED:
            self._use_clock_of(message)
        if error is not None:
            return error
        configured = self._parameters.intrinsics
        if configured.given:
            self._recorder.intrinsics = configured.of_image(*self._recorder.size)
        self._recorder.uncalibrated |= self._images > _WITHOUT_INFO
        if self._camera is None:
            return self._first_image(message.header.frame_id)
        return self._after_fit()

    def _use_clock_of(self, message: Any) -> None:
        """Go on with a clock that was set back, as when a bag is looped, or begin again."""
        recorder = self._recorder
        self._refused = 0
        if not recorder.seconds or stamp_ns(message.header) > recorder.last_ns:
            self._restart()
            return
        before_ns = recorder.last_ns
        recorder.set_back(stamp_ns(message.header))
        self._fitted_ns += recorder.last_ns - before_ns

    def _too_short(self) -> Progress | None:
        seconds = self._recorder.seconds
        if (
            not self._short < seconds < _FIRST
            or self.waits_for
            or time.monotonic() - self._image_s < _SILENCE
        ):
            return None
        self._short = seconds
        return Progress(
            f'calibrating: the images ended after {seconds:.1f} s, too short: '
            f'at least {_FIRST:.0f} s are needed, 10 s or more are good'
        )

    def close(self) -> None:
        """End the process of the fits."""
        if self._fits is not None:
            self._fits.stop()
            self._fits = None

    def _first_image(self, frame_id: str) -> Progress | Calibrated | RsRelposeError:
        """Return the stored calibration of the camera, or the error of its file, or start."""
        config = self._parameters.calibration
        size = self._recorder.size
        if config.camera_name:
            self._camera = CameraId(config.camera_name, *size)
        else:
            self._camera = CameraId(frame_id, *size, self._topic)
        try:
            path = stored.path_of(config, self._camera)
            if self._use_stored and path.is_file():
                _, known = stored.load(path, self._camera)
                return Calibrated(
                    self._camera,
                    path.read_text(encoding='utf-8'),
                    f'using the calibration of {known} in {path}',
                    new=False,
                )
        except RsRelposeError as error:
            return error
        if self.waits_for:
            return Progress(f'waiting for {self.waits_for}')
        self._fits = _Fits()
        return Progress(
            'calibrating: rotate the camera about all three axes, 20 to 60 deg/s, for some 20 s'
        )

    def _after_fit(self) -> Progress | Calibrated | None:
        fits = self._fits
        if fits is not None and fits.recording is not None:
            if not fits.found.done():
                return None
            recording = fits.recording
            fits.recording = None
            return self._evaluated(fits.found.result(), recording)
        recorder = self._recorder
        grown = 1e-9 * (recorder.last_ns - self._fitted_ns) if self._fitted_ns else _STEP
        if self.waits_for or recorder.seconds < _FIRST or grown < _STEP:
            return None
        self._fitted_ns = recorder.last_ns
        sensor = self._parameters.sensor
        config = replace(
            TRACKED_IN_IMAGES,
            offset_at_end=True,
            exposure_time=sensor.exposure_time,
            exposure_margin=sensor.exposure_margin,
            tolerance=_WIDER,
            unnoticed_tolerance=_UNNOTICED,
        )
        if recorder.seconds >= _WHEELS and self.quat_prior is not None:
            config = replace(config, max_rotation_sigma=1.1 * AXES_SIGMA / _WIDER)
        if fits is None or fits.process.poll() is not None:
            self.close()
            self._fits = fits = _Fits()
        try:
            fits.begin(recorder.recording(), config, self.quat_prior)
        except RsRelposeError as error:
            return Progress(f'calibrating: {error}')
        return None

    def _evaluated(
        self, result: CalibrationResult | RsRelposeError, recording: CalibrationInput
    ) -> Progress | Calibrated:
        seconds = 1e-9 * (recording.tracks.stamps_ns[-1] - recording.tracks.stamps_ns[0])
        if isinstance(result, RsRelposeError):
            return Progress(f'calibrating, {seconds:.0f} s: {result}')
        rows = quantities(result, recording.camera)
        known = '; '.join(f'{name} {text}' for name, text, of in rows if of in result.needed)
        if result.observable:
            assert self._camera is not None
            return Calibrated(
                self._camera,
                parameter_file(
                    result,
                    f'Calibration of {self._camera.name} by {seconds:.0f} s while running.',
                    camera=recording.camera,
                ),
                f'calibrated: {known}',
            )
        missing = [of.remark for of in result.needed if not of.observable]
        return Progress(
            f'calibrating, {seconds:.0f} s: {known}. Needed: {"; ".join(dict.fromkeys(missing))}',
            1.0 - len(missing) / len(result.needed),
            {name: text if of.observable else f'{text}; {of.remark}' for name, text, of in rows},
        )


class _Fits:
    """A process that fits one recording after the other, without the interpreter's lock.

    It is not started by multiprocessing, which unblocks the signals of the calling thread. It
    imports and loads its kernels while the first images are recorded, and it inherits the blocked
    signals, so that an interrupt at the terminal reaches the node alone.
    """

    def __init__(self) -> None:
        self.recording: CalibrationInput | None = None  # while its fit runs
        self.found: Future[CalibrationResult | RsRelposeError] = Future()
        self.process = subprocess.Popen(
            [sys.executable, '-m', __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._thread = ThreadPoolExecutor(1)

    def begin(self, recording: CalibrationInput, *others: Any) -> None:
        """Fit a recording; `others` are the configuration and the rotation of a transform."""
        self.recording = recording
        self.found = self._thread.submit(self._answer, (recording, *others))

    def _answer(self, arguments: tuple[Any, ...]) -> CalibrationResult | RsRelposeError:
        requests = self.process.stdin
        answers = self.process.stdout
        assert requests is not None and answers is not None
        try:
            pickle.dump(arguments, requests, protocol=5)  # protocol 5 does not copy the arrays
            requests.flush()
            found: CalibrationResult | RsRelposeError = pickle.load(answers)  # noqa: S301
        except (OSError, EOFError, pickle.UnpicklingError):
            self.process.kill()
            found = RsRelposeError('the process of the fit ended early: out of memory?')
        return found

    def stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        self._thread.shutdown()
        for pipe in (self.process.stdin, self.process.stdout):
            with suppress(OSError):  # the rest of a request cannot be written any more
                pipe.close()  # type: ignore[union-attr]


def _serve() -> None:
    """Fit the pickled recordings of stdin, and write the results, or their errors, to stdout."""
    os.nice(_NICE)
    warm_up_fit()
    while True:
        try:
            recording, config, quat_prior = pickle.load(sys.stdin.buffer)  # noqa: S301 of the node
        except EOFError:  # the node has ended
            return
        result: CalibrationResult | RsRelposeError
        try:
            result = calibrated(recording, config, quat_prior=quat_prior)
        except RsRelposeError as error:
            result = error
        pickle.dump(result, sys.stdout.buffer)
        sys.stdout.buffer.flush()


if __name__ == '__main__':
    _serve()
