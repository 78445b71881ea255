"""The command line: options, progress, printing, files and exit codes of every command.

A command's options and help stand in the module of its name (`solve`, `map`, `calibrate`), which
imports nothing heavy, so that `--help` is fast. What the command does stands in the modules that
begin with its name (`solve_run`, `map_arm`), which are imported when it runs.
"""
