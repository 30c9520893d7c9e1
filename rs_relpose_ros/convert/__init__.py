"""Public recordings in their own formats, to be converted to bags."""
