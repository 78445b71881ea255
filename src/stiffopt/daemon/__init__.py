"""The long-running process around the control loop: interface, telemetry and guard."""
