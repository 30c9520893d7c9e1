"""From frames and IMU samples to keyframe pairs: what the live node and the replay share."""
