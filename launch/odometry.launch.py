"""Start relpose_node and odometry_node, which needs gtsam, for a running camera driver.

::

    ros2 launch rs_relpose_ros odometry.launch.py camera_namespace:=/camera \
        imu:=/imu/data_raw params_file:=my_camera.yaml

Its arguments are those of relpose.launch.py. The parameter imu_position should be set.
"""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """The launch file of relpose_node, with both nodes."""
    return LaunchDescription(
        [
            IncludeLaunchDescription(
                PathJoinSubstitution(
                    [FindPackageShare('rs_relpose_ros'), 'launch', 'relpose.launch.py']
                ),
                launch_arguments={'executable': 'relpose_node,odometry_node'}.items(),
            )
        ]
    )
