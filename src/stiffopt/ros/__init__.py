"""The node on a ROS 2 graph, over DDS and without a ROS installation; needs the extra ``ros``.

`stiffopt.ros.node` implements the wire: topics, services and what makes a node visible. `bridge` is
a client of the daemon: it publishes the daemon's state, and forwards commands from the graph. All
limits, checks and the lease are the daemon's.
"""
