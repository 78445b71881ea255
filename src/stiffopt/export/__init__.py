"""Export arms to other programs: as a model for MuJoCo, and as a mesh."""
