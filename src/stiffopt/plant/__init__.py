"""The simulated arm and its devices."""
