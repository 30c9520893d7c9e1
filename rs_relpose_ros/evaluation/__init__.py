"""The experiments of the paper: synthetic figures, and the PennCOSYVIO data set."""
