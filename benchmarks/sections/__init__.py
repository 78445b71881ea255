"""The sections of the report: each measures one thing and returns a `report.Section`."""
