"""The model of an arm: description, kinematics, compliance, equilibrium, clearance, contact."""
