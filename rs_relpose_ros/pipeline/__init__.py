"""From frames and IMU samples to keyframe pairs: what the live nodes and the replay share."""
