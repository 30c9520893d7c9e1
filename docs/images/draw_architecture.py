"""Draw docs/images/architecture.svg: layers, the way of a pair, the way of a covariance.

Run ``python docs/images/draw_architecture.py`` after a folder or one of the named modules has
moved. The layers are computed from the imports of the package. `test/test_house.py` checks that
the picture is the one of today's code.
"""

import ast
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from xml.sax.saxutils import escape

PACKAGE = Path(__file__).parents[2] / 'rs_relpose_ros'
PICTURE = Path(__file__).with_name('architecture.svg')

# What a folder holds, in a few words.
CONTENTS = {
    'cli': 'commands',
    'nodes': 'ROS 2 nodes (rclpy)',
    'report': 'one page about a recording',
    'offline': 'replay, check, unroll',
    'odometry': 'graph, trajectories, export (gtsam)',
    'calibrate': 'recordings, stored results',
    'calibration': 'model, fit, posterior, findings',
    'bags': 'bag files, converters (rosbags)',
    'messages': 'messages to data and back',
    'pipeline': 'frames, pairs, monitor',
    'estimator': 'pose of a pair',
    'imu': 'buffer, gravity, integration',
    'tracking': 'images, corners, matches',
    'solvers': 'minimal solvers',
    'config': 'parameters',
    'core': 'residuals, losses, least squares',
    'geometry': 'camera, lens, rotations, time',
}

# Steps from top to bottom: what happens, and the module in which it does.
PAIR = (
    ('message: image, IMU, CameraInfo', 'messages/incoming.py'),
    ('frame with its IMU samples', 'pipeline/sequencer.py'),
    ('tracks since the keyframe', 'tracking/klt.py'),
    ('PairProblem: matches, rows, priors', 'pipeline/pair.py'),
    ('two views: sample, refine', 'estimator/estimate.py'),
    ('all frames between: adjust', 'estimator/frames_between.py'),
    ('RelativePose with covariance; findings', 'pipeline/monitor.py'),
    ('message, CSV, graph', 'messages/outgoing.py'),
)
COVARIANCE = (
    ('noise of gyro, accelerometer', 'imu/integration.py'),
    ('noise of the matches', 'core/losses.py'),
    ('weights of the fit', 'estimator/fit.py'),
    ('scatter of groups', 'core/least_squares.py'),
    ('covariance of the optimum', 'estimator/covariance.py'),
    ('frames between replace it', 'estimator/frames_between.py'),
    ('+ doubt of the calibration', 'pipeline/monitor.py'),
    ('published', 'messages/outgoing.py'),
)

WIDTH = 1120
BOX_HEIGHT = 42
GAP = 26
TOP = 48
# Left edge and width of the three panels [px].
LAYERS_AT = 16
LAYERS_WIDTH = 560
PAIR_AT = 600
PAIR_WIDTH = 260
COVARIANCE_AT = 884
COVARIANCE_WIDTH = 220


def imported_folders(folder: Path) -> set[str]:
    """Folders of the package that the modules of a folder import."""
    found = set()
    for path in folder.glob('**/*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [f'{node.module}.{alias.name}'.split('.') for alias in node.names]
                found |= {name[1] for name in names if name[0] == PACKAGE.name}
    return {name for name in found if (PACKAGE / name).is_dir()} - {folder.name}


def levels() -> list[list[str]]:
    """Folders by the longest chain of imports below them, the highest first."""
    imports = {
        path.name: imported_folders(path)
        for path in sorted(PACKAGE.iterdir())
        if (path / '__init__.py').exists()
    }

    @cache
    def height(name: str) -> int:
        return 1 + max(map(height, imports[name]), default=-1)

    rows: list[list[str]] = [[] for _ in range(1 + max(map(height, imports)))]
    for name in imports:
        rows[height(name)].append(name)
    return rows[::-1]


def box(left: float, top: float, width: float, texts: Sequence[str]) -> Iterable[str]:
    """A box with a line of text and a smaller one below."""
    yield f'<rect x="{left:.0f}" y="{top:.0f}" width="{width:.0f}" height="{BOX_HEIGHT}" rx="5"/>'
    middle = left + width / 2
    for text, height, kind in zip(texts, (17, 33), ('name', 'note'), strict=True):
        where = f'x="{middle:.0f}" y="{top + height:.0f}"'
        yield f'<text class="{kind}" {where}>{escape(text)}</text>'


def arrow(x: float, top: float, bottom: float) -> str:
    """An arrow downwards."""
    return f'<path d="M{x:.0f} {top:.0f}V{bottom - 2:.0f}" marker-end="url(#head)"/>'


def chain(
    left: float, width: float, title: str, steps: Sequence[tuple[str, str]]
) -> Iterable[str]:
    """Boxes one below the other, with arrows between."""
    yield f'<text class="title" x="{left + width / 2:.0f}" y="28">{escape(title)}</text>'
    for k, step in enumerate(steps):
        top = TOP + k * (BOX_HEIGHT + GAP)
        yield from box(left, top, width, step)
        if k:
            yield arrow(left + width / 2, top - GAP, top)


def layers() -> Iterable[str]:
    """A row of boxes for each level; each folder imports only from rows below its own."""
    middle = LAYERS_AT + LAYERS_WIDTH / 2
    yield f'<text class="title" x="{middle:.0f}" y="28">Layers: imports point downwards</text>'
    for k, names in enumerate(levels()):
        top = TOP + k * (BOX_HEIGHT + GAP)
        width = min((LAYERS_WIDTH - 10 * (len(names) - 1)) / len(names), 240)
        left = middle - (len(names) * (width + 10) - 10) / 2
        for j, name in enumerate(names):
            yield from box(left + j * (width + 10), top, width, (f'{name}/', CONTENTS[name]))
        if k:
            yield arrow(middle, top - GAP, top)


def picture() -> str:
    """The whole picture."""
    rows = max(len(levels()), len(PAIR), len(COVARIANCE))
    height = TOP + rows * (BOX_HEIGHT + GAP)
    parts = [
        *layers(),
        *chain(PAIR_AT, PAIR_WIDTH, 'The way of a pair', PAIR),
        *chain(COVARIANCE_AT, COVARIANCE_WIDTH, 'The way of a covariance', COVARIANCE),
    ]
    style = (
        'text{font-family:sans-serif;text-anchor:middle;fill:#1a1a1a}'
        '.title{font-size:16px;font-weight:bold}.name{font-size:13px}'
        '.note{font-size:11px;fill:#555}rect{fill:#eef3f8;stroke:#5b7fa6}'
        'path{stroke:#5b7fa6;stroke-width:1.5;fill:none}'
    )
    head = '<marker id="head" markerWidth="8" markerHeight="8" refX="6" refY="3" orient="auto">'
    return '\n'.join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}">',
            f'<style>{style}</style>',
            f'<rect width="{WIDTH}" height="{height}" style="fill:#fff;stroke:none"/>',
            f'<defs>{head}<path d="M0 0L6 3L0 6" /></marker></defs>',
            *parts,
            '</svg>\n',
        ]
    )


if __name__ == '__main__':
    PICTURE.write_text(picture(), encoding='utf-8')
