"""The parts of the report: each measures one thing and says it in a `results.Section`."""
