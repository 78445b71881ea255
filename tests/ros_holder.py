"""A process on the graph that arms, gives a task, and stays; to be killed. Its own participant.

``python ros_holder.py DOMAIN TASK_FILE`` says ``near`` as soon as the tip is within 1 mm, from what
it hears of the tip and the target.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from cyclonedds.core import Policy
from cyclonedds.util import duration

from ros_peer import Peer
from stiffopt.ros.messages import PoseStamped, String, TriggerRequest


def main(domain: str, task: str) -> None:
    peer = Peer(int(domain), alone=True)
    lively = Policy.Liveliness.Automatic(duration(seconds=1))
    tasks = peer.writer("~/set_task", String, lively)
    arm, reset = (peer.client(f"~/{name}", TriggerRequest) for name in ("arm", "reset"))
    tip, target = peer.reader("~/tip", PoseStamped), peer.reader("~/target", PoseStamped)
    while not arm(TriggerRequest()).success:
        reset(TriggerRequest())  # what was killed before may have left a fault
        time.sleep(0.1)
    tasks.write(String(Path(task).read_text(encoding="utf-8")))
    print("asked", flush=True)
    target.wait()

    def near(pose: PoseStamped) -> bool:
        target.take()  # the newest: along a free axis it goes with the tip
        place, goal = pose.pose.position, target.all[-1].pose.position
        return bool(np.linalg.norm([place.x - goal.x, place.y - goal.y, place.z - goal.z]) < 1e-3)

    tip.wait(near, 110)
    print("near", flush=True)
    while True:
        tip.wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
