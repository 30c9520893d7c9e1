"""Bag files, by rosbags: no ROS installation is needed to read or write them."""
