"""Recordings of an arm in, the model of this arm out."""
