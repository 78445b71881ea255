"""The command line.

The module named like a command (`solve`, `map`, `calibrate`) defines its options and help. It
imports no numerics, so that `--help` is fast. The modules that begin with its name (`solve_run`,
`map_report`) do the work; they are imported when the command runs. Progress, printing, output
files and exit codes are shared.
"""
