"""Options and help of the command `stiffopt ros`."""

from typing import Annotated

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import RigArgument, option

ROS_EPILOG = """\
\b
Examples:
  stiffopt ros rig/sim.yaml
  stiffopt ros my-rig.yaml --distro humble --domain 7 --namespace lab
  stiffopt ros my-rig.yaml --remap '~/tip:=/arm/tip'

\b
Exit codes:
  0    ended by Ctrl-C or a signal; vented, if the daemon was started here
  2    bad input, a missing library, or the daemon has ended
  5    the daemon that was started here ended in the state fault; vented, unless it says otherwise
"""


@with_exit_code
def ros(
    rig: RigArgument,
    distro: Annotated[
        str | None, option("NAME", "humble or jazzy: the distribution of ROS on the graph.")
    ] = None,
    domain: Annotated[
        int | None, option("ID", "DDS domain; else ROS_DOMAIN_ID, else 0.", min=0, max=232)
    ] = None,
    namespace: Annotated[str | None, option("NAMESPACE", "Namespace of the node.")] = None,
    node: Annotated[str | None, option("NAME", "Name of the node.")] = None,
    remap: Annotated[
        list[str] | None, option("FROM:=TO", "Rename a topic; may be repeated.", "--remap", "-r")
    ] = None,
    token_file: Annotated[
        str | None, option("FILE", "The daemon's token, if not where the rig file says.")
    ] = None,
) -> int:
    """Put the arm of RIG on a ROS 2 graph, as a node. ROS need not be installed. Needs the extra
    'ros'.

    Publishes pressures, tip, target, force, frames, markers and diagnostics. If no daemon of RIG
    runs, one is started, and ended with this command. Unless the rig file permits more ('ros:
    {commands: true, interface: eth0}'), the node is reached from this machine alone and accepts
    only the command to vent, because DDS has no token.
    """  # noqa: D205
    from stiffopt.cli.ros_run import run  # here, so that --help waits for no numerics

    given = {"distro": distro, "domain": domain, "namespace": namespace, "node": node}
    return run(rig, given, remap or [], token_file)
