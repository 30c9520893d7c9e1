"""The measurement core: geometry of rows, matches and tracks, robust losses, least squares."""
