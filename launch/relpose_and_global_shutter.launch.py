"""Start relpose_node and global_shutter_node beside a camera driver.

::

    ros2 launch rs_relpose_ros relpose_and_global_shutter.launch.py camera_namespace:=/camera \
        imu:=/imu/data_raw params_file:=my_camera.yaml

Its arguments are those of relpose.launch.py. Each node decodes compressed images for itself
(docs/any_slam.md).
"""

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

NODES = ('relpose_node', 'global_shutter_node')


def generate_launch_description() -> LaunchDescription:
    """The launch file of relpose_node, once for each node."""
    launch_file = PathJoinSubstitution(
        [FindPackageShare('rs_relpose_ros'), 'launch', 'relpose.launch.py'])
    return LaunchDescription([
        # A group keeps the arguments of one from the other.
        GroupAction([IncludeLaunchDescription(
            launch_file, launch_arguments={'executable': node, 'name': node}.items())])
        for node in NODES])
