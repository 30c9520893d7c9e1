"""Small recordings as cameras, phones and data sets have them, and damage to their files."""

from collections.abc import Callable, Sequence
from fractions import Fraction
import json
from pathlib import Path
import struct

import cv2
import numpy as np
import pytest

MILLISECOND = 10**6
SECOND = 10**9
START = 296_906_159_688_983
STAMPS = [START + 33 * MILLISECOND * k for k in range(5)]
IMU_STAMPS = [START - 20 * MILLISECOND + 5 * MILLISECOND * k for k in range(50)]


def brightness(number: int) -> int:
    """Gray value of a frame."""
    return 30 + 20 * (number % 10)


def picture(number: int, width: int = 64, height: int = 48, *shape: int) -> bytes:
    pixels = np.full((height, width, *shape), brightness(number), dtype=np.uint8)
    pixels[0, 0] = 0
    return cv2.imencode('.jpg', pixels)[1].tobytes()


def write_table(
    path: Path, header: str, rows: Sequence[Sequence[object]], separator: str = ','
) -> None:
    path.write_text('\n'.join([header, *(separator.join(map(str, row)) for row in rows)]) + '\n')


# --- damage


def replaced(name: str, old: str, new: str) -> Callable[[Path], None]:
    """Replace the first place of a text, which must be there."""

    def damage(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return damage


def removed(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def written(name: str, data: bytes) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        assert (folder / name).is_file()
        (folder / name).write_bytes(data)

    return damage


# --- videos

TICKS_PER_SECOND = 30_000
# Frames whose rate varies, as phones record [ticks].
TICKS = [0, 1000, 2033, 3000, 5000, 6001, 7001]
# Of telemetry: up along the columns of the image, to the left, backwards.
RATE = (0.1, -0.2, 0.3)
FORCE_G = (1.0, 0.1, -0.2)


def write_video(path: Path, ticks: Sequence[int], width: int = 64, height: int = 48) -> None:
    """Frames at these times; frame k has the brightness `brightness(k)`."""
    # Not on a ROS machine: there, tests of videos are skipped.
    av = pytest.importorskip('av', reason='needs the extra video')
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('mpeg4', rate=30)
        stream.width = width
        stream.height = height
        stream.pix_fmt = 'yuv420p'
        stream.codec_context.time_base = Fraction(1, TICKS_PER_SECOND)
        stream.codec_context.gop_size = 4
        for number, tick in enumerate(ticks):
            pixels = np.full((height, width, 3), brightness(number), dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format='bgr24')
            frame.pts = tick
            frame.time_base = Fraction(1, TICKS_PER_SECOND)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def make_clip(folder: Path, tags: dict[str, str] | None = None, whole: bool = True) -> Path:
    """A video without IMU, with GoPro's `tags`; `whole`: with what follows them."""
    pytest.importorskip('telemetry_parser', reason='needs the extra video')
    folder.mkdir(exist_ok=True)
    path = folder / 'clip.mp4'
    write_video(path, TICKS)
    if tags is not None:
        add_gopro_tags(path, tags, whole)
    return path


def make_video(folder: Path, **header: object) -> Path:
    """A video with Gyroflow's log next to it."""
    path = make_clip(folder)
    lines = [
        'GYROFLOW IMU LOG',
        'version,1.3',
        'id,Model_1',
        'vendor,Acme',
        'orientation,XYZ',
        *(f'{name},{value}' for name, value in header.items()),
        'tscale,0.001',
        'gscale,1',
        'ascale,1',
        't,gx,gy,gz,ax,ay,az',
        *(','.join(map(repr, (5 * k, *RATE, *FORCE_G))) for k in range(60)),
    ]
    path.with_suffix('.gcsv').write_text('\n'.join(lines) + '\n')
    return path


def add_gopro_tags(path: Path, tags: dict[str, str], whole: bool) -> None:
    """Append GoPro's box of tags (GPMF), each a text."""
    entries = b''.join(
        name.encode()
        + struct.pack('>cBH', b'c', 1, len(text))
        + text.encode()
        + b'\0' * (-len(text) % 4)
        for name, text in tags.items()
    )
    # Four bytes that telemetry-parser passes over.
    entries = b'\0\0\0\0' + entries
    device = b'DEVC' + struct.pack('>BBH', 0, 1, len(entries)) + entries
    with path.open('ab') as file:
        file.write(struct.pack('>I', 8 + len(device)) + b'GPMF' + device)
        if whole:
            file.write(struct.pack('>I', 8) + b'free')


def rotate_for_display(path: Path) -> None:
    """Ask players to show the video rotated by 90 degrees."""
    data = path.read_bytes()
    identity = struct.pack('>9i', 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    rotated = struct.pack('>9i', 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    at = data.index(identity, data.index(b'tkhd'))
    path.write_bytes(data[:at] + rotated + data[at + len(identity) :])


# --- phones

VIDEO_TICKS = [1000 * k for k in range(len(STAMPS))]


def make_posecam(folder: Path) -> Path:
    (folder / 'frames').mkdir(parents=True)
    for number in (0, 1, 3, 4):
        (folder / 'frames' / f'{number:06d}_{STAMPS[number]}.jpg').write_bytes(picture(number))
    write_table(
        folder / 'poses.csv',
        'frame_index,timestamp_ns,tx,ty,tz,qx,qy,qz,qw,tracking_state,image',
        [
            [
                number,
                stamp,
                *([''] * 7 if number == 1 else [0.1 * number, 0.2, 0.3, 0, 0, 0, 1]),
                'PAUSED:INSUFFICIENT_FEATURES' if number == 1 else 'TRACKING',
                'dropped:queue_full' if number == 2 else 'saved',
            ]
            for number, stamp in enumerate(STAMPS)
        ],
    )
    write_table(
        folder / 'frame_metadata.csv',
        'frame_index,timestamp_ns,exposure_time_ns,rolling_shutter_skew_ns,ois_mode',
        [
            [number, stamp, 4_000_000 + number, '' if number == 0 else 21_500_000, 0]
            for number, stamp in enumerate(STAMPS)
        ],
    )
    write_table(
        folder / 'imu.csv',
        'timestamp_ns,sensor,x,y,z,bias_x,bias_y,bias_z',
        [
            row
            for stamp in IMU_STAMPS
            for row in (
                [stamp, 'accel', 0.05, 9.8, 0.5, '', '', ''],
                [stamp + 1_000_000, 'gyro_uncal', '-5.5E-4', 0.25, 0.5, 0.01, 0.02, -0.03],
            )
        ],
    )
    (folder / 'intrinsics.json').write_text(
        json.dumps({'width': 64, 'height': 48, 'fx': 50.5, 'fy': 51.5, 'cx': 32.5, 'cy': 23.5})
    )
    (folder / 'device.json').write_text(json.dumps({'camera': {'sensor_orientation_deg': 90}}))
    (folder / 'manifest.json').write_text(json.dumps({'pose_jumps': {'count': 0, 'jumps': []}}))
    return folder


def make_mars(folder: Path, clock: str = 'REALTIME', difference: int = 0) -> Path:
    folder.mkdir(parents=True)
    write_video(folder / 'movie.mp4', VIDEO_TICKS)
    camera = [stamp - difference for stamp in STAMPS]
    write_table(
        folder / 'frame_timestamps.txt',
        'Frame timestamp[nanosec],Unix time[nanosec]',
        [[stamp, 1_600_000_000_000_000_000] for stamp in camera],
    )
    write_table(
        folder / 'gyro_accel.csv',
        'Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2],'
        'Unix time[nanosec]',
        [[stamp, 0.1, -0.2, 0.3, 0.5, 9.8, 0.1, 1] for stamp in IMU_STAMPS],
    )
    write_table(
        folder / 'movie_metadata.csv',
        'Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],'
        'Sensor frame duration[nanosec],Frame readout time[nanosec],ISO,Focal length,'
        'Focus distance,AF mode,Unix time[nanosec]',
        [
            [stamp, 60.5, 61.5, number, 10_000_000, 33_000_000, 18_000_000, 100, 4.3, 'null', 1, 1]
            for number, stamp in enumerate(camera)
        ],
    )
    write_table(
        folder / 'edge_epochs.txt',
        '#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_'
        f'TIMESTAMP_SOURCE is SENSOR_INFO_TIMESTAMP_SOURCE_{clock}.\n#and more',
        [[START, START - difference, difference], [START + 5, START - difference + 5, difference]],
        separator='\t',
    )
    return folder


def make_tables(folder: Path, *, as_video: bool = False) -> Path:
    folder.mkdir(parents=True)
    if as_video:
        write_video(folder / 'a.MP4', VIDEO_TICKS)
        write_table(folder / 'frames.csv', 'timestamp_ns', [[stamp] for stamp in STAMPS])
    else:
        for number in range(len(STAMPS)):
            (folder / f'{number}.jpg').write_bytes(picture(number))
        write_table(
            folder / 'frames.csv',
            'frame,stamp_ns,file',
            [[number, stamp, f'{number}.jpg'] for number, stamp in enumerate(STAMPS)],
        )
    write_table(
        folder / 'gyro.csv',
        'stamp_ns,x,y,z',
        [[stamp, 0.1, -0.2, 0.3] for stamp in reversed(IMU_STAMPS)],
    )
    write_table(
        folder / 'accel.csv',
        'stamp_ns,x,y,z',
        [[stamp + 7, 0.1, 9.8, 0.3] for stamp in IMU_STAMPS],
    )
    return folder


# --- public data sets

REALSENSE_START = 1_650_458_790_000_000_001
REALSENSE_STAMPS = [REALSENSE_START + (1002 + 35 * k) * MILLISECOND for k in range(3)]


def make_realsense(folder: Path) -> Path:
    (folder / 'images').mkdir(parents=True)
    (folder / 'camera.txt').write_text('60.5 61.5 32.25 24.75 0\n64 48\ncrop\n512 512\n')
    for number, stamp in enumerate(REALSENSE_STAMPS):
        (folder / 'images' / f'{stamp}.jpg').write_bytes(picture(number))
    write_table(
        folder / 'frames.csv',
        'segment,index_in_original,stamp_ns,dt_to_next_ms,file',
        [
            ['A', number, stamp, 35.0, f'images/{stamp}.jpg']
            for number, stamp in enumerate(REALSENSE_STAMPS)
        ],
    )
    stamps = sorted(
        [REALSENSE_START + k * 5 * MILLISECOND for k in range(1000)] + REALSENSE_STAMPS
    )
    rows = [
        [stamp, f'{k * 1e-4:.6f}', -0.2, 0.3, 0.5, -9.8, -0.1] for k, stamp in enumerate(stamps)
    ]
    # One line twice, and two in the wrong order.
    write_table(
        folder / 'imu.txt',
        '# timestamp[ns] w a',
        [*rows[:11], rows[10], rows[12], rows[11], *rows[13:]],
        separator=' ',
    )
    return folder


def make_xiaomi(folder: Path) -> Path:
    (folder / 'images').mkdir(parents=True)
    # As the authors' script wrote them, with digits that are not theirs.
    starts = ['4.328040426246000454e+06', '4.328040459559000097e+06', '4.328040492871999741e+06']
    (folder / 'framestamp.txt').write_text('\n'.join(starts) + '\n')
    for number in (2, 3):
        (folder / 'images' / f'RE_frame-{number}.jpg').write_bytes(picture(number, 800, 600, 3))
    (folder / 'images' / 'Thumbs.db').write_bytes(b'x')
    rows = [f'{k * 1e-3:.6e},-0.2,3e-1,{4328040.0 + k * 0.25:.6f}' for k in range(40)]
    (folder / 'gyro.txt').write_text('\n'.join(rows) + '\n')
    return folder
