"""The virtual lab: the simulated arm behind real protocol peers."""
