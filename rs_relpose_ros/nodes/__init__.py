"""The live nodes; the only folder that imports rclpy."""
