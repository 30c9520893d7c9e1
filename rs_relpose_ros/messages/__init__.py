"""Between ROS messages and data, by field names: imports no ROS package, so any source will do."""
