"""Logs of an arm over time (CSV "log v1" and MCAP), and tables of measured stiffness (CSV)."""

from stiffopt.logs.csv_log import LogWriter, read_log, write_log
from stiffopt.logs.log import Body, Log, LogLayout, LogRow
from stiffopt.logs.mcap_log import McapLogWriter, read_mcap_log
from stiffopt.logs.stiffness import (
    StiffnessTable,
    read_stiffness_table,
    write_stiffness_table,
)

__all__ = [
    "Body",
    "Log",
    "LogLayout",
    "LogRow",
    "LogWriter",
    "McapLogWriter",
    "StiffnessTable",
    "read_log",
    "read_mcap_log",
    "read_stiffness_table",
    "write_log",
    "write_stiffness_table",
]
