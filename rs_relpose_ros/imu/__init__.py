"""The IMU front end: samples, buffer, rotation by the gyro, direction of gravity."""
