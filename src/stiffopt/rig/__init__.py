"""One interface to pressure, tracking and force; simulated and real devices behind it alike."""
