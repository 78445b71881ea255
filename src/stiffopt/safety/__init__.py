"""What may be commanded, and what happens when it is not: everything between a command and the arm.

Whoever commands an arm does so through this package: limits, the gate that enforces them, the guard
process that vents when its client falls silent, the exclusive claim of a supply, and the monitors
that hold readings against commands.
"""
