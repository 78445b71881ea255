"""Calibration and validation: the model of one arm from its recordings."""
