"""Other packages, each on work that it can do; one file per peer."""
