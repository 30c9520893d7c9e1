"""Rotations, camera models, intrinsics, row times and the motion of a frame."""
