"""Images as if all rows had been seen at once, turned by the gyro to the middle row."""
