"""Whether what the package was told of camera and IMU agrees with what they show."""
