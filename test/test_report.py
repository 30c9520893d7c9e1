"""The page of `rs_relpose report`: its content, damaged bags, and how a browser shows it."""

from dataclasses import replace
from html.parser import HTMLParser
import math
from pathlib import Path
import re
import time

from conftest import BUNDLED_PARAMETERS, ROOT
import numpy as np
import pytest

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli import main as command_line
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.report.page import lines_without_pose, page, with_sigma
from rs_relpose_ros.report.plots import thinned
from rs_relpose_ros.report.residuals import epipolar_residuals, map_of, rates_compared
from rs_relpose_ros.report.run import is_unusable, nothing_of, Observation, observe

BAG = ROOT / 'bags' / 'hand_held'
SECTIONS = {
    'findings',
    'streams',
    'imu',
    'clock',
    'residuals',
    'calibration',
    'pairs',
    'frames',
    'path',
}


@pytest.fixture(scope='module')
def observation() -> Observation:
    with open_bag(BAG) as bag:
        parameters = read_parameters(BUNDLED_PARAMETERS, [])
        return observe(bag, bag.choose_topics({}), parameters)


@pytest.fixture(scope='module')
def shown(observation: Observation) -> str:
    return page(observation, '0.4.0')


@pytest.fixture(scope='module')
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first third of the bundled bag, as after a copy that was interrupted."""
    data = (BAG / 'hand_held.mcap').read_bytes()
    path = tmp_path_factory.mktemp('damaged') / 'cut.mcap'
    path.write_bytes(data[: len(data) // 3])
    return path


class Elements(HTMLParser):
    """Names, identifiers and addresses of all elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.ids: list[str] = []
        self.targets: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        for name, value in attributes:
            if name == 'id':
                self.ids.append(value)
            elif name in ('href', 'src', 'xlink:href'):
                self.targets.append(value)


def test_a_page_has_everything_and_loads_nothing(observation, shown):
    text = shown
    elements = Elements(text)
    assert SECTIONS <= set(elements.ids)
    assert len(elements.ids) == len(set(elements.ids))
    assert 'script' not in elements.tags
    assert all(one.startswith(('#', 'data:')) for one in elements.targets)
    anchors = {one[1:] for one in elements.targets if one.startswith('#')}
    assert anchors <= set(elements.ids)
    assert 'url(http' not in text and '@import' not in text
    assert 'Yes: 27 of 30 pairs have a pose' in text
    assert len(text) < 5e6
    assert not is_unusable(observation)


def test_without_images_nothing_identifies_the_recording(observation, shown):
    named = replace(observation, bag='/home/somebody/hand_held')
    text = page(named, '0.4.0', images=False)
    assert 'img' not in Elements(text).tags
    for name in ('hand_held', '/camera', '/imu', 'somebody', 'The metric path from above'):
        assert name not in text
        assert name in shown or name == 'somebody'
    assert '[name]' in text


def test_residuals_are_those_of_the_estimate(observation):
    """The approximation of the page against the exact residuals of the estimator."""
    known = [one.pose.diagnostics.residual_rms for one in observation.pairs if one.pose]
    drawn = [float(np.sqrt((one.residuals**2).mean())) for one in observation.residuals]
    assert len(known) == len(drawn) == 27
    assert np.median(np.array(drawn) / known) == pytest.approx(1.0, abs=0.1)


def test_residuals_of_a_wrong_pose_are_large(observation):
    pair = next(one for one in observation.shown if one.pose)
    use = pair.pose.inliers
    right = np.median(epipolar_residuals(pair, 450.0)[use])
    wrong = replace(pair, pose=replace(pair.pose, t=np.roll(pair.pose.t, 1)))
    assert np.median(epipolar_residuals(wrong, 450.0)[use]) > 5.0 * right


@pytest.mark.parametrize('offset', [-0.031, 0.0, 0.012])
def test_the_correlation_is_best_at_the_offset(offset):
    """Gyro of a known motion, stamped `offset` seconds after the images."""
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 20.0, 0.005)
    waves = rng.uniform(0.5, 6.0, (3, 4)), rng.uniform(0.0, 6.0, (3, 4))

    def angle(t):
        speeds, phases = waves
        return np.sin(speeds * t[:, None, None] + phases).sum(axis=2)

    gyro = np.gradient(angle(times), times, axis=0)
    ends = np.arange(1.0, 19.0, 0.1)
    by_images = angle(ends) - angle(ends - 0.1)
    stamps_ns = np.round(1e9 * ends).astype(np.int64)
    gyro_ns = np.round(1e9 * (times + offset)).astype(np.int64)
    rates = rates_compared(
        [int(stamp - gyro_ns[0]) for stamp in stamps_ns],
        [0.1] * len(ends),
        by_images,
        gyro_ns - gyro_ns[0],
        gyro,
    )
    assert rates.scan().best == pytest.approx(offset, abs=3e-4)
    assert rates.scan().correlation.max() > 0.99
    _, parts = rates.drift()
    assert len(parts) == 2
    np.testing.assert_allclose(parts, offset, atol=1e-3)


def test_cells_with_few_matches_are_empty():
    x = np.repeat([0.5, 1.5], [20, 3])
    cells = map_of(x, 0.5 * np.ones(23), 2.0 * np.ones(23), (np.arange(3.0), np.arange(2.0)))
    np.testing.assert_array_equal(cells.rms, [[2.0, np.nan]])


def test_a_thinned_line_keeps_its_extremes():
    values = np.zeros(100_000)
    values[31_415] = 7.0
    at, thin = thinned(np.arange(100_000.0), values)
    assert len(thin) <= 1200
    assert at[np.argmax(thin)] == 31_415


def test_names_of_a_recording_are_texts():
    """A hostile name cannot add an element to the page."""
    text = page(nothing_of(Path('x.mcap'), Parameters(), '<script>alert(1)</script>'), '1')
    assert 'script' not in Elements(text).tags
    assert '&lt;script&gt;' in text


@pytest.mark.parametrize(
    ('values', 'sigma', 'scale', 'shown'),
    [
        ((0.2971,), 8.3e-4, 1e3, '0.30 &plusmn; 0.83'),
        ((450.21, 449.8), 1.74, 1.0, '450.2, 449.8 &plusmn; 1.7'),
        ((1234.0,), 120.0, 1.0, '1234 &plusmn; 120'),
        ((0.123456,), None, 1.0, '0.1235'),
        ((0.123456,), math.inf, 1.0, '0.1235 &plusmn; inf'),
    ],
)
def test_values_have_the_decimals_of_their_sigma(values, sigma, scale, shown):
    assert with_sigma(values, sigma, scale) == shown


def test_pairs_without_a_pose_are_counted_by_status(observation):
    (line,) = lines_without_pose(observation)
    assert line.startswith('PURE_ROTATION (3), such as: a rotation alone leaves 0.0')


def test_a_damaged_bag_has_a_page_that_says_so(damaged, tmp_path, capsys):
    out = tmp_path / 'page.html'
    words = ['report', str(damaged), '--params', str(BUNDLED_PARAMETERS), '--out', str(out)]
    assert command_line.main(words) == command_line.FAILED
    text = out.read_text(encoding='utf-8')
    assert 'The recording is damaged' in text and 'it has no end' in text
    assert 'cut.mcap' in capsys.readouterr().out
    images = int(re.search(r'(\d+) messages \(image\)', text)[1])
    assert 40 <= images <= 62  # a third of 180, in whole chunks
    assert SECTIONS <= set(Elements(text).ids)


@pytest.mark.parametrize('content', [b'\x89MCAP0\r\n', b'SQLite format 3\x00' + b'x' * 100])
def test_a_bag_without_anything_that_can_be_read(content, tmp_path):
    bag = tmp_path / 'empty.mcap'
    out = tmp_path / 'page.html'
    bag.write_bytes(content)
    words = ['report', str(bag), '--out', str(out), '--no-images']
    assert command_line.main(words) == command_line.FAILED
    text = out.read_text(encoding='utf-8')
    assert 'The recording is damaged' in text and 'empty' not in text


@pytest.mark.parametrize(
    ('words', 'problem'),
    [
        (['nowhere.mcap'], 'nowhere.mcap'),
        ([str(ROOT / 'README.md')], 'README.md'),
        ([str(BAG), '--out', '.'], 'is a directory'),
    ],
)
def test_bad_input_is_named_in_one_line_and_nothing_is_written(
    words, problem, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert command_line.main(['report', *words]) == command_line.BAD_INPUT
    error = capsys.readouterr().err
    assert problem in error and error.count('\n') == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(('width', 'scheme'), [(400, 'dark'), (1400, 'light')])
def test_a_browser_shows_the_page(width, scheme, shown, browser, tmp_path):
    file = tmp_path / 'report.html'
    file.write_text(shown, encoding='utf-8')
    context = browser.new_context(
        viewport={'width': width, 'height': 900}, color_scheme=scheme, offline=True
    )
    tab = context.new_page()
    problems: list[str] = []
    tab.on('console', lambda message: problems.append(message.text))
    tab.on('pageerror', lambda error: problems.append(str(error)))
    tab.on('requestfailed', lambda request: problems.append(request.url))
    started = time.monotonic()
    tab.goto(file.as_uri())
    assert problems == []
    assert time.monotonic() - started < 10.0
    # Nothing is wider than the window, every picture has a size, every link leads somewhere.
    assert tab.evaluate('document.documentElement.scrollWidth') <= width
    assert tab.evaluate('[...document.images].length') == 4
    assert tab.evaluate('[...document.images].filter(i => !i.naturalWidth).length') == 0
    boxes = tab.evaluate(
        '[...document.querySelectorAll(".plot > *:first-child")]'
        '.map(e => e.getBoundingClientRect()).map(b => [b.left, b.right, b.height])'
    )
    assert len(boxes) >= 15
    assert all(left >= 0.0 and right <= width and height > 60.0 for left, right, height in boxes)
    links = tab.locator('nav a')
    assert links.count() == len(SECTIONS)
    for number in range(links.count()):
        links.nth(number).click()
        anchor = links.nth(number).get_attribute('href')
        assert tab.url.endswith(anchor)
        assert tab.locator(anchor).is_visible()
    # The letters have the contrast of their scheme.
    ground, ink = (
        sum(map(int, re.findall(r'\d+', color)[:3]))
        for color in tab.evaluate(
            '(s => [s.backgroundColor, s.color])(getComputedStyle(document.body))'
        )
    )
    assert (ground < ink) == (scheme == 'dark') and abs(ground - ink) > 400
    context.close()
