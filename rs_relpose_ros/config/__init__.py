"""Every setting: declarations, configuration classes, parameter files."""
