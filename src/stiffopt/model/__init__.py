"""What an arm is and does: description, kinematics, compliance, equilibrium."""
