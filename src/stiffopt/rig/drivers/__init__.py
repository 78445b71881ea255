"""Drivers: one file per device family, each a thin adapter on a well-kept library."""
