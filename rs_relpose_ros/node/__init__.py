"""The live node; the only sub-package that imports rclpy."""
