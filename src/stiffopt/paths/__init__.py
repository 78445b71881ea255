"""Plan paths that the tip follows, and motions from one configuration to another."""
