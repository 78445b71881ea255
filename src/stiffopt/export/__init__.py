"""Arms for other programs: as a model for MuJoCo, and as a mesh."""
