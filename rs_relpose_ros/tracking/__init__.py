"""Features: corners tracked or descriptors matched from a reference keyframe, and its renewal."""
