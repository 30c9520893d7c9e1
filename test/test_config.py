"""The shipped configuration: parameter template, Fast DDS profile, launch file."""

import errno
import os
from pathlib import Path
import re

from conftest import ROOT
import pytest
import yaml

from rs_relpose_lab.live.processes import node_process, Process
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.files import parameter_template, read_parameters
from rs_relpose_ros.config.settings import Parameters, SensorConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS
from rs_relpose_ros.nodes import relpose_node as node_module
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.output_files import beside, written

CONFIG = ROOT / 'config'


def test_template_is_up_to_date_and_holds_every_parameter_at_its_default():
    text = parameter_template()
    assert (CONFIG / 'relpose.yaml').read_text(encoding='utf-8') == text, (
        'run python -m rs_relpose_ros.config.files config/relpose.yaml'
    )
    values = yaml.safe_load(text)['/**']['ros__parameters']
    for name, default, _ in Parameters.declarations():
        if default is None:
            assert f'# {name}:' in text
            assert name not in values
        else:
            assert values.pop(name) == (list(default) if isinstance(default, tuple) else default)
    assert values == {}
    assert read_parameters(CONFIG / 'relpose.yaml') == Parameters()
    assert max(map(len, text.splitlines())) <= 99


@pytest.mark.live
def test_help_lists_the_legal_values_of_every_kind(capsys):
    with pytest.raises(SystemExit):
        node_module.main(['--help'])
    printed = capsys.readouterr().out
    assert re.search(r'^  track_time_offset: .*\. true or false; default False', printed, re.M)
    assert re.search(r'^  stamps_file: .*\. text; default', printed, re.M)
    for name, _, declared in Parameters.declarations():
        assert f'  {name}: {declared.description}' in printed


def test_node_accepts_the_template(ros_domain_id):
    """Rcl's own YAML parser reads it as ours does."""
    with node_process(CONFIG / 'relpose.yaml') as node:
        node.wait_for('waiting for the first image')
        assert 'there is no parameter' not in node.output


@pytest.mark.live
def test_profile_loses_no_big_image(ros_domain_id, monkeypatch):
    """1920x1080 bgr8 at 30 Hz; with the default transports most of them are lost."""
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(CONFIG / 'fastdds.xml'))
    script = ROOT / 'test' / 'big_images.py'
    count = 45
    # A queue of five is a sixth of a second: a busy machine may stop a process for longer.
    for _ in range(4):
        with Process(str(script), 'receive', str(count)) as receiver:
            receiver.wait_for('ready')
            with Process(str(script), 'send', str(count)) as sender:
                assert sender.wait() == 0, sender.output
            assert receiver.wait() == 0, receiver.output
            lost = count - int(receiver.output.split()[-1])
        if lost == 0:
            return
    pytest.fail(f'{lost} of {count} images were lost')


@pytest.mark.parametrize(
    ('name', 'texts'),
    [
        # What the node subscribes to is remapped; the shipped profile, unless the user has one.
        (
            'relpose',
            [
                "'relpose_node'",
                "('image', Path",
                "('camera_info', Path",
                "('imu', argument",
                "('calibration', 'relpose",
                "('accel', argument",
                "'config', 'fastdds.xml'",
            ],
        ),
        *(
            (name, ["'relpose.launch.py'", f"'{nodes}'"])
            for name, nodes in (
                ('global_shutter', 'global_shutter_node'),
                ('relpose_and_global_shutter', 'relpose_node,global_shutter_node'),
                ('odometry', 'relpose_node,odometry_node'),
            )
        ),
    ],
)
def test_launch_files_contain_their_nodes_and_arguments(name, texts):
    """Without ROS's launch, which is in no wheel, by their text alone."""
    text = (ROOT / 'launch' / f'{name}.launch.py').read_text(encoding='utf-8')
    assert [part for part in texts if part not in text] == []


@pytest.mark.parametrize('path', sorted((ROOT / 'launch').glob('*.py')), ids=lambda p: p.stem)
def test_launch_file_describes_its_arguments(path):
    pytest.importorskip('launch_ros', reason='launch is not in the wheels, only on ROS machines')
    names: dict[str, object] = {}
    exec(compile(path.read_text(encoding='utf-8'), str(path), 'exec'), names)  # noqa: S102
    description = names['generate_launch_description']()
    described = {argument.name for argument in description.get_launch_arguments()}
    assert {'camera_namespace', 'params_file', 'fastdds_profile'} <= described


def test_layouts_show_topics_of_the_nodes_by_their_types():
    types = {
        '/relpose_node/debug_image': 'sensor_msgs/msg/Image',
        '/diagnostics': '',
        '/odometry_node/path': 'nav_msgs/msg/Path',
        '/odometry_node/odometry': 'nav_msgs/msg/Odometry',
        **{f'/relpose_node/{name}': msgtype for name, msgtype in PAIR_TOPICS.items()},
    }
    rviz = yaml.safe_load((CONFIG / 'rs_relpose.rviz').read_text())['Visualization Manager']
    shown = {
        display['Topic']['Value']: display['Class'].split('/')[1]
        for display in rviz['Displays']
        if 'Topic' in display
    }
    assert len(shown) >= 4 and shown == {name: types[name].split('/')[-1] for name in shown}
    for value in re.findall(r'"(/[^"]+)"', (CONFIG / 'rs_relpose_foxglove.json').read_text()):
        topic, *fields = value.split('.')
        plotted = message_class(types[topic])() if fields else types[topic]
        for name in fields:
            plotted = getattr(plotted, name)


def test_an_exposure_is_given_once():
    with pytest.raises(InputError, match='exposure_time or exposure_margin'):
        SensorConfig(exposure_time=0.01, exposure_margin=0.008)


# -- files that are complete, or not there -------------------------------------------------------


def test_a_file_has_its_name_once_it_is_complete(tmp_path):
    path = tmp_path / 'table.csv'
    path.write_text('old')
    with pytest.raises(KeyboardInterrupt), written(path) as file:  # as if it were killed
        file.write('half\n')
        assert (tmp_path / 'table.csv.part').read_text() == 'half\n'
        raise KeyboardInterrupt
    assert path.read_text() == 'old'
    with written(path) as file:
        file.write('new\n')
    assert [(item.name, item.read_text()) for item in tmp_path.iterdir()] == [
        ('table.csv', 'new\n')
    ]


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='Linux has a device that is full')
def test_an_error_of_a_full_disk_has_the_path(tmp_path):
    path = tmp_path / 'table.csv'
    (tmp_path / 'table.csv.part').symlink_to('/dev/full')
    with pytest.raises(OSError, match='No space left') as found, written(path) as file:
        file.write('row\n')
    assert found.value.filename == str(path) and not list(tmp_path.iterdir())
    with pytest.raises(OSError, match='No space left') as found, BagWriter(tmp_path / 'bag'):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert found.value.filename == str(tmp_path / 'bag') and not list(tmp_path.iterdir())
    with pytest.raises(OSError, match='No space left') as found, beside(tmp_path / 'out'):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert found.value.filename == str(tmp_path / 'out') and not list(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError) as found, beside(tmp_path / 'out'):  # of an input
        (tmp_path / 'input').read_text()
    assert found.value.filename == str(tmp_path / 'input')
