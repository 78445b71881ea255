"""The command line: options, progress, printing, files and exit codes of every command.

The module of a command (`solve`, `map`, `calibrate`) has its options and its help. It imports no
numerics, so that `--help` is fast; the modules that begin with its name (`solve_run`, `map_report`)
are imported when the command runs.
"""
