"""Find the pressures: tasks, their nonlinear programs, searches and answers."""
