"""The virtual lab: a simulated arm behind emulated devices that speak the real protocols."""
