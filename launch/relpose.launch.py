"""Start relpose_node, or other nodes of the package, for a running camera driver.

::

    ros2 launch rs_relpose_ros relpose.launch.py camera_namespace:=/camera imu:=/imu/data_raw \
        params_file:=my_camera.yaml
"""

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

# Environment variable with the Fast DDS profile; the user's own profile has priority.
PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
ARGUMENTS = {
    'namespace': ('', 'namespace of the node'),
    'executable': (
        'relpose_node',
        'nodes to start, separated by commas: relpose_node, global_shutter_node, odometry_node',
    ),
    'name': ('', 'name of a node that is started alone; empty: that of its executable'),
    'camera_namespace': ('/camera', 'namespace of the camera driver'),
    'image': ('image_raw', 'raw image topic, within camera_namespace unless absolute'),
    'camera_info': ('camera_info', 'CameraInfo topic, likewise'),
    'imu': ('/imu/data_raw', 'IMU topic'),
    'accel': ('accel', 'topic of an accelerometer that is published separately from the gyro'),
    'image_transport': ('', 'raw or compressed; empty: as in the parameter file'),
    'params_file': (
        PathJoinSubstitution([FindPackageShare('rs_relpose_ros'), 'config', 'relpose.yaml']),
        'parameter file; without readout_time and quat_cam_imu_xyzw the node calibrates itself',
    ),
    'fastdds_profile': (
        EnvironmentVariable(
            PROFILE,
            default_value=PathJoinSubstitution(
                [FindPackageShare('rs_relpose_ros'), 'config', 'fastdds.xml']
            ),
        ),
        'Fast DDS profile of the node, for images above 512 KB; the driver needs it, too',
    ),
    'rviz': ('false', 'start RViz with the layout of this package'),
    'use_sim_time': ('false', 'clock of log lines and diagnostics; estimates use stamps alone'),
}


def start_nodes(context: LaunchContext) -> list[Action]:
    """The nodes; arguments of the command line override the file's parameters."""
    argument = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    camera = argument['camera_namespace']
    overrides = {
        name: argument[name]
        for name in ('image_transport', 'use_sim_time')
        if argument[name].perform(context)
    }
    profile = argument['fastdds_profile']
    environment = [SetEnvironmentVariable(PROFILE, profile)] if profile.perform(context) else []
    name = argument['name'].perform(context)
    rviz = [
        Node(
            package='rviz2',
            executable='rviz2',
            arguments=[
                '-d',
                PathJoinSubstitution(
                    [FindPackageShare('rs_relpose_ros'), 'config', 'rs_relpose.rviz']
                ),
            ],
        )
    ]
    shown = argument['rviz'].perform(context).lower() == 'true'
    return [
        *environment,
        *(rviz if shown else []),
        *(
            Node(
                package='rs_relpose_ros',
                executable=executable,
                name=name or executable,
                namespace=argument['namespace'],
                output='screen',
                parameters=[argument['params_file'], overrides],
                remappings=[
                    # An absolute path replaces everything before it.
                    ('image', PathJoinSubstitution([camera, argument['image']])),
                    ('camera_info', PathJoinSubstitution([camera, argument['camera_info']])),
                    ('imu', argument['imu']),
                    ('calibration', 'relpose_node/calibration'),
                    ('accel', argument['accel']),
                ],
            )
            for executable in argument['executable'].perform(context).split(',')
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )
