"""Commissioning: check a rig's wiring, frames, gauges and dynamics by small steps of each channel.

`procedure` moves the arm, `responses` and `timing` evaluate the measurements, `expected` predicts
them with the model, `explanation` finds the causes of differences, `findings` describes these in
words, `correction` corrects the rig file, and `record` stores the result.
"""
