"""Safety: everything between a command and the supply, in the order in which a command passes it.

`rigs` opens a rig whose supply takes goals (`goal`). In real time these go through `guard_client`
and `messages` to the `guard`, a process that owns the supply and vents when its client fails.
There, or in this process on a simulated clock, the `gate` enforces all limits, and `claim` keeps
other programs from the supply. `monitors` compares measured pressures with commands. `vent_line`,
`vent` and `rescue` vent the supply from outside and when the guard is gone.
"""
