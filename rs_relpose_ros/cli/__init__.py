"""The command line; each command is a module with ``HELP``, ``add_arguments`` and ``run``."""
