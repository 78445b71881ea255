"""The node on a ROS 2 graph, by DDS and without a ROS installation; needs the extra ``ros``.

`stiffopt.ros.node` speaks the wire: topics, services and what makes a node visible. `bridge` is a
client of the daemon as any other: it publishes the state that the daemon tells, and asks for what
others command. All limits, checks and the lease are the daemon's.
"""
