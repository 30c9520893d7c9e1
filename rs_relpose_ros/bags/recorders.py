"""Recordings of cameras and phones: videos with telemetry, and folders of Android loggers.

Formats: docs/recordings.md.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
import logging
import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags import convert
from rs_relpose_ros.bags.convert import read_object, read_table, Recording, Row
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, library, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample, Vector
from rs_relpose_ros.messages.incoming import TruePose

_logger = logging.getLogger(__name__)

# Stamp of the first frame: the file has no clock, and samples can precede it.
START_NS = 1000 * NANOSECONDS

_JPEG_QUALITY = 90
_ABSENT = (
    'videos need the Python package {}, which is not installed: pip install av telemetry-parser'
)


def read_video(path: Path, lens_profile: Path | None) -> Recording:
    """A video with its telemetry; frames are decoded when the bag is written.

    `lens_profile`: a profile of Gyroflow, or a folder of them with one of this camera's mode; it
    gives the calibration, and the readout time if the file does not have it.
    """
    telemetry = read_telemetry(path, START_NS)
    video = Video(path)
    times_ns = video.times_ns()
    duration_ns = max(times_ns[-1] - times_ns[0], 1)
    mode = VideoMode(
        telemetry.brand,
        telemetry.model,
        video.width,
        video.height,
        (len(video) - 1) * NANOSECONDS / duration_ns,
    )
    camera, readout = None, telemetry.readout
    if lens_profile is not None:
        camera, profile_readout = find_lens_profile(lens_profile, mode)
        readout = readout or profile_readout
    parameters = [
        convert.COMPRESSED,
        *readout,
        SourcedValue('stamp_row', 'first', 'Convention of time_offset here.'),
        SourcedValue(
            'time_offset',
            0.0,
            'NOT KNOWN: the file does not report the start of its '
            'IMU against its frames; tens of milliseconds are usual. `rs_relpose '
            'calibrate` measures it.',
        ),
        SourcedValue(
            'quat_cam_imu_xyzw',
            (0.0, 0.0, 0.0, 1.0),
            "The IMU data are converted to the camera's axes.",
        ),
    ]
    return Recording(
        camera,
        video.frames([START_NS + time_ns for time_ns in times_ns], path),
        telemetry.gyro,
        f'Parameters of relpose_node for {path.name} (`rs_relpose convert video`): {mode}. '
        '`rs_relpose calibrate` estimates those that are missing.',
        tuple(parameters),
        accel=telemetry.accel,
    )


class Video:
    """The first video stream of a file, as encoded: a rotation for display is not applied."""

    def __init__(self, path: Path) -> None:
        self.path = convert.check_file(path)
        self._av = library('av', _ABSENT.format('av'))
        with self._decoding(), self._av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f'{path} has no video stream')
            stream = container.streams.video[0]
            self.width, self.height = int(stream.width), int(stream.height)
            self._time_base = stream.time_base
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

    def __len__(self) -> int:
        return len(self._pts)

    def times_ns(self) -> list[int]:
        """Time [ns] of each frame from the start of the file, rounded from the exact one."""
        return [round(pts * self._time_base * NANOSECONDS) for pts in self._pts]

    def frames(self, stamps_ns: Sequence[int], source: Path) -> tuple[convert.RecordedImage, ...]:
        """All frames, with the stamp [ns] of each; `source`: the file of the stamps."""
        if len(stamps_ns) != len(self):
            raise InputError(
                f'{source} has {len(stamps_ns)} stamps, but {self.path} has '
                f'{len(self)} frames: they cannot be assigned to each other'
            )
        return tuple(
            convert.RecordedImage(
                stamp_ns, f'frame {number + 1} of {self.path}', partial(self.jpeg, number)
            )
            for number, stamp_ns in enumerate(stamps_ns)
        )

    def jpeg(self, number: int) -> bytes:
        """Frame `number`, from 0, as a JPEG image in colour; fastest in the order of frames."""
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
                pixels = frame.to_ndarray(format='bgr24')
                quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
                return bytes(cv2.imencode('.jpg', pixels, quality)[1])
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


# telemetry-parser and lens profiles add this to the milliseconds of columns.
_BY_COLUMNS_MS = 10_000.0


def readout_values(milliseconds: float, name: str, source: str) -> list[SourcedValue]:
    """Parameters of a readout time [ms], negative if read upwards; none for 0: unknown.

    InputError, with `name`, for a sensor read by columns. `source`: of the value, in words.
    """
    if abs(milliseconds) >= _BY_COLUMNS_MS:
        raise InputError(
            f'{name}: the sensor is read column by column, which the model of row '
            'times does not cover'
        )
    if not 0.0 < abs(milliseconds) < 1000.0:
        return []
    return [
        SourcedValue('readout_time', round(abs(milliseconds) * 1e-3, 9), source),
        SourcedValue(
            'readout_direction', 'down' if milliseconds > 0.0 else 'up', 'As the readout time.'
        ),
    ]


# -- Telemetry: IMU, readout time, stabilisation --------------------------------------------------
#
# github.com/AdrianEddy/telemetry-parser reads GoPro, Sony, Insta360, Canon, Gyroflow's .gcsv next
# to a video, and others. It converts the IMU of each to the same axes: x up along the columns of
# the image, y to the left, z backwards; the camera's are (-y, -x, -z). Checked with GoPro's HERO5:
# rotation of its images, and its specific force while it accelerates.

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
_COLUMNS = ('2', '270', 'LeftToRight', '3', '90', 'RightToLeft')

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


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Telemetry of a video; samples in the camera's axes."""

    brand: str
    model: str
    gyro: list[ImuSample]  # with the accelerometer if it has the same rate
    accel: list[ImuSample]  # else separately
    readout: list[SourcedValue]  # its parameters, none if it is unknown


def read_telemetry(path: Path, start_ns: int) -> Telemetry:
    """Telemetry of a video whose first frame is stamped `start_ns`; no stabilised images."""
    parser, tags, samples = _parsed(path)
    for group, tag, off, name, switch in _STABILISATION:
        for value in _values(tags, group, tag):
            if str(value).strip() not in off:
                raise InputError(
                    f'{path} is stabilised in the camera ({name} is {value}): each image was '
                    f'warped, so its rows have no single time; switch {switch} off before '
                    'recording'
                )
    with_gyro = [sample for sample in samples if sample['gyro'] is not None]
    brand, model = parser.camera or 'unknown camera', parser.model or 'of unknown model'
    if not with_gyro:
        raise MissingInputError(
            f'{path} ({brand} {model}) has no gyro that telemetry-parser reads'
        )
    times = [
        start_ns + to_nanoseconds(float(sample['timestamp_ms']) * 1e-3) for sample in with_gyro
    ]
    rates = _in_camera(np.radians([sample['gyro'] for sample in with_gyro]))
    found = [sample['accl'] for sample in with_gyro if sample['accl'] is not None]
    forces: Sequence[Vector | None] = _in_camera(found) if found else []
    accel: list[ImuSample] = []
    if len(forces) < len(times):
        # With its own rate, uniformly over the time of the gyro: telemetry-parser lists the
        # sensors of a payload in parallel, independently of their rates.
        step = (times[-1] - times[0]) / max(len(times) - 1, 1) * len(times) / max(len(forces), 1)
        accel = [
            ImuSample(times[0] + round(number * step), None, force)
            for number, force in enumerate(forces)
        ]
        forces = [None] * len(times)
    gyro = list(map(ImuSample, times, rates, forces))
    return Telemetry(brand, model, gyro, accel, _readout(tags))


def _parsed(path: Path) -> tuple[Any, list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """The parser, tags by group of each payload, and IMU samples [ms, deg/s, m/s^2]."""
    telemetry = library('telemetry_parser', _ABSENT.format('telemetry-parser'))
    try:
        parser = telemetry.Parser(str(convert.check_file(path)))
        return parser, parser.telemetry(), parser.normalized_imu()
    except (OSError, ValueError) as error:
        raise MissingInputError(
            f'{path} has no telemetry that telemetry-parser reads ({error}): it needs the file as '
            "the camera wrote it, or Gyroflow's .gcsv next to it"
        ) from error
    except BaseException as error:
        # A panic of the library, which is written in Rust, is no Exception.
        if type(error).__name__ != 'PanicException':
            raise
        raise InputError(f'{path}: telemetry-parser cannot read it: {error}') from error


def _readout(tags: Sequence[Mapping[str, Any]]) -> list[SourcedValue]:
    for group, tag, name, source in _READOUTS:
        for value in _values(tags, group, tag):
            fields = value if isinstance(value, Mapping) else {'': value}
            direction = str(fields.get('frame_readout_direction', ''))
            try:
                milliseconds = float(fields.get(name, 0.0))
            except (TypeError, ValueError):
                continue
            if direction in _COLUMNS:
                milliseconds = math.inf
            if readout := readout_values(
                -milliseconds if direction in _UPWARDS else milliseconds,
                source,
                f'Reported by the file: {source}.',
            ):
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

_RATE_TOLERANCE = 0.01
_ASPECT_TOLERANCE = 0.01
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
        """Whether a profile is of this mode."""
        rate, size = profile.get('fps'), {'w': self.width, 'h': self.height}
        return (
            all(
                _plain(profile.get(f'camera_{name}')) == _plain(getattr(self, name))
                for name in ('brand', 'model')
            )
            and size in (profile.get('orig_dimension'), profile.get('calib_dimension'))
            and isinstance(rate, int | float)
            and abs(rate / self.rate - 1.0) < _RATE_TOLERANCE
        )


def _plain(name: object) -> str:
    """A name without characters that makers write differently."""
    return ''.join(filter(str.isalnum, str(name).casefold()))


def find_lens_profile(
    path: Path, mode: VideoMode
) -> tuple[RollingShutterCamera, list[SourcedValue]]:
    """Calibration (its readout time 0 if unknown) and readout time of a camera mode.

    `path` is a profile, or a folder with exactly one profile of the mode.
    """
    if path.is_dir():
        fitting = [file for file in sorted(path.rglob('*.json')) if mode.has(read_object(file))]
        if not fitting:
            raise MissingInputError(
                f'{path} has no lens profile of {mode}: give the file of a '
                'similar one, or calibrate'
            )
        if len(fitting) > 1:
            names = ', '.join(str(file.relative_to(path)) for file in fitting[:_LISTED])
            raise InputError(
                f'{path} has {len(fitting)} lens profiles of {mode}, give the file '
                f'of one of them: {names}{", ..." if len(fitting) > _LISTED else ""}'
            )
        [path] = fitting
    profile = read_object(path)
    if profile.get('distortion_model') not in (None, '', 'opencv_fisheye'):
        raise InputError(
            f'{path}: the distortion model {profile["distortion_model"]!r} is not '
            "supported: it must be OpenCV's fisheye"
        )
    for name in ('input_horizontal_stretch', 'input_vertical_stretch'):
        if profile.get(name) not in (None, 1, 1.0, 0, 0.0):
            raise InputError(
                f'{path}: {name} must be 1, got {profile[name]}: the images are stretched'
            )
    milliseconds, source = profile.get('frame_readout_time'), f'lens profile {path.name}'
    if not isinstance(milliseconds, int | float):
        milliseconds = 0.0
    readout = readout_values(
        milliseconds,
        source,
        f'A GUESS, not reported by the file: {source}. `rs_relpose calibrate` measures it.',
    )
    try:
        size, lens = profile['calib_dimension'], profile['fisheye_params']
        scale_x, scale_y = mode.width / size['w'], mode.height / size['h']
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
            readout_time=round(abs(milliseconds) * 1e-3, 9) if readout else 0.0,
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
    return camera, readout


# -- Folders of Android loggers, each recognised by its files (`LOGGERS`) -------------------------

_MILLISECOND = 1e-6  # ns in ms

_STAMP_ROW = SourcedValue(
    'stamp_row', 'first', "Android's SENSOR_TIMESTAMP is that of the first row."
)
_TIME_OFFSET = SourcedValue(
    'time_offset',
    0.0,
    'NOT KNOWN: as the logger stamps. On some phones camera and IMU differ by '
    'tens of milliseconds; `rs_relpose calibrate` measures it.',
)


def read_android(folder: Path) -> Recording:
    """A recording of any of `LOGGERS`; MissingInputError if it is of none of them."""
    for files, read in LOGGERS.values():
        if all((folder / name).exists() for name in files):
            return read(folder)
    raise MissingInputError(f'{folder} is of no known logger, by its files: {known_loggers()}')


def _recording(
    folder: Path,
    details: str,
    images: Sequence[convert.RecordedImage],
    imu: Sequence[ImuSample],
    accel: Sequence[ImuSample] = (),
    values: Sequence[SourcedValue] = (),
    time_offset: SourcedValue = _TIME_OFFSET,
    orientation: object = None,
    truth: tuple[TruePose, ...] = (),
) -> Recording:
    """A recording of a phone, which is not calibrated; its parameters, with own `values`."""
    title = (
        f'Parameters of relpose_node for {folder.name} (`rs_relpose convert android`){details}.'
    )
    return Recording(
        None,
        images,
        imu,
        title,
        (convert.COMPRESSED, *values, _STAMP_ROW, time_offset, _axes(orientation)),
        accel,
        truth,
    )


def _axes(sensor_orientation: object = None) -> SourcedValue:
    """Rotation from the phone's sensor axes to a back camera, from its SENSOR_ORIENTATION [deg].

    The angle by which the image is rotated clockwise to be upright as the phone is held.
    """
    angle = 90
    source = 'ASSUMED: back camera with SENSOR_ORIENTATION {} deg, as most phones have it.'
    if type(sensor_orientation) is int and abs(sensor_orientation) <= 360:
        angle, source = sensor_orientation, "The camera's SENSOR_ORIENTATION, {} deg, as logged."
    half = math.radians(angle) / 2.0
    quaternion = (round(math.cos(half), 8), round(-math.sin(half), 8), 0.0, 0.0)
    return SourcedValue('quat_cam_imu_xyzw', quaternion, source.format(angle))


def _skew(skews_ns: Sequence[float], column: str) -> list[SourcedValue]:
    """Median of the logged SENSOR_ROLLING_SHUTTER_SKEW [ns]; nothing if none is logged."""
    return readout_values(
        float(np.median(skews_ns or 0.0)) * _MILLISECOND,
        column,
        'Reported by the phone: median '
        f'of {column}, which is that of the whole sensor: less if the image is cropped at its top '
        'and bottom.',
    )


def _exposure(exposures_ns: Sequence[float]) -> list[SourcedValue]:
    """What SENSOR_TIMESTAMP marks, with the median exposure [ns]; nothing if none is logged."""
    median = float(np.median(exposures_ns)) / NANOSECONDS if exposures_ns else 0.0
    if not 0.0 < median < 1.0:
        return []
    return [
        SourcedValue(
            'stamp_exposure', 'start', "Android's SENSOR_TIMESTAMP is the start of the exposure."
        ),
        SourcedValue(
            'exposure_time',
            round(median, 9),
            'Median of the logged exposures: '
            f'{min(exposures_ns) * _MILLISECOND:.2f} to '
            f'{max(exposures_ns) * _MILLISECOND:.2f} ms.',
        ),
    ]


def _camera_matrix(intrinsics: Sequence[Any], source: str) -> SourcedValue:
    """fx, fy, cx, cy that are no calibration: a parameter, and no CameraInfo."""
    fx, fy, cx, cy = map(float, intrinsics)
    return SourcedValue('camera_matrix', (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0), source)


def _refuse_portrait(path: Path, width: int, height: int) -> None:
    if height > width:  # as no phone's sensor is
        raise InputError(
            f'{path} has images of {width}x{height}: they were rotated, and their rows are the '
            "sensor's columns; record in the sensor's own orientation (landscape)"
        )


def _landscape_video(path: Path) -> Video:
    video = Video(path)
    _refuse_portrait(path, video.width, video.height)
    return video


def _optional_table(path: Path) -> list[Row]:
    return read_table(path) if path.is_file() else []


def _optional_object(path: Path) -> Mapping[str, Any]:
    return read_object(path) if path.is_file() else {}


def _reals(rows: list[Row], column: str) -> list[float]:
    """Numbers of a column, without the rows in which it is absent, empty or 'null'."""
    return [row.real(column) for row in rows if row.words.get(column, '') not in ('', 'null')]


def read_tables(folder: Path) -> Recording:
    """Recordings of any logger as tables with a header line."""
    gyro = [
        ImuSample(_stamp(row), row.vector(*'xyz'), None) for row in read_table(folder / 'gyro.csv')
    ]
    accel = [
        ImuSample(_stamp(row), None, row.vector(*'xyz'))
        for row in _optional_table(folder / 'accel.csv')
    ]
    frames = read_table(folder / 'frames.csv')
    stamps_ns = [_stamp(row) for row in frames]
    if 'file' in frames[0].words:
        images = tuple(
            convert.image_file(stamp_ns, convert.file_inside(folder, row, 'file'))
            for stamp_ns, row in zip(stamps_ns, frames, strict=True)
        )
    else:
        videos = [
            path for path in sorted(folder.iterdir()) if path.suffix.lower() in ('.mp4', '.mov')
        ]
        if len(videos) != 1:
            raise InputError(
                f'{frames[0].path} has no column file, and {folder} has '
                f'{len(videos)} videos (.mp4, .mov): there must be one'
            )
        images = _landscape_video(videos[0]).frames(stamps_ns, frames[0].path)
    return _recording(
        folder,
        '. `rs_relpose calibrate` estimates readout time and focal length',
        images,
        gyro,
        accel,
    )


def _stamp(row: Row) -> int:
    return row.nanoseconds('timestamp_ns' if 'timestamp_ns' in row.words else 'stamp_ns')


# How far the two clocks may drift apart during a recording [ns]; beyond it the phone slept.
_MAX_DRIFT_NS = 1_000_000


def read_mars(folder: Path) -> Recording:
    """Frames of the movie with the logged stamps, and the IMU, of the MARS Logger."""
    video = _landscape_video(folder / 'movie.mp4')
    stamps = folder / 'frame_timestamps.txt'
    shift_ns, clock = _clock(folder / 'edge_epochs.txt')
    stamps_ns = [
        row.nanoseconds('Frame timestamp[nanosec]') + shift_ns for row in read_table(stamps)
    ]
    imu = [
        ImuSample(
            row.nanoseconds('Timestamp[nanosec]'),
            row.vector(*(f'g{axis}[rad/s]' for axis in 'xyz')),
            row.vector(*(f'a{axis}[m/s^2]' for axis in 'xyz')),
        )
        for row in read_table(folder / 'gyro_accel.csv')
    ]
    metadata = _optional_table(folder / 'movie_metadata.csv')
    readout = 'Frame readout time[nanosec]'
    fx, fy = (float(np.median(_reals(metadata, name) or [0.0])) for name in ('fx[px]', 'fy[px]'))
    lens = (
        []
        if min(fx, fy) <= 0.0
        else [
            _camera_matrix(
                (fx, fy, (video.width - 1) / 2.0, (video.height - 1) / 2.0),
                "A GUESS: the lens's "
                'nominal focal length as logged, principal point in the middle, no distortion.',
            )
        ]
    )
    return _recording(
        folder,
        ': recorded with the MARS Logger',
        video.frames(stamps_ns, stamps),
        imu,
        (),
        [
            *_skew(_reals(metadata, readout), readout),
            *_exposure(_reals(metadata, 'Exposure time[nanosec]')),
            *lens,
        ],
        SourcedValue(
            'time_offset', 0.0, f'NOT KNOWN: {clock}. `rs_relpose calibrate` measures it.'
        ),
    )


def _clock(path: Path) -> tuple[int, str]:
    """Difference from the camera's stamps to the IMU's clock [ns], and its description."""
    unknown = 0, 'the clock of the camera is not logged'
    if not path.is_file():
        return unknown
    with path.open(encoding='utf-8', errors='replace') as file:
        if 'is SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME' in file.readline(10_000):
            return 0, 'camera and IMU have one clock, but its delays are not logged'
    differences = [row.integer(2) for row in convert.read_rows(path, range(3), separator=None)]
    if not differences:
        return unknown
    drift = max(differences) - min(differences)
    if drift > _MAX_DRIFT_NS:
        raise InputError(
            f'{path}: the clocks of camera and IMU drifted apart by '
            f'{drift * 1e-6:.1f} ms during the recording: the phone slept; record '
            'again'
        )
    return differences[0], (
        "the camera's clock is not the IMU's; its stamps were shifted by the "
        f'logged difference, {differences[0] * 1e-6:.3f} ms'
    )


# From ARCore's camera (x right, y up, z backwards) to the optical frame (x right, y down).
_GL_FROM_OPTICAL = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])


def read_posecam(folder: Path) -> Recording:
    """Frames, IMU and, as ground truth, ARCore's poses of PoseCam."""
    poses = read_table(folder / 'poses.csv')
    images = tuple(
        convert.image_file(
            row.nanoseconds('timestamp_ns'),
            folder
            / 'frames'
            / (f'{row.nanoseconds("frame_index"):06d}_{row.nanoseconds("timestamp_ns")}.jpg'),
        )
        for row in poses
        if row.word('image') == 'saved'
    )
    gyro, accel, bias = _posecam_imu(folder / 'imu.csv')
    metadata = _optional_table(folder / 'frame_metadata.csv')
    if any(row.words.get('ois_mode') == '1' for row in metadata):
        _logger.warning(
            '%s: optical stabilisation was on: the focal point moves against the '
            'sensor, and the poses get worse; switch it off if the phone can',
            metadata[0].path,
        )
    skew = 'rolling_shutter_skew_ns'
    camera = _optional_object(folder / 'device.json').get('camera')
    return _recording(
        folder,
        ': recorded with PoseCam',
        images,
        gyro,
        accel,
        [
            *_skew(_reals(metadata, skew), skew),
            *_exposure(_reals(metadata, 'exposure_time_ns')),
            *_intrinsics(folder / 'intrinsics.json'),
            *bias,
        ],
        orientation=camera.get('sensor_orientation_deg') if isinstance(camera, Mapping) else None,
        truth=_truth(poses, folder / 'manifest.json'),
    )


def _posecam_imu(path: Path) -> tuple[list[ImuSample], list[ImuSample], list[SourcedValue]]:
    """Gyro, accelerometer, and the bias that the phone reports of an uncorrected gyro."""
    gyro: list[ImuSample] = []
    accel: list[ImuSample] = []
    biases: list[Vector] = []
    for row in read_table(path):
        stamp_ns, kind = row.nanoseconds('timestamp_ns'), row.word('sensor')
        value = row.vector(*'xyz')
        if kind == 'accel':
            accel.append(ImuSample(stamp_ns, None, value))
        elif kind in ('gyro', 'gyro_uncal'):
            gyro.append(ImuSample(stamp_ns, value, None))
            if kind == 'gyro_uncal':
                biases.append(row.vector('bias_x', 'bias_y', 'bias_z'))
        else:
            raise row.error(f'the sensor must be accel, gyro or gyro_uncal, got {kind[:40]!r}')
    if not gyro:
        raise MissingInputError(f'{path} has no samples of a gyro')
    bias = (
        []
        if not biases
        else [
            SourcedValue(
                'gyro_bias',
                tuple(np.median(biases, axis=0).tolist()),
                'Median of the bias that the phone reports; the bag has raw rates.',
            )
        ]
    )
    return gyro, accel, bias


def _truth(poses: list[Row], manifest: Path) -> tuple[TruePose, ...]:
    """The longest sequence of tracked poses without a jump, after which the world is another."""
    found = _optional_object(manifest).get('pose_jumps')
    # Next to the list, whose name is not documented, are counts and thresholds.
    stamps = [
        jump.get('timestamp_ns')
        for values in (found.values() if isinstance(found, Mapping) else [found])
        if isinstance(values, list)
        for jump in values
        if isinstance(jump, Mapping)
    ]
    jumps = [stamp for stamp in stamps if isinstance(stamp, int) and abs(stamp) < 2**63]
    tracked = [row for row in poses if row.word('tracking_state') == 'TRACKING']
    ends = np.searchsorted([row.nanoseconds('timestamp_ns') for row in tracked], sorted(jumps))
    longest = max(np.split(np.arange(len(tracked)), ends), key=len)
    if jumps:
        _logger.warning(
            'ARCore relocalised %d times: only the longest part between, of %d of '
            '%d poses, is used as ground truth',
            len(jumps),
            len(longest),
            len(tracked),
        )
    return tuple(_pose(tracked[number]) for number in longest)


def _pose(row: Row) -> TruePose:
    quaternion = [row.real(column) for column in ('qx', 'qy', 'qz', 'qw')]
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > 1e-2:
        raise row.error(f'the quaternion must have length 1, got {length:.3g}')
    x, y, z, w = (Rotation.from_quat(quaternion) * _GL_FROM_OPTICAL).as_quat().tolist()
    return TruePose(row.nanoseconds('timestamp_ns'), row.vector('tx', 'ty', 'tz'), (x, y, z, w))


def _intrinsics(path: Path) -> list[SourcedValue]:
    if not path.is_file():
        return []
    found = read_object(path)
    values = [found.get(name) for name in ('fx', 'fy', 'cx', 'cy')]
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise InputError(f'{path} must have the numbers fx, fy, cx and cy')
    width, height = found.get('width'), found.get('height')
    if isinstance(width, int) and isinstance(height, int):
        _refuse_portrait(path.with_name('frames'), width, height)
    return [_camera_matrix(values, "ARCore's intrinsics, without distortion.")]


# Logger -> the files by which its folders are recognised, and its reader.
LOGGERS: Mapping[str, tuple[tuple[str, ...], Callable[[Path], Recording]]] = {
    'PoseCam': (('poses.csv', 'imu.csv', 'frames'), read_posecam),
    'MARS Logger': (('movie.mp4', 'frame_timestamps.txt', 'gyro_accel.csv'), read_mars),
    'tables': (('frames.csv', 'gyro.csv'), read_tables),
}


def known_loggers() -> str:
    """All loggers and their files, in words."""
    return '; '.join(f'{name} ({", ".join(files)})' for name, (files, _) in LOGGERS.items())
