"""Videos of cameras that log their IMU: GoPro, and others that telemetry-parser reads."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.bags import convert
from rs_relpose_ros.bags.convert import Recording
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, library, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample, Vector

# Stamp of the first frame: the file has no clock, and samples can precede it.
START_NS = 1000 * NANOSECONDS

_JPEG_QUALITY = 90
_ABSENT = ('videos need the Python package {}, which is not installed: pip install av '
           'telemetry-parser')


def read_video(path: Path, lens_profile: Path | None) -> Recording:
    """A video with its telemetry; frames are decoded when the bag is written.

    `lens_profile`: a profile of Gyroflow, or a folder of them with one of this camera's mode; it
    gives the calibration, and the readout time if the file does not have it.
    """
    telemetry = read_telemetry(path, START_NS)
    video = Video(path)
    times_ns = video.times_ns()
    duration_ns = max(times_ns[-1] - times_ns[0], 1)
    mode = VideoMode(telemetry.brand, telemetry.model, video.width, video.height,
                     (len(video) - 1) * NANOSECONDS / duration_ns)
    camera, readout = None, telemetry.readout
    if lens_profile is not None:
        camera, profile_readout = find_lens_profile(lens_profile, mode)
        readout = readout or profile_readout
    parameters = [
        convert.COMPRESSED, *readout,
        SourcedValue('stamp_row', 'first', 'Convention of time_offset here.'),
        SourcedValue('time_offset', 0.0, 'NOT KNOWN: the file does not report the start of its '
                     'IMU against its frames; tens of milliseconds are usual. `rs_relpose '
                     'calibrate` measures it.'),
        SourcedValue('quat_cam_imu_xyzw', (0.0, 0.0, 0.0, 1.0),
                     "The IMU data are converted to the camera's axes.")]
    return Recording(
        camera, video.frames([START_NS + time_ns for time_ns in times_ns], path), telemetry.gyro,
        f'Parameters of relpose_node for {path.name} (`rs_relpose convert video`): {mode}. '
        '`rs_relpose calibrate` estimates those that are missing.', tuple(parameters),
        accel=telemetry.accel)


class Video:
    """The first video stream of a file, as it was encoded: a rotation for display is not applied.

    MissingInputError without the file or PyAV; InputError if it is no video.
    """

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
            self._pts = sorted(packet.pts for packet in container.demux(stream)
                               if packet.size and packet.pts is not None
                               and not packet.is_discard)
        if not self._pts:
            raise MissingInputError(f'{path} has no frames')
        self._decoded: Iterator[Any] = iter(())
        self._next = len(self._pts)   # number of the frame that the decoder gives next

    def __len__(self) -> int:
        return len(self._pts)

    def times_ns(self) -> list[int]:
        """Time [ns] of each frame from the start of the file, rounded from the exact one."""
        return [round(pts * self._time_base * NANOSECONDS) for pts in self._pts]

    def frames(self, stamps_ns: Sequence[int], source: Path) -> tuple[convert.RecordedImage, ...]:
        """All frames, with the stamp [ns] of each; `source`: the file of the stamps."""
        if len(stamps_ns) != len(self):
            raise InputError(f'{source} has {len(stamps_ns)} stamps, but {self.path} has '
                             f'{len(self)} frames: they cannot be assigned to each other')
        return tuple(convert.RecordedImage(stamp_ns, f'frame {number + 1} of {self.path}',
                                           partial(self.jpeg, number))
                     for number, stamp_ns in enumerate(stamps_ns))

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
        raise InputError(f'{self.path}: frame {number + 1} of {len(self)} cannot be decoded: the '
                         'file is damaged')

    @contextmanager
    def _decoding(self) -> Iterator[None]:
        try:
            yield
        except self._av.error.FFmpegError as error:
            raise InputError(
                f'{self.path} is no video that can be read: {error.strerror}') from error


# telemetry-parser and lens profiles add this to the milliseconds of columns.
_BY_COLUMNS_MS = 10_000.0


def readout_values(milliseconds: float, name: str, source: str) -> list[SourcedValue]:
    """Parameters of a readout time [ms], negative if read upwards; none for 0, if it is unknown.

    `source`: in words. InputError, with the name of the value, for a sensor that is read column by
    column.
    """
    if abs(milliseconds) >= _BY_COLUMNS_MS:
        raise InputError(f'{name}: the sensor is read column by column, which the model of row '
                         'times does not cover')
    if not 0.0 < abs(milliseconds) < 1000.0:
        return []
    return [SourcedValue('readout_time', round(abs(milliseconds) * 1e-3, 9), source),
            SourcedValue('readout_direction', 'down' if milliseconds > 0.0 else 'up',
                         'As the readout time.')]


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
    ('Default', '0x45495341', ('N', 'N/A'), "GoPro's EISA",
     'video stabilisation (HyperSmooth) and horizon levelling'),
)


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Telemetry of a video; samples in the camera's axes."""

    brand: str
    model: str
    gyro: list[ImuSample]   # with the accelerometer if it has the same rate
    accel: list[ImuSample]   # else separately
    readout: list[SourcedValue]   # its parameters, none if it is unknown


def read_telemetry(path: Path, start_ns: int) -> Telemetry:
    """Telemetry of a video whose first frame is stamped `start_ns`.

    MissingInputError if the file has none, or no gyro; InputError if the images are stabilised:
    then a row has no single time.
    """
    parser, tags, samples = _parsed(path)
    for group, tag, off, name, switch in _STABILISATION:
        for value in _values(tags, group, tag):
            if str(value).strip() not in off:
                raise InputError(
                    f'{path} is stabilised in the camera ({name} is {value}): each image was '
                    f'warped, so its rows have no single time; switch {switch} off before '
                    'recording')
    with_gyro = [sample for sample in samples if sample['gyro'] is not None]
    brand, model = parser.camera or 'unknown camera', parser.model or 'of unknown model'
    if not with_gyro:
        raise MissingInputError(f'{path} ({brand} {model}) has no gyro that telemetry-parser '
                                'reads')
    times = [start_ns + to_nanoseconds(float(sample['timestamp_ms']) * 1e-3)
             for sample in with_gyro]
    rates = _in_camera(np.radians([sample['gyro'] for sample in with_gyro]))
    found = [sample['accl'] for sample in with_gyro if sample['accl'] is not None]
    forces: Sequence[Vector | None] = _in_camera(found) if found else []
    accel: list[ImuSample] = []
    if len(forces) < len(times):
        # With its own rate, uniformly over the time of the gyro: telemetry-parser lists the
        # sensors of a payload in parallel, independently of their rates.
        step = (times[-1] - times[0]) / max(len(times) - 1, 1) * len(times) / max(len(forces), 1)
        accel = [ImuSample(times[0] + round(number * step), None, force)
                 for number, force in enumerate(forces)]
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
            "the camera wrote it, or Gyroflow's .gcsv next to it") from error
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
                    -milliseconds if direction in _UPWARDS else milliseconds, source,
                    f'Reported by the file: {source}.'):
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


@dataclass(frozen=True, slots=True)
class VideoMode:
    """Maker, model, size [px] and mean rate [Hz] of a video."""

    brand: str
    model: str
    width: int
    height: int
    rate: float

    def __str__(self) -> str:
        return f'{self.brand} {self.model}, {self.width}x{self.height} at {self.rate:.2f} Hz'


def find_lens_profile(
        path: Path, mode: VideoMode) -> tuple[RollingShutterCamera, list[SourcedValue]]:
    """Calibration (its readout time 0 if unknown) and readout time of a camera mode.

    `path` is a profile, or a folder with exactly one profile of the mode. MissingInputError if
    there is none; InputError if there are several, or if it is for images of another shape.
    """
    if not path.is_dir():
        return _profile(path, convert.read_object(path), mode)
    fitting = [(file, profile) for file in sorted(path.rglob('*.json'))
               if _is_of(profile := convert.read_object(file), mode)]
    if not fitting:
        raise MissingInputError(f'{path} has no lens profile of {mode}: give the file of a '
                                'similar one, or calibrate')
    if len(fitting) > 1:
        names = ', '.join(str(file.relative_to(path)) for file, _ in fitting[:_LISTED])
        raise InputError(f'{path} has {len(fitting)} lens profiles of {mode}, give the file of '
                         f'one of them: {names}{", ..." if len(fitting) > _LISTED else ""}')
    return _profile(*fitting[0], mode)


def _is_of(profile: dict[str, Any], mode: VideoMode) -> bool:
    rate = profile.get('fps')
    return (_plain(profile.get('camera_brand')) == _plain(mode.brand)
            and _plain(profile.get('camera_model')) == _plain(mode.model)
            and any(_size(profile, name) == (mode.width, mode.height)
                    for name in ('orig_dimension', 'calib_dimension'))
            and isinstance(rate, int | float)
            and abs(rate / mode.rate - 1.0) < _RATE_TOLERANCE)


def _profile(path: Path, profile: dict[str, Any], mode: VideoMode
             ) -> tuple[RollingShutterCamera, list[SourcedValue]]:
    size, fisheye = _size(profile, 'calib_dimension'), profile.get('fisheye_params')
    found = fisheye if isinstance(fisheye, dict) else {}
    matrix = convert.finite_numbers(found.get('camera_matrix'), (3, 3))
    coefficients = convert.finite_numbers(found.get('distortion_coeffs'), (4,))
    if size is None or matrix is None or coefficients is None:
        raise InputError(f'{path} is no lens profile: it needs calib_dimension (w, h) and '
                         'fisheye_params (camera_matrix, distortion_coeffs)')
    if profile.get('distortion_model') not in (None, '', 'opencv_fisheye'):
        raise InputError(f'{path}: the distortion model {profile["distortion_model"]!r} is not '
                         "supported: it must be OpenCV's fisheye")
    for name in ('input_horizontal_stretch', 'input_vertical_stretch'):
        if profile.get(name) not in (None, 1, 1.0, 0, 0.0):
            raise InputError(f'{path}: {name} must be 1, got {profile[name]}: the images are '
                             'stretched')
    scale_x, scale_y = mode.width / size[0], mode.height / size[1]
    if abs(scale_x / scale_y - 1.0) > _ASPECT_TOLERANCE:
        raise InputError(f'{path} is for images of {size[0]}x{size[1]}, another aspect ratio than '
                         f'that of the video, {mode.width}x{mode.height}')
    milliseconds, source = profile.get('frame_readout_time'), f'lens profile {path.name}'
    if not isinstance(milliseconds, int | float):
        milliseconds = 0.0
    readout = readout_values(
        milliseconds, source,
        f'A GUESS, not reported by the file: {source}. `rs_relpose calibrate` measures it.')
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    # Pixel centres have integer coordinates.
    return RollingShutterCamera(
        width=mode.width, height=mode.height, fx=scale_x * fx, fy=scale_y * fy,
        cx=scale_x * (cx + 0.5) - 0.5, cy=scale_y * (cy + 0.5) - 0.5,
        distortion_model='equidistant', distortion=tuple(coefficients.tolist()),
        readout_time=round(abs(milliseconds) * 1e-3, 9) if readout else 0.0), readout


def _size(profile: dict[str, Any], name: str) -> tuple[int, int] | None:
    match profile.get(name):
        case {'w': int(width), 'h': int(height)} if min(width, height) > 0:
            return width, height
    return None


def _plain(name: object) -> str:
    """A name without characters that makers write differently."""
    return ''.join(filter(str.isalnum, name.casefold())) if isinstance(name, str) else ''
