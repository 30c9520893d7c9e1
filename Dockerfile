# The package on the official image of ROS 2 Jazzy (Ubuntu 24.04), kernels compiled:
#
#   docker build --tag rs_relpose_ros .
#   docker run --rm --network host --ipc host --volume "$PWD:/data" rs_relpose_ros \
#       ros2 launch rs_relpose_ros relpose.launch.py params_file:=/data/my_camera.yaml
#
# Host network and shared memory, as the driver has them. `rs_relpose COMMAND` works, too.
FROM ros:jazzy

# Two dependencies, rosbags and gtsam, come from PyPI, which Ubuntu 24.04 refuses without this.
ENV PIP_BREAK_SYSTEM_PACKAGES=1
WORKDIR /ros2_ws
COPY package.xml src/rs_relpose_ros/
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-pip \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src -y --dependency-types exec \
    && rm -rf /var/lib/apt/lists/*
# For odometry_node. Its metadata asks for pytest >= 9.0.1, which breaks Jazzy's and is never imported.
RUN pip install --no-cache-dir --no-deps 'gtsam>=4.3,<4.4'
COPY . src/rs_relpose_ros
RUN . /opt/ros/jazzy/setup.sh && colcon build --packages-select rs_relpose_ros

ENV PATH=/ros2_ws/install/rs_relpose_ros/lib/rs_relpose_ros:$PATH \
    FASTRTPS_DEFAULT_PROFILES_FILE=/ros2_ws/install/rs_relpose_ros/share/rs_relpose_ros/config/fastdds.xml
ENTRYPOINT ["/bin/bash", "-c", "source /ros2_ws/install/setup.bash && exec \"$@\"", "--"]
CMD ["ros2", "launch", "rs_relpose_ros", "relpose.launch.py", "--show-args"]
