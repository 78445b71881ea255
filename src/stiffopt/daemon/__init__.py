"""The daemon `stiffopt run`: the control loop of a rig with its network interface and telemetry.

Commands come in through `service` (HTTP) and `stream` (WebSocket), pass `access` (is the sender
trusted?) and `lease` (does it have control?), and reach the loop through `operations`. The state of
the loop goes out through `reports` (JSON), `topics` and `recording` (Foxglove and MCAP) and
`metrics` (Prometheus). `client` is the other end; `daemon` starts and ends everything.
"""
