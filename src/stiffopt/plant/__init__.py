"""The plant: a simulated arm, deliberately unlike the optimiser's model, and its devices."""
