"""The situations that users report, each as a defect of a simulated recording.

`CASES` has a row for each situation: how it is made from a base recording, what must be named,
and what a right answer may be. The verdict on an answer is computed from the truth (`verdict`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rs_relpose_lab.field import defects
from rs_relpose_lab.field.recording import FieldRecording
from rs_relpose_lab.simulation import SimulationConfig

Change = Callable[[FieldRecording], FieldRecording]

# Base recordings by name; the first is the one of most cases.
BASES: dict[str, SimulationConfig] = {
    'walk': SimulationConfig(seed=501, scene='hall', duration=24.0, plan='walk:24'),
    'long': SimulationConfig(seed=502, scene='yard', duration=48.0, plan='walk:48'),
    'gallery': SimulationConfig(seed=503, scene='gallery', duration=24.0, plan='walk:24'),
    'stop': SimulationConfig(
        seed=504, scene='hall', duration=34.0, plan='walk:10,still:14,walk:10'
    ),
    'blurred': SimulationConfig(
        seed=505, scene='hall', duration=18.0, plan='walk:18', exposure_time=0.033
    ),
    'plane': SimulationConfig(seed=507, scene='wall', duration=18.0, plan='walk:18'),
    'fisheye': SimulationConfig(
        seed=506,
        scene='hall',
        duration=18.0,
        plan='walk:18',
        fx=290.0,
        distortion=(-0.18, 0.02, 0.0, 0.0, 0.0),
    ),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One situation and the right answers to it."""

    name: str  # identity of shared/field/cases.md's kind, such as C1, and a variant
    text: str
    change: Change
    named: str  # regular expression, one match of which in the tool's words names the cause
    codes: tuple[str, ...] = ()  # findings that may be suspect or wrong without being a mistake
    base: str = 'walk'
    # Whether the data allow poses: at least 80 % of the undisturbed number are wanted then.
    solvable: bool = False
    commands: tuple[str, ...] = ('check', 'calibrate', 'replay', 'odometry')


# A parameter file that states the sigma of one value states those of all; 0: not known.
_NOT_KNOWN = {'time_offset_sigma': 0.0, 'readout_time_sigma': 0.0, 'axes_sigma': 0.0}


def _misstated(name: str, change: Any, sigma: str, value: float) -> Change:
    """A parameter that is off by its own stated sigma."""
    return lambda recording: recording.configured(
        **(_NOT_KNOWN | {name: change(recording.parameters[name]), sigma: value})
    )


_M = np.diag([1.015, 0.99, 1.0]) + 0.005 * np.array([[0, 1, -1], [1, 0, 1], [-1, 1, 0]])
_D = defects

CASES: tuple[Case, ...] = (
    Case('right', 'nothing is wrong', lambda one: one, r'', solvable=True),
    Case(
        'C1',
        "the camera's clock steps by 60 ms after 10 s",
        partial(_D.camera_clock_step, seconds=0.060, after=10.0),
        r'(clock|offset|stamps?)[^.;]*\b(step|jump|set)',
        ('offset_step', 'time_offset'),
        solvable=True,
    ),
    Case(
        'C2',
        "the IMU's clock steps back by 120 ms after 12 s",
        partial(_D.imu_clock_step, seconds=-0.120, after=12.0),
        r'(clock|offset|stamps?)[^.;]*\b(step|jump|set|back)',
        ('offset_step', 'time_offset'),
    ),
    Case(
        'C2-forward',
        "the IMU's clock steps forward by 150 ms after 12 s",
        partial(_D.imu_clock_step, seconds=0.150, after=12.0),
        r'(clock|offset|stamps?)[^.;]*\b(step|jump|set|forward)|gap',
        ('offset_step', 'time_offset'),
    ),
    Case(
        'C3',
        "the camera's clock drifts by 200 ppm",
        partial(_D.camera_clock_drift, ratio=200e-6),
        r'drift|ppm',
        ('offset_drift', 'time_offset'),
        base='long',
        solvable=True,
    ),
    Case(
        'C4',
        'the offset moves by 8 ms, as by automatic exposure',
        partial(_D.offset_follows, span=0.008, period=16.0),
        r'offset|exposure|stamps?',
        ('time_offset', 'offset_drift', 'offset_step', 'offset_per_interval'),
    ),
    Case(
        'C5-late',
        'images reach the bag 7 s after their stamps',
        partial(_D.late_images, seconds=7.0),
        r'delay|late|after their stamps|arriv|receiv',
        solvable=True,
    ),
    Case(
        'C5-imu-first',
        'topics written one after the other, the IMU first',
        partial(_D.topic_by_topic, images_first=False),
        r'',
        solvable=True,
    ),
    Case(
        'C5-images-first',
        'topics written one after the other, images first',
        partial(_D.topic_by_topic, images_first=True),
        r'',
        solvable=True,
    ),
    Case(
        'C6',
        'IMU stamped since boot, images since 1970',
        _D.imu_since_boot,
        r'boot|1970|different clocks|epoch',
        ('time_offset',),
    ),
    Case(
        'C6-leap',
        'the IMU is 36.967 s behind the images',
        partial(_D.imu_offset, seconds=-36.967),
        r'36\.9|37\.0 s|clock',
        ('time_offset',),
    ),
    Case(
        'C7',
        'the time offset is 0.5 s',
        partial(_D.imu_offset, seconds=0.5),
        r'offset|clock',
        ('time_offset',),
        solvable=True,
    ),
    Case(
        'C8',
        'the accelerometer has a clock of its own, 5 s off',
        partial(_D.accelerometer_clock, seconds=5.0),
        r'accelerometer[^.;]*(clock|stamp|ahead|behind)',
        ('accel_clock', 'accel_axes', 'force_fault'),
        solvable=True,
    ),
    Case(
        'C9',
        'the device counts microseconds in 32 bits, which overflow after 10 s',
        partial(_D.wrapped_clock, seconds=2**32 * 1e-6, after=10.0),
        r'32[- ]bit|wrap|overflow|set back',
        ('offset_step', 'time_offset'),
        solvable=True,
    ),
    Case(
        'C9-back',
        'both clocks are set back by half a second after 12 s',
        partial(_D.wrapped_clock, seconds=0.517, after=12.0),
        r'set back|back(wards)?\b|earlier',
        ('offset_step', 'time_offset'),
    ),
    Case(
        'C9-nanoseconds',
        'nanosec of the images exceeds a second',
        _D.overflowing_nanoseconds,
        r'nanosec',
        ('time_offset',),
    ),
    Case(
        'C10',
        '10 samples of the IMU share the last stamp',
        partial(_D.bursts, size=10, stamped='last'),
        r'burst|batch|share',
    ),
    Case(
        'C10-arrival',
        '20 samples arrive 0.1 ms apart, stamped on arrival',
        partial(_D.bursts, size=20, stamped='arrival'),
        r'burst|batch|share',
    ),
    Case(
        'C11-held',
        'an IMU of 50 Hz written at 200 Hz: values held',
        partial(_D.held_samples, times=4, interpolated=False),
        r'50 Hz|repeat|held|true rate',
        solvable=True,
    ),
    Case(
        'C11-interpolated',
        'an IMU of 50 Hz written at 200 Hz: values interpolated',
        partial(_D.held_samples, times=4, interpolated=True),
        r'50 Hz|interpolat|true rate',
        solvable=True,
    ),
    Case(
        'C12',
        'every third image is the one before, encoded again',
        partial(_D.repeated_images, every=3, noise=0.8),
        r'repeat|same image|duplicate|frozen',
        ('repeated_images',),
        solvable=True,
    ),
    Case(
        'C12-lost',
        'every third image is the one before, and a sixth of all do not arrive',
        lambda one: _D.lost_images(_D.repeated_images(one, every=3, noise=0.8), share=1 / 6),
        r'repeat|same image|duplicate|frozen',
        ('repeated_images',),
    ),
    Case(
        'C12-frozen',
        'the image is frozen for 1 s',
        partial(_D.frozen_images, begin=11.0, seconds=1.0),
        r'repeat|same image|duplicate|frozen',
        ('repeated_images',),
        solvable=True,
    ),
    Case(
        'C13',
        'images are stamped on arrival, 6 ms late in the mean',
        partial(_D.stamped_on_arrival, mean=0.006),
        r'jitter|arrival|offset',
        ('time_offset', 'stamp_jitter'),
    ),
    Case(
        'I1',
        'gyro scale off by 1 to 1.5 %, axes misaligned by half a degree',
        partial(_D.gyro_matrix, matrix=_M),
        r'scale|misalign|gyro matrix|skew|gyro_scale',
        ('gyro_scale', 'gyro_skew', 'axes'),
        solvable=True,
    ),
    Case(
        'I2-white',
        'vibration: 0.2 rad/s of white noise',
        partial(_D.gyro_added, white=0.2),
        r'vibrat|noise',
        ('gyro_noise', 'vibration'),
    ),
    Case(
        'I2-tone',
        'vibration: a tone of 83 Hz, 0.25 rad/s',
        partial(_D.gyro_added, tone=0.25, hertz=83.0),
        r'vibrat|noise',
        ('gyro_noise', 'vibration'),
    ),
    Case(
        'I3-degrees',
        'gyro in deg/s',
        partial(_D.gyro_factor, factor=180.0 / np.pi),
        r'deg/s|unit',
        ('gyro_unit',),
    ),
    Case(
        'I3-factor',
        'gyro in raw counts, 0.12 of rad/s',
        partial(_D.gyro_factor, factor=0.12),
        r'unit|factor|scale',
        ('gyro_unit', 'gyro_scale'),
    ),
    Case(
        'I3-half',
        'gyro of half the rate: another full-scale range than its driver assumes',
        partial(_D.gyro_factor, factor=0.5),
        r'unit|full-scale|factor',
        ('gyro_unit', 'gyro_scale'),
    ),
    Case(
        'I3-g',
        'accelerometer in g',
        partial(_D.accel_factor, factor=1.0 / 9.80665),
        r'\bg\b|unit|m/s',
        ('accel_axes', 'accel_scale', 'accel_unit', 'force_fault'),
    ),
    Case(
        'I4',
        'the driver removes gravity',
        _D.gravity_removed,
        r'gravity',
        ('accel_axes', 'accel_scale'),
        solvable=True,
    ),
    Case(
        'I4-sign',
        'specific force of the opposite sign, as of iOS',
        partial(_D.accel_factor, factor=-1.0),
        r'sign|opposite|gravity',
        ('accel_axes', 'accel_scale'),
        solvable=True,
    ),
    Case('I5', 'two IMUs on one topic', _D.two_imus, r'imu_link.*base_imu_link|two IMU'),
    Case(
        'I6',
        'noise parameters of a data sheet: accel_bias_walk 4e-5',
        lambda one: one.configured(accel_bias_walk=4e-5),
        r'',
        solvable=True,
    ),
    Case(
        'I7',
        'low-pass filters in the IMU: 12 ms for the gyro, 5 ms for the accelerometer',
        partial(_D.low_pass, gyro=0.012, accel=0.005),
        r'offset|lag|filter',
        ('time_offset', 'imu_lag'),
        solvable=True,
    ),
    Case(
        'I8',
        'optical stabilisation: the lens follows 0.9 of the rotation',
        partial(_D.stabilised, share=0.9, limit=30.0),
        r'stabili[sz]',
        ('stabilisation',),
    ),
    Case(
        'G1',
        '36 px are cut off at the left, K kept',
        partial(_D.cropped, left=36),
        r'principal',
        ('principal_point',),
        solvable=True,
    ),
    Case(
        'G2',
        'K of twice the resolution',
        partial(_D.matrix_scaled, factor=2.0),
        r'resolution|binn|camera matrix|K of',
        ('image_resolution', 'focal_length', 'principal_point', 'image_geometry'),
    ),
    Case(
        'G2-half',
        'K of half the resolution',
        partial(_D.matrix_scaled, factor=0.5),
        r'resolution|binn|camera matrix|K of',
        ('image_resolution', 'focal_length', 'principal_point', 'image_geometry'),
    ),
    Case(
        'G2-binned',
        'binning is set, though K is the one of the binned image',
        lambda one: replace(
            one,
            camera=one.camera,
            info_fields={'width': 1280, 'height': 960, 'binning_x': 2, 'binning_y': 2},
        ),
        r'binn',
        ('image_resolution', 'focal_length', 'principal_point', 'image_geometry'),
    ),
    Case(
        'G3',
        'images squeezed to three quarters of the width',
        partial(_D.squeezed, factor=0.75),
        r'aspect|focal lengths|squeez|fx',
        ('aspect', 'focal_length'),
    ),
    Case(
        'G4',
        'portrait: the driver rotates by a quarter turn',
        partial(_D.portrait, turns=1),
        r'column|portrait|readout_direction|left|right',
        ('readout_columns', 'readout_direction'),
        solvable=True,
    ),
    Case('G5-180', 'rotated by half a turn, configured so', partial(_D.portrait, turns=2), r''),
    Case(
        'G5-mirrored',
        'columns are in reverse order',
        _D.mirrored,
        r'mirror|flip',
        # Rotations alone fit axes that are half a turn off as well: both are candidates.
        ('image_geometry', 'axes'),
    ),
    Case(
        'G6',
        'the focal length grows by 4 % over the bag',
        partial(_D.zooming, share=0.04),
        r'focal|zoom|focus',
        ('focal_drift', 'focal_length'),
    ),
    Case(
        'G7',
        'side-by-side stereo as one image',
        _D.side_by_side,
        r'two views|stereo|side',
        ('two_views', 'image_geometry'),
    ),
    Case(
        'G8-left',
        'a quarter of the image at the left does not move',
        partial(_D.overlay, share=0.25, side='left'),
        r'static|does not move|mask|overlay',
        ('static_region',),
        solvable=True,
    ),
    Case(
        'G8-bottom',
        'a quarter of the image at the bottom does not move',
        partial(_D.overlay, share=0.25, side='bottom'),
        r'static|does not move|mask|overlay',
        ('static_region',),
        base='gallery',
        solvable=True,
    ),
    Case(
        'G9',
        'inside a vehicle: all but a window of a quarter moves with the IMU',
        partial(_D.overlay, share=0.75, side='around'),
        r'interior|static|does not move|mask|vehicle',
        ('interior', 'static_region'),
    ),
    Case(
        'G10',
        'an object as wide as 0.4 of the view moves to and fro',
        partial(_D.moving_object, share=0.4, period=4.0),
        r'object|moving|consensus|second motion',
        ('moving_object',),
    ),
    Case(
        'G11',
        'light of mains flickers, the exposure jumps',
        partial(_D.flicker, strength=0.15),
        r'',
    ),
    Case(
        'G12',
        'a single plane fills the view, about five baselines away',
        lambda one: one,
        r'',
        base='plane',
        solvable=True,
    ),
    Case('G13', 'exposure as long as the frame interval', lambda one: one, r'', base='blurred'),
    Case('G14', 'a wide lens near its fold', lambda one: one, r'', base='fisheye', solvable=True),
    Case(
        'G15',
        'p1 and p2 of another lens of the same model',
        partial(_D.decentred, p1=0.004, p2=-0.003),
        r'tangential',
        ('tangential', 'principal_point'),
    ),
    Case(
        'O1',
        'time_offset off by its own stated sigma of 5 ms',
        _misstated('time_offset', lambda value: value + 0.005, 'time_offset_sigma', 0.005),
        r'',
        ('time_offset',),
        solvable=True,
    ),
    Case(
        'O2-axes',
        'axes off by their own stated sigma of 0.6 deg',
        _misstated(
            'quat_cam_imu_xyzw',
            lambda q: (np.array(q) + 0.0052 * np.array([q[3], q[2], -q[1], -q[0]])).tolist(),
            'axes_sigma',
            0.0105,
        ),
        r'',
        ('axes',),
        solvable=True,
    ),
    Case(
        'O2-focal',
        'the focal length is off by its own stated sigma of 1 %',
        lambda one: _D.focal_scaled(one, 1.01).configured(
            **(_NOT_KNOWN | {'focal_length_sigma': 0.01})
        ),
        r'',
        ('focal_length',),
        solvable=True,
    ),
    Case(
        'O2-readout',
        'the readout time is off by its own stated sigma of 2 ms',
        _misstated('readout_time', lambda value: value + 0.002, 'readout_time_sigma', 0.002),
        r'',
        ('readout_time',),
        solvable=True,
    ),
    Case(
        'O3',
        'the camera is covered for 5 s while it moves',
        partial(_D.covered_lens, begin=11.0, seconds=5.0),
        r'dark|no texture|lost|few|matches',
        solvable=False,
    ),
    Case(
        'O4',
        'an object of 0.8 of the view moves while the camera walks',
        partial(_D.moving_object, share=0.8, period=6.0),
        r'object|moving|consensus|second motion',
        ('moving_object',),
    ),
    Case(
        'O5',
        'IMU noise ten times the configured one',
        partial(_D.imu_noise, gyro=0.024, accel=0.28),
        r'',
        ('gyro_noise', 'accel_noise'),
    ),
    Case('O6', 'standstill, then motion', lambda one: one, r'', base='stop', solvable=True),
    Case(
        'O7',
        'the device is put down hard: the accelerometer clips at 8 g',
        partial(_D.knock, at=15.0, clip=78.0),
        r'',
        ('knock', 'accel_noise'),
        base='stop',
    ),
)
BY_NAME = {case.name: case for case in CASES}
# Situations that are played to running nodes by default.
LIVE = ('C1', 'C12', 'G8-left', 'O1', 'O3')


def with_variants(names: Iterable[str]) -> list[str]:
    """Names in which a kind of situations, as G8, is replaced by its variants, as G8-left."""
    chosen: list[str] = []
    for name in names:
        variants = [one for one in BY_NAME if one.startswith(f'{name}-')]
        chosen += [name, *variants] if name in BY_NAME or not variants else variants
    return chosen
