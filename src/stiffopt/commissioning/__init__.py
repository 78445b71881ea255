"""Commissioning: what a rig's wiring, frames, gauges and dynamics are, found by small steps.

`procedure` moves the arm, `responses` and `timing` evaluate what was seen, `expected` has what the
model expects, `explanation` finds the causes of what is different, `findings` puts them into words
and `record` keeps them.
"""
