"""What the console says where nothing comes out, or few images come in: the reason in force."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from rs_relpose_ros.front_end.sequencer import Refusal

# Time without a result [s] after which the console says why.
PATIENCE = 5.0
# Share of the images whose refusal is the reason why nothing comes out.
_MOST = 0.8
# Images per CameraInfo below which images are lost on the way: drivers publish one for each.
_LOST = 0.7
# Fast DDS loses best-effort messages above this size [bytes] with its default transports: those
# that do not fit into its segment of shared memory.
_BIG = 512 * 1024
_COMPRESSED = '/compressed'


@dataclass(frozen=True, slots=True)
class Silence:
    """What came since the last result, or since the start where there was none."""

    seconds: float = 0.0
    images: int = 0
    refused: Mapping[Refusal, int] = field(default_factory=dict)
    failure: str = ''   # why the last pair or frame gave nothing


class Reason(NamedTuple):
    """`kind`: told once as long as it stays; `text`: the sentence."""

    kind: str
    text: str


def why_no_image(image: str, published: Collection[str]) -> Reason:
    """Why no image comes on a topic; `published`: the topics with images that have a publisher."""
    kind = f'no image on {image}'
    twin = (image.removesuffix(_COMPRESSED) if image.endswith(_COMPRESSED)
            else image + _COMPRESSED)
    if image in published:
        remedy = ('it has a publisher: does its quality of service match, and does the driver '
                  'run?')
    elif twin in published:
        transport = 'compressed' if twin.endswith(_COMPRESSED) else 'raw'
        remedy = f'only {twin} is published: set image_transport:={transport}'
    elif published:
        remedy = (f'these topics with images have publishers: {", ".join(sorted(published))}; '
                  'remap image')
    else:
        remedy = 'no topic with images has a publisher: is the camera driver running?'
    return Reason(kind, f'{kind} for {PATIENCE:g} s; {remedy}')


def why_nothing(silence: Silence) -> Reason:
    """Why images come and nothing comes out."""
    refused = sum(silence.refused.values())
    if refused >= _MOST * silence.images:
        cause = max(silence.refused, key=lambda refusal: silence.refused[refusal])
        return Reason(f'refused: {cause.value}', (
            f'nothing for {PATIENCE:g} s: {refused} of {silence.images} images were refused, '
            f'{silence.refused[cause]} of them as {cause.value}'))
    if silence.failure:
        return Reason(silence.failure.partition(':')[0],
                      f'nothing for {PATIENCE:g} s; the last reason: {silence.failure}')
    return Reason('nothing', f'nothing came of {silence.images} images in {PATIENCE:g} s')


class LostImages:
    """Notices that big images are lost on the way, from what came second by second."""

    def __init__(self) -> None:
        self._totals: deque[tuple[int, int]] = deque(maxlen=round(PATIENCE) + 1)

    def add(self, images: int, camera_infos: int, size: int) -> str:
        """Take the totals after one second more; a sentence where images are lost, else ''.

        `size` is that of an image [bytes].
        """
        self._totals.append((images, camera_infos))
        first_images, first_infos = self._totals[0]
        images, camera_infos = images - first_images, camera_infos - first_infos
        if (len(self._totals) < PATIENCE + 1 or size < _BIG or images >= _LOST * camera_infos
                or images == 0):
            return ''
        return (f'{images / PATIENCE:.0f} images a second of {size / 1e6:.1f} MB come, and '
                f'{camera_infos / PATIENCE:.0f} CameraInfo: Fast DDS loses big messages. Give the '
                'driver and this node the shipped profile, FASTRTPS_DEFAULT_PROFILES_FILE='
                '$(ros2 pkg prefix --share rs_relpose_ros)/config/fastdds.xml; ros2 launch '
                'rs_relpose_ros relpose.launch.py does it for the node')
