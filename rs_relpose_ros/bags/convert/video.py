"""Videos: their frames, and the telemetry of cameras that log their IMU in the file.

Formats: docs/recordings.md. Lens profiles are those of Gyroflow.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.bags.convert import recording
from rs_relpose_ros.bags.convert.recording import readout_values, RecordedImage, Recording
from rs_relpose_ros.bags.convert.text_files import check_file, read_object
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, library, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.so3 import Vector
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample

# The first frame is stamped with this time [ns], because the file has no clock. [chosen: samples
# can precede the first frame by seconds; any value from 100 s to years would do]
START_NS = 1000 * NANOSECONDS
# Quality of the JPEG images of the bag. [chosen: from 85 on, the noise of matches does not depend
# on it (docs/lab); up to 95 only the bag becomes larger]
_JPEG_QUALITY = 90

# What is said without a package.
_ABSENT = (
    'videos need the Python package {}, which is not installed: pip install av telemetry-parser'
)


def read_video(path: Path, lens_profile: Path | None) -> Recording:
    """Read a video with its telemetry; frames are decoded when the bag is written.

    `lens_profile`: a profile of Gyroflow, or a folder of them with one of this camera's mode. It
    gives the calibration, and the readout time if the file does not have it.
    """
    telemetry = read_telemetry(path, START_NS)
    video = Video(path)
    times_ns = video.times_ns()
    duration_ns = max(times_ns[-1] - times_ns[0], 1)
    rate = (len(video) - 1) * NANOSECONDS / duration_ns
    mode = VideoMode(telemetry.brand, telemetry.model, video.width, video.height, rate)
    camera = None
    readout = telemetry.readout
    if lens_profile is not None:
        camera, profile_readout = find_lens_profile(lens_profile, mode)
        readout = readout or profile_readout
    return Recording(
        camera,
        video.frames([START_NS + time_ns for time_ns in times_ns], path),
        telemetry.gyro,
        f'Parameters of relpose_node for {path.name} (`rs_relpose convert video`): {mode}. '
        '`rs_relpose calibrate` estimates those that are missing.',
        (recording.COMPRESSED, *readout, *_CONVENTIONS),
        accel=telemetry.accel,
    )


# Parameters that a video does not determine.
_CONVENTIONS = (
    SourcedValue('stamp_row', 'first', 'Convention of time_offset here.'),
    SourcedValue(
        'time_offset',
        0.0,
        'NOT KNOWN: the file does not report the start of its IMU against its frames; tens of '
        'milliseconds are usual. `rs_relpose calibrate` measures it.',
    ),
    SourcedValue(
        'quat_cam_imu_xyzw',
        (0.0, 0.0, 0.0, 1.0),
        "The IMU data are converted to the camera's axes.",
    ),
)


class Video:
    """The first video stream of a file, as encoded: a rotation for display is not applied.

    `turns`: quarter turns (counterclockwise) that are applied to each frame.
    """

    turns = 0

    def __init__(self, path: Path) -> None:
        self.path = check_file(path)
        self._av = library('av', _ABSENT.format('av'))
        with self._decoding(), self._av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f'{path} has no video stream')
            stream = container.streams.video[0]
            self.width = int(stream.width)
            self.height = int(stream.height)
            self._time_base = stream.time_base
            self.display_rotation = self._display_rotation(container)
            # Frames that an edit list cuts off are decoded, but not displayed.
            self._pts = sorted(
                packet.pts
                for packet in container.demux(stream)
                if packet.size and packet.pts is not None and not packet.is_discard
            )
        if not self._pts:
            raise MissingInputError(f'{path} has no frames')
        self._decoded: Iterator[Any] = iter(())
        self._next = len(self._pts)  # number of the frame that the decoder gives next

    @staticmethod
    def _display_rotation(container: Any) -> int:
        """Return the angle [deg] by which players rotate the frames clockwise."""
        frame = next(container.decode(video=0), None)
        degrees = 0 if frame is None else round(getattr(frame, 'rotation', 0))
        container.seek(0)
        return -degrees % 360

    def turn(self, turns: int) -> None:
        """Turn all frames by an odd number of quarter turns, counterclockwise."""
        self.turns = turns
        self.width, self.height = self.height, self.width

    def __len__(self) -> int:
        return len(self._pts)

    def times_ns(self) -> list[int]:
        """Return the time [ns] of each frame from the start of the file, rounded."""
        return [round(pts * self._time_base * NANOSECONDS) for pts in self._pts]

    def frames(self, stamps_ns: Sequence[int], source: Path) -> tuple[RecordedImage, ...]:
        """Return all frames with these stamps [ns]; `source` is the file of the stamps."""
        if len(stamps_ns) != len(self):
            raise InputError(
                f'{source} has {len(stamps_ns)} stamps, but {self.path} has '
                f'{len(self)} frames: they cannot be assigned to each other'
            )
        return tuple(self.frame(number, stamp_ns) for number, stamp_ns in enumerate(stamps_ns))

    def frame(self, number: int, stamp_ns: int) -> RecordedImage:
        """Return frame `number`, from 0, with this stamp [ns]."""
        name = f'frame {number + 1} of {self.path}'
        return RecordedImage(stamp_ns, name, partial(self.jpeg, number))

    def jpeg(self, number: int) -> bytes:
        """Return frame `number`, from 0, as a JPEG image; fastest in the order of frames."""
        with self._decoding():
            if number < self._next:
                self._decoded = self._av.open(str(self.path)).decode(video=0)
                self._next = 0
            for frame in self._decoded:
                if frame.pts is None or frame.pts < self._pts[number]:
                    continue
                if frame.pts > self._pts[number]:
                    break
                self._next = number + 1
                pixels = np.rot90(frame.to_ndarray(format='bgr24'), self.turns)
                quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
                return bytes(cv2.imencode('.jpg', np.ascontiguousarray(pixels), quality)[1])
        raise InputError(
            f'{self.path}: frame {number + 1} of {len(self)} cannot be decoded: the '
            'file is damaged'
        )

    @contextmanager
    def _decoding(self) -> Iterator[None]:
        try:
            yield
        except self._av.error.FFmpegError as error:
            raise InputError(
                f'{self.path} is no video that can be read: {error.strerror}'
            ) from error


# -- Telemetry: IMU, readout time, stabilisation --------------------------------------------------
#
# github.com/AdrianEddy/telemetry-parser reads GoPro, Sony, Insta360, Canon, Gyroflow's .gcsv next
# to a video, and others. It converts the IMU of each to the same axes: x up along the columns of
# the image, y to the left, z backwards; the axes of the camera are (-y, -x, -z) of these. This was
# checked with GoPro's HERO5: rotation of its images, and its specific force while it accelerates.

# v_camera = R v_telemetry.
_R_CAM_TELEMETRY = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

# Group, tag and, in a tag of several values, the name of a readout time [ms], and its source.
_READOUTS = (
    ('Default', '0x53524f54', '', "GoPro's SROT"),
    ('Imager', 'FrameReadoutTime', '', 'FrameReadoutTime of the camera'),
    ('Lens', 'Data', 'frame_readout_time', "the camera's own lens profile"),
    ('Default', 'Metadata', 'rolling_shutter_time', "Insta360's rolling_shutter_time"),
    ('Default', 'Metadata', 'frame_readout_time', 'the .gcsv file next to the video'),
)
# A .gcsv has the direction separately; of its four values these are rows upwards, and columns.
_UPWARDS = ('1', '180', 'BottomToTop')
_RIGHTWARDS = ('2', '270', 'LeftToRight')  # columns, the left one first
_LEFTWARDS = ('3', '90', 'RightToLeft')  # columns, the right one first

# Group and tag of stabilisation, its values without it, its name, and the switch of the camera.
_STABILISATION = (
    ('Default', '0x45495345', ('N',), "GoPro's EISE", 'HyperSmooth and horizon levelling'),
    (
        'Default',
        '0x45495341',
        ('N', 'N/A'),
        "GoPro's EISA",
        'video stabilisation (HyperSmooth) and horizon levelling',
    ),
)


class Telemetry(NamedTuple):
    """Telemetry of a video; samples in the camera's axes."""

    brand: str
    model: str
    gyro: list[ImuSample]  # with the accelerometer if it has the same rate
    accel: list[ImuSample]  # else separately
    readout: list[SourcedValue]  # its parameters, none if it is unknown


def read_telemetry(path: Path, start_ns: int) -> Telemetry:
    """Read the telemetry of a video whose first frame is stamped `start_ns`.

    InputError if the camera stabilised the images.
    """
    parser, tags, samples = _parsed(path)
    _refuse_stabilised(path, tags)
    with_gyro = [sample for sample in samples if sample['gyro'] is not None]
    brand = parser.camera or 'unknown camera'
    model = parser.model or 'of unknown model'
    if not with_gyro:
        raise MissingInputError(
            f'{path} ({brand} {model}) has no gyro that telemetry-parser reads'
        )
    times_ns = []
    for sample in with_gyro:
        seconds = float(sample['timestamp_ms']) * 1e-3
        times_ns.append(start_ns + to_nanoseconds(seconds))
    rates = _in_camera(np.radians([sample['gyro'] for sample in with_gyro]))
    forces = [sample['accl'] for sample in with_gyro if sample['accl'] is not None]
    in_camera = _in_camera(forces) if forces else []
    readout = _readout(tags)
    if len(in_camera) == len(times_ns):
        gyro = list(map(ImuSample, times_ns, rates, in_camera))
        return Telemetry(brand, model, gyro, [], readout)
    gyro = [ImuSample(time_ns, rate, None) for time_ns, rate in zip(times_ns, rates, strict=True)]
    return Telemetry(brand, model, gyro, _accelerometer(times_ns, in_camera), readout)


def _refuse_stabilised(path: Path, tags: Sequence[Mapping[str, Any]]) -> None:
    for group, tag, off, name, switch in _STABILISATION:
        for value in _values(tags, group, tag):
            if str(value).strip() not in off:
                raise InputError(
                    f'{path} is stabilised in the camera ({name} is {value}): each image was '
                    f'warped, so its rows have no single time; switch {switch} off before '
                    'recording'
                )


def _accelerometer(gyro_ns: Sequence[int], forces: Sequence[Vector]) -> list[ImuSample]:
    """Spread samples of an accelerometer uniformly over the time of the gyro.

    telemetry-parser lists the sensors of a payload in parallel, whatever their rates are.
    """
    if not forces:
        return []
    step = (gyro_ns[-1] - gyro_ns[0]) / max(len(gyro_ns) - 1, 1)
    step *= len(gyro_ns) / len(forces)
    return [
        ImuSample(gyro_ns[0] + round(number * step), None, force)
        for number, force in enumerate(forces)
    ]


def _parsed(path: Path) -> tuple[Any, list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """Return the parser, tags by group of each payload, and IMU samples [ms, deg/s, m/s^2]."""
    telemetry = library('telemetry_parser', _ABSENT.format('telemetry-parser'))
    try:
        parser = telemetry.Parser(str(check_file(path)))
        return parser, parser.telemetry(), parser.normalized_imu()
    except (OSError, ValueError) as error:
        raise MissingInputError(
            f'{path} has no telemetry that telemetry-parser reads ({error}): it needs the file as '
            "the camera wrote it, or Gyroflow's .gcsv next to it; of a phone, convert the folder "
            'of its logger with "rs_relpose convert phone"'
        ) from error
    except BaseException as error:
        # A panic of the library, which is written in Rust, is no Exception.
        if type(error).__name__ != 'PanicException':
            raise
        raise InputError(f'{path}: telemetry-parser cannot read it: {error}') from error


def _readout(tags: Sequence[Mapping[str, Any]]) -> list[SourcedValue]:
    """Return the parameters of the first readout time that the file has."""
    for group, tag, name, source in _READOUTS:
        for value in _values(tags, group, tag):
            fields = value if isinstance(value, Mapping) else {'': value}
            try:
                milliseconds = float(fields.get(name, 0.0))
            except (TypeError, ValueError):
                continue
            direction = str(fields.get('frame_readout_direction', ''))
            if direction in (*_UPWARDS, *_LEFTWARDS):
                milliseconds = -milliseconds
            axis = 0 if direction in (*_RIGHTWARDS, *_LEFTWARDS) else 1
            described = f'Reported by the file: {source}.'
            readout = readout_values(milliseconds, source, described, axis)
            if readout:
                return readout
    return []


def _values(tags: Sequence[Mapping[str, Any]], group: str, tag: str) -> list[Any]:
    return [payload[group][tag] for payload in tags if tag in payload.get(group, {})]


def _in_camera(vectors: ArrayLike) -> list[Vector]:
    # + 0.0: no negative zeros.
    rotated = np.asarray(vectors, dtype=np.float64) @ _R_CAM_TELEMETRY.T + 0.0
    return [(x, y, z) for x, y, z in rotated.tolist()]


# -- Lens profiles of Gyroflow: readout time and calibration of a camera's mode -------------------
#
# github.com/gyroflow/lens_profiles (CC0-1.0) has about 2500, JSON files. `calib_dimension`: size
# that the calibration belongs to [px]; `orig_dimension`: of the video, the same if absent;
# `frame_readout_time` [ms]: negative upwards, >= 10000 by columns.

# A profile is of the video's mode if its frame rate differs by less than this share.
# [chosen: 29.97 and 30 Hz are one mode, 25 and 30 Hz two; any value from 0.002 to 0.1 would do]
_RATE_TOLERANCE = 0.01
# The calibration can be scaled to the video if both scales differ by less than this share.
# [chosen: sizes are rounded to whole pixels; 4:3 and 16:9 differ by 0.33]
_ASPECT_TOLERANCE = 0.01
# An error lists at most so many profiles, so that it stays one line. [chosen: 3 to 10 would do]
_LISTED = 5


class VideoMode(NamedTuple):
    """Maker, model, size [px] and mean rate [Hz] of a video."""

    brand: str
    model: str
    width: int
    height: int
    rate: float

    def __str__(self) -> str:
        return f'{self.brand} {self.model}, {self.width}x{self.height} at {self.rate:.2f} Hz'

    def has(self, profile: dict[str, Any]) -> bool:
        """Tell whether a profile is of this mode."""
        for name, own in (('camera_brand', self.brand), ('camera_model', self.model)):
            if _plain(profile.get(name)) != _plain(own):
                return False
        size = {'w': self.width, 'h': self.height}
        if size not in (profile.get('orig_dimension'), profile.get('calib_dimension')):
            return False
        rate = profile.get('fps')
        return isinstance(rate, int | float) and abs(rate / self.rate - 1.0) < _RATE_TOLERANCE


def _plain(name: object) -> str:
    """Return a name without characters that makers write differently."""
    return ''.join(filter(str.isalnum, str(name).casefold()))


def find_lens_profile(
    path: Path, mode: VideoMode
) -> tuple[RollingShutterCamera, list[SourcedValue]]:
    """Return calibration (its readout time 0 if unknown) and readout time of a camera mode.

    `path` is a profile, or a folder with exactly one profile of the mode.
    """
    file = _only_profile(path, mode) if path.is_dir() else path
    profile = read_object(file)
    if profile.get('distortion_model') not in (None, '', 'opencv_fisheye'):
        raise InputError(
            f'{file}: the distortion model {profile["distortion_model"]!r} is not '
            "supported: it must be OpenCV's fisheye"
        )
    for name in ('input_horizontal_stretch', 'input_vertical_stretch'):
        if profile.get(name) not in (None, 1, 1.0, 0, 0.0):
            raise InputError(
                f'{file}: {name} must be 1, got {profile[name]}: the images are stretched'
            )
    milliseconds = profile.get('frame_readout_time')
    if not isinstance(milliseconds, int | float):
        milliseconds = 0.0
    source = f'lens profile {file.name}'
    readout = readout_values(
        milliseconds,
        source,
        f'A GUESS, not reported by the file: {source}. `rs_relpose calibrate` measures it.',
    )
    readout_time = round(abs(milliseconds) * 1e-3, 9) if readout else 0.0
    return _calibration(file, profile, mode, readout_time), readout


def _only_profile(folder: Path, mode: VideoMode) -> Path:
    """Find the profile of a mode in a folder."""
    fitting = [file for file in sorted(folder.rglob('*.json')) if mode.has(read_object(file))]
    if not fitting:
        raise MissingInputError(
            f'{folder} has no lens profile of {mode}: give the file of a similar one, or calibrate'
        )
    if len(fitting) > 1:
        names = ', '.join(str(file.relative_to(folder)) for file in fitting[:_LISTED])
        raise InputError(
            f'{folder} has {len(fitting)} lens profiles of {mode}, give the file '
            f'of one of them: {names}{", ..." if len(fitting) > _LISTED else ""}'
        )
    return fitting[0]


def _calibration(
    path: Path, profile: Mapping[str, Any], mode: VideoMode, readout_time: float
) -> RollingShutterCamera:
    """Scale the calibration of a profile to the size of the video."""
    try:
        size = profile['calib_dimension']
        lens = profile['fisheye_params']
        scale_x = mode.width / size['w']
        scale_y = mode.height / size['h']
        (fx, _, cx), (_, fy, cy), _ = lens['camera_matrix']
        # Pixel centres have integer coordinates.
        camera = RollingShutterCamera(
            width=mode.width,
            height=mode.height,
            fx=scale_x * fx,
            fy=scale_y * fy,
            cx=scale_x * (cx + 0.5) - 0.5,
            cy=scale_y * (cy + 0.5) - 0.5,
            distortion_model='equidistant',
            distortion=tuple(lens['distortion_coeffs']),
            readout_time=readout_time,
        )
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise InputError(
            f'{path} is no lens profile: it needs calib_dimension (w, h) and fisheye_params '
            f'(camera_matrix, distortion_coeffs): {error}'
        ) from error
    if abs(scale_x / scale_y - 1.0) > _ASPECT_TOLERANCE:
        raise InputError(
            f'{path} is for images of {size["w"]}x{size["h"]}, another aspect ratio '
            f'than that of the video, {mode.width}x{mode.height}'
        )
    return camera
