"""Rigs: one interface to pressure supply, tracker and force probe, real or simulated."""
