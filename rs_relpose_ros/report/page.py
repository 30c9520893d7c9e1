"""The page of a report: one HTML file without scripts that loads nothing."""

from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from html import escape
from itertools import chain
import math
from pathlib import PurePath
import re
from typing import NamedTuple

import cv2
import numpy as np

from rs_relpose_ros.calibrate import result as calibration
from rs_relpose_ros.calibration.findings import Finding, FindingState
from rs_relpose_ros.calibration.residual_maps import FAILS_BELOW
from rs_relpose_ros.messages.outgoing import draw_pair
from rs_relpose_ros.offline import tables
from rs_relpose_ros.offline.check_report import Line
from rs_relpose_ros.offline.truth import median_and_p90
from rs_relpose_ros.report import plots
from rs_relpose_ros.report.plots import Drawing
from rs_relpose_ros.report.run import is_unusable, Observation

# Quality of the frames as JPEG, in percent. More makes the page larger and shows nothing more.
# [chosen: any value in 70..90 would do]
_JPEG_QUALITY = 80
# Shortest name that is left out of texts: shorter ones are parts of words.
_SHORTEST_NAME = 3

# Light and dark by the reader's system, one column on a phone.
_CSS = """
:root { color-scheme: light dark; --ground: #ffffff; --ink: #1c2024; --soft: #5f6872;
  --card: #f4f6f8; --grid: #d8dde2; --blue: #0072b2; --red: #c44e00; --green: #00845f;
  --orange: #c98500; }
@media (prefers-color-scheme: dark) { :root { --ground: #14171a; --ink: #e6e9ec; --soft: #9aa4ae;
  --card: #1f2429; --grid: #363d45; --blue: #56b4e9; --red: #ff8b3d; --green: #2fc79a;
  --orange: #f0b429; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1320px; padding: 0 16px 48px; background: var(--ground);
  color: var(--ink); font: 16px/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; margin: 24px 0 4px; } h2 { font-size: 1.2rem; margin: 40px 0 8px; }
p { margin: 6px 0; max-width: 75ch; } .soft, .caption { color: var(--soft); font-size:
  .875rem; }
a { color: var(--blue); } nav { display: flex; flex-wrap: wrap; gap: 4px 16px; padding: 8px 0;
  position: sticky; top: 0; background: var(--ground); border-bottom: 1px solid var(--grid); }
nav a { text-decoration: none; padding: 2px 0; }
.cards, .drawings { display: grid; gap: 16px; grid-template-columns:
  repeat(auto-fill, minmax(min(100%, 440px), 1fr)); }
.cards { grid-template-columns: repeat(auto-fit, minmax(min(100%, 280px), 1fr)); margin: 16px 0;
  } .cards > div { background: var(--card); border-radius: 8px;
  padding: 12px 16px; border-left: 5px solid var(--soft); }
.cards h2 { margin: 0; font-size: .875rem; color: var(--soft); font-weight: 600; }
.cards p { margin: 2px 0; } .cards strong { font-size: 1.1rem; }
.ok { border-color: var(--green) !important; } .wrong { border-color: var(--red) !important; }
.suspect { border-color: var(--orange) !important; }
.plot { margin: 0; min-width: 0; max-width: 660px; } .plot svg, .plot img { width: 100%;
  height: auto;
  display: block; } .plot img { border-radius: 6px; }
.wide { overflow-x: auto; } table { border-collapse: collapse; width: 100%; min-width: 480px;
  font-size: .9rem; }
th, td { text-align: left; vertical-align: top; padding: 6px 12px 6px 0; overflow-wrap: normal;
  border-bottom: 1px solid var(--grid); } th { color: var(--soft); font-weight: 600; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
.badge { display: inline-block; min-width: 5.2em; text-align: center; border-radius: 4px;
  padding: 0 8px; font-size: .8rem; border: 1.5px solid var(--soft); }
.finding { display: grid; grid-template-columns: 6.5em 1fr; gap: 4px 12px; padding: 8px 0;
  border-bottom: 1px solid var(--grid); } .finding p { margin: 0; max-width: none; }
pre { background: var(--card); padding: 12px; border-radius: 8px; white-space: pre-wrap;
  font-size: .85rem; } summary { cursor: pointer; padding: 6px 0; }
@media (max-width: 560px) { .finding { grid-template-columns: 1fr; } table { min-width: 0; }
  td.number { white-space: normal; } .badge { min-width: 0; }
  body { padding: 0 12px 32px; } }
"""


class Section(NamedTuple):
    """A part of the page: its anchor, heading, and content as HTML."""

    anchor: str
    heading: str
    content: str


# Makes HTML of a text.
Writer = Callable[[object], str]


def _writer(observation: Observation, *, anonymous: bool) -> Writer:
    """Return the writer of a page; an `anonymous` one hides what identifies the recording."""
    path = PurePath(observation.bag)
    names = {observation.bag, path.name, path.stem, *observation.names}
    identifying = [one for one in names if len(one) >= _SHORTEST_NAME]
    if not anonymous or not identifying:
        return lambda text: escape(str(text))
    # A name may contain a shorter one.
    identifying.sort(key=len, reverse=True)
    hidden = re.compile('|'.join(map(re.escape, identifying)))
    return lambda text: escape(hidden.sub('[name]', str(text)))


def page(observation: Observation, version: str, *, images: bool = True) -> str:
    """The report as HTML; without `images` also without positions and names."""
    write = _writer(observation, anonymous=not images)
    sections = [one for one in _sections(observation, write, images) if one.content]
    title = write(PurePath(observation.bag).name) if images else 'a recording'
    links = ''.join(f'<a href="#{one.anchor}">{one.heading}</a>' for one in sections)
    body = ''.join(
        f'<section id="{one.anchor}"><h2>{one.heading}</h2>{one.content}</section>'
        for one in sections
    )
    broken = ''
    if observation.damage:
        text = write(observation.damage)
        broken = (
            '<div class="cards"><div class="wrong"><h2>The recording is damaged</h2>'
            f'<p>{text}</p><p>This page shows what could be read.</p></div></div>'
        )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>Report of {title}</title><link rel="icon" href="data:,">'
        f'<style>{_CSS}</style></head><body><h1>Report of {title}</h1>'
        f'<p class="soft">{_overview(observation, write)}</p>{broken}'
        f'{_cards(observation, write)}<nav>{links}</nav>{body}'
        f'<p class="soft">Made by rs_relpose report, version {write(version)}.</p>'
        '</body></html>\n'
    )


def _sections(observation: Observation, write: Writer, images: bool) -> Iterable[Section]:
    """All sections; one without content is left out."""
    yield Section('findings', 'Findings', _findings(observation.lines, write))
    streams = plots.streams(observation)
    yield Section('streams', 'Streams', _drawings(streams, write))
    inertial = plots.inertial(observation)
    yield Section('imu', 'Gyro and accelerometer', _drawings(inertial, write))
    rates = plots.rates_of(observation)
    clock = [] if rates is None else plots.clock(rates)
    yield Section('clock', 'Images against gyro', _drawings(clock, write))
    maps = _drawings(plots.residual_maps(observation), write)
    tests = _residual_tests(observation, write)
    residuals = maps and f'<p>{_RESIDUALS}</p>{maps}{tests}'
    yield Section('residuals', 'Residuals', residuals)
    yield Section('calibration', 'Calibration', _calibration(observation, write))
    yield Section('pairs', 'Pairs', _pairs(observation, write))
    if images:
        yield Section('frames', 'Frames', _frames(observation))
    yield Section('path', 'Metric path', _path(observation, write, images))


# What the maps show.
_RESIDUALS = (
    'Distances of the matches from what rotation, velocity and readout of their pair predict: '
    'root mean square of the inliers, in pixels at the image centre.'
)

# What the table below them shows.
_TESTS = (
    'Sums of the signed residuals in cells are zero on the average where all parameters are '
    f'right: p below {FAILS_BELOW:g} is a pattern.'
)


def _residual_tests(observation: Observation, write: Writer) -> str:
    """The maps of signed residuals as a table; empty without a cell that counts."""
    known = [one for one in observation.maps if one.tested]
    if not known:
        return ''
    rows = ''.join(
        f'<tr><td>{write(one.name)}</td><td class="number">{one.p:.1g}</td>'
        f'<td>{write(one.labels[one.worst])}</td></tr>'
        for one in known
    )
    return (
        f'<p>{_TESTS}</p><div class="wide"><table>'
        f'<tr><th>map</th><th>p</th><th>least probable cell</th></tr>{rows}</table></div>'
    )


def _overview(observation: Observation, write: Writer) -> str:
    """Length, size and rates in one line."""
    parts = []
    stamps = [times.stamps for times in observation.times.values()]
    if stamps:
        whole = np.concatenate(stamps)
        parts.append(f'{int(np.ptp(whole)) * 1e-9:.1f} s')
    parts += [
        f'{len(times.stamps)} messages ({role.value})' for role, times in observation.times.items()
    ]
    camera = observation.intrinsics
    if camera is not None:
        parts.append(f'{camera.image_width}x{camera.image_height}')
    return write(', '.join(parts) or 'no messages could be read')


def _cards(observation: Observation, write: Writer) -> str:
    """The three questions of a reader, each with an answer."""
    faults = [one for one in observation.lines if one.state is FindingState.WRONG]
    doubts = [one for one in observation.lines if one.state is FindingState.SUSPECT]
    poses = sum(bool(one.pose) for one in observation.pairs)
    usable = f'Yes: {poses} of {len(observation.pairs)} pairs have a pose'
    if is_unusable(observation):
        usable = 'Not as it is' if poses else 'No: no pair has a pose'
    state = 'wrong' if is_unusable(observation) else 'suspect' if doubts else 'ok'
    first = (faults or doubts)[:1]
    counts = (('failure', len(faults)), ('warning', len(doubts)))
    wrong = ', '.join(f'{count} {name}{"s" * (count > 1)}' for name, count in counts if count)
    detail = ''.join(f'{one.code.value}: {one.message}. {one.fix}' for one in first)
    return (
        '<div class="cards">'
        f'<div class="{state}"><h2>Can I use this recording?</h2><p><strong>{usable}</strong></p>'
        f'<p>{_withheld(observation)}</p></div>'
        f'<div class="{"wrong" if faults else state}"><h2>What is wrong?</h2>'
        f'<p><strong>{wrong or "No failure, no warning"}</strong></p><p>{write(detail)}</p></div>'
        f'<div class="{state}"><h2>What do I get?</h2>{_gains(observation, write)}</div></div>'
    )


def _withheld(observation: Observation) -> str:
    if not observation.withheld:
        return ''
    return (
        f'A node would withhold {observation.withheld} of the poses, because a configured '
        'parameter contradicts the data. They are shown here all the same.'
    )


def _gains(observation: Observation, write: Writer) -> str:
    """Errors against the truth, or sigmas, and the state of the metric path."""
    known = [one for one in observation.pairs if one.pose]
    lines = []
    errors = [one.errors for one in known if one.errors is not None]
    if errors:
        lines += [
            _error('rotation', [one.rotation_error for one in errors]),
            _error('direction of translation', [one.translation_error for one in errors]),
        ]
    elif known:
        sigmas = [tables.rotation_sigmas(one.pose.covariance) for one in known]
        sizes = sorted(math.hypot(*one) for one in sigmas)
        median = math.degrees(sizes[len(sizes) // 2])
        lines.append(f'rotations to {median:.2g} deg (1 sigma, median)')
    path = observation.path
    if path.path is not None:
        lines.append(f'a metric path, at its end to {path.sigma:.2g} m (1 sigma)')
    elif known:
        lines.append(f'no metric path: {path.reason}')
    return ''.join(f'<p>{write(line)}</p>' for line in lines) or '<p>Nothing yet</p>'


def _error(name: str, values: Sequence[float]) -> str:
    """Errors [deg] of the pairs in a line."""
    median, most = median_and_p90(values)
    return f'error of the {name}: {median:.2g} deg (median), {most:.2g} deg (90 %)'


# The states of findings in the order in which a page has them.
_ORDER = (FindingState.WRONG, FindingState.SUSPECT, FindingState.UNKNOWN, FindingState.OK)


def _findings(lines: Sequence[Line], write: Writer) -> str:
    """Failures and warnings, then the rest, folded."""
    of_state: dict[FindingState, list[Line]] = {state: [] for state in _ORDER}
    for line in lines:
        of_state[line.state].append(line)
    wrong, suspect, *others = of_state.values()
    shown = ''.join(_finding(line, write) for line in (*wrong, *suspect))
    shown = shown or '<p>No failure and no warning.</p>'
    rest = list(chain.from_iterable(others))
    if not rest:
        return shown
    counts = Counter(line.state.verdict for line in rest)
    summary = ', '.join(f'{count} {verdict}' for verdict, count in counts.items())
    folded = ''.join(_finding(line, write) for line in rest)
    return f'{shown}<details><summary>The others: {summary}</summary>{folded}</details>'


def _finding(line: Line, write: Writer) -> str:
    candidates = [code.value for code in line.finding.candidates if code is not line.code]
    more = f'<p>{write(line.fix)}</p>' if line.fix else ''
    if candidates:
        more += f'<p class="soft">may also be: {write(", ".join(candidates))}</p>'
    return (
        f'<div class="finding"><div>{_badge(line.state)}</div><div>'
        f'<p><strong>{write(line.code.value)}</strong>: {write(line.message)}</p>'
        f'{more}</div></div>'
    )


def _badge(state: FindingState) -> str:
    return f'<span class="badge {state.value}">{state.verdict}</span>'


def _drawings(drawings: Sequence[Drawing], write: Writer) -> str:
    """Drawings side by side, each with its caption."""
    if not drawings:
        return ''
    shown = ''.join(
        f'<div class="plot">{one.svg}<p class="caption">{write(one.caption)}</p></div>'
        for one in drawings
    )
    return f'<div class="drawings">{shown}</div>'


def _calibration(observation: Observation, write: Writer) -> str:
    """Configured against estimated values, and the calibration of what was not configured."""
    rows = ''.join(_row(one, write) for one in observation.health.findings if one.estimated)
    table = ''
    if rows:
        heads = ''.join(
            f'<th>{name}</th>' for name in ('parameter', 'state', 'configured', 'estimated')
        )
        table = f'<div class="wide"><table><tr>{heads}</tr>{rows}</table></div>'
    found = observation.completion.found
    if found is None or observation.intrinsics is None:
        return table
    lines = '\n'.join(calibration.report(found, observation.intrinsics.global_shutter_camera()))
    text = 'Not everything was configured. A calibration of this recording, used for this page:'
    return f'{table}<p>{text}</p><pre>{write(lines)}</pre>'


def _row(finding: Finding, write: Writer) -> str:
    unit, scale = ('ms', 1e3) if finding.unit == 's' else (finding.unit, 1.0)
    configured = ', '.join(f'{scale * value:.4g}' for value in finding.configured)
    estimated = with_sigma([scale * value for value in finding.estimated], finding.sigma, scale)
    return (
        f'<tr><td>{write(finding.code.value)}</td><td>{_badge(finding.state)}</td>'
        f'<td class="number">{configured} {write(unit)}</td>'
        f'<td class="number">{estimated} {write(unit)}</td></tr>'
    )


def with_sigma(values: Sequence[float], sigma: float | None, scale: float) -> str:
    """Values with as many decimals as two digits of their sigma have, times `scale`."""
    if sigma is None or not 0.0 < sigma < math.inf:
        doubt = '' if sigma is None else f' &plusmn; {scale * sigma:.2g}'
        return ', '.join(f'{value:.4g}' for value in values) + doubt
    decimals = max(0, 1 - math.floor(math.log10(scale * sigma)))
    numbers = ', '.join(f'{value:.{decimals}f}' for value in values)
    return f'{numbers} &plusmn; {scale * sigma:.{decimals}f}'


def _pairs(observation: Observation, write: Writer) -> str:
    """Numbers of the pairs, reasons of those without a pose, errors and sigmas."""
    if not observation.pairs:
        problem = observation.completion.problem
        return f'<p>No pair was estimated. {write(problem)}</p>'
    statuses = Counter(one.pose.status.value for one in observation.pairs)
    text = ', '.join(f'{count} {status}' for status, count in statuses.most_common())
    unused = [f'{reason} ({count})' for reason, count in observation.unused.items()]
    lines = [*lines_without_pose(observation), *unused[:5]]
    listed = ''.join(f'<li>{write(line)}</li>' for line in lines)
    listing = f'<ul>{listed}</ul>' if listed else ''
    drawings = _drawings(plots.pairs(observation.pairs), write)
    return (
        f'<p>{len(observation.pairs)} pairs of {observation.frames} frames: {write(text)}.</p>'
        f'{listing}{drawings}'
    )


def lines_without_pose(observation: Observation) -> Iterable[str]:
    """A line for each status without a pose, with the most frequent reason."""
    by_status: dict[str, Counter[str]] = {}
    for one in observation.pairs:
        if not one.pose:
            reasons = by_status.setdefault(one.pose.status.value, Counter())
            reasons[one.pose.reason] += 1
    for status, reasons in by_status.items():
        reason, _ = reasons.most_common(1)[0]
        such_as = ', such as' if len(reasons) > 1 else ''
        yield f'{status} ({reasons.total()}){such_as}: {reason}'


def _frames(observation: Observation) -> str:
    """The current images of some pairs, with their matches."""
    shown = []
    for number, pair in enumerate(observation.shown):
        if pair.image2 is None:
            continue
        quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        _, coded = cv2.imencode('.jpg', draw_pair(pair), quality)
        text = b64encode(coded.tobytes()).decode()
        source = f'data:image/jpeg;base64,{text}'
        alt = f'Frame {number + 1} of {len(observation.shown)} with the matches of its pair'
        shown.append(f'<div class="plot"><img alt="{alt}" src="{source}"></div>')
    if not shown:
        return ''
    text = (
        'A line leads from the place of a point in the reference frame to its place now. '
        'Its colour is the time of its row (bar on the left); matches that disagree are cyan.'
    )
    return f'<p>{text}</p><div class="drawings">{"".join(shown)}</div>'


def _path(observation: Observation, write: Writer, images: bool) -> str:
    """The metric path, or why there is none."""
    found = observation.path
    if found.path is None:
        return f'<p>None: {write(found.reason)}.</p>' if observation.pairs else ''
    lines = [f'sigma of the last position {found.sigma:.3g} m']
    if errors := found.path.errors:
        lines.append(
            f'error of the path (ATE) {errors.ate_m:.3g} m over {errors.length_m:.1f} m, scale '
            f'{100.0 * errors.scale_error:+.2f} %'
        )
    drawings = _drawings(plots.metric_path(observation), write) if images else ''
    return f'<p>{write("; ".join(lines))}</p>{drawings}'
