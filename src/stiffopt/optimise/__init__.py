"""Which pressures: the task, its nonlinear program, the search and the answer."""
