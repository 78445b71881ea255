"""Measure which errors of a set-up are found in the recordings of simulated arms.

    python benchmarks/setup_faults.py [--first SEED] [--cases N] [--rig NAME ...]
        [--faults NAME ...] [--validate]

Each seed gives another arm of `regions.py`, and another draw of each fault. Channels and lines act
wrongly while the sweeps and two rounds are simulated; the other faults are made in the logs. As
`calibrate` does before its fit, the program then looks for errors and corrects them. With
``--validate``, the robot file is fitted to right sweeps and two rounds, and the fault is in the
third round, as `validate` reads it.

Prints a table in Markdown for each rig. A fault is told *rightly* if its correction, or both of two
faults, and nothing else are told (an order of one log is told without a correction); *in part* if
one of two is, or if a remark or an error only says what is wrong, such as a channel that does
nothing; *wrongly* if anything else is told. "Left" is the share of the misfit to the robot file's
arm, with ``--validate`` of the mean error, that corrections which were told rightly leave.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibration import CASES
from regions import DESIGNED, QUICK, Arm, logs, made
from report import table
from stiffopt import InputError, Log, RobotDescription, calibrate, validate
from stiffopt.identify.correction import put_right
from stiffopt.identify.detection import without_drift
from stiffopt.identify.hypotheses import Hypothesis, turn_text
from stiffopt.identify.setup import Setup, recordings_of
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS

Array = NDArray[np.float64]
Logs = list[tuple[str, Log]]

UNITS = {"kPa": 1e3, "psi": 6894.757, "bar": 1e5}
FITTED = 1 + DESIGNED  # logs: the sweeps and the rounds as in the experiment
LEFT = re.compile(r"(?:misses the tip by|the mean error is) ([\d.]+) mm instead of ([\d.]+) mm")
LIST = re.compile(", (?:and )?(?=segment|the line)")
AGAIN = "with that corrected, "  # how the remark on a further fault begins
MISFIT = "does not fit the other logs"  # of a log with a fault that was not found
MARKS = ("--keep", "look at", "expected Pa")  # of remarks and errors about the set-up
COLUMNS = ("fault", "cases", "rightly", "in part", "wrongly", "nothing", "left, %")


@dataclass(frozen=True)
class Fault:
    """A fault of a set-up, and what should be told of it.

    Attributes
    ----------
    sources : for each channel, the channel (from 0) whose column has its pressures; -1 for none.
        None if the channels are right.
    edited : turns right logs into faulty ones.
    told : what the remarks should contain, one part each, in one of the wordings between bars.
    hints : what a remark or an error may contain that says what is wrong, but corrects nothing.
    rounds : how many rounds are calibrated with.
    """

    sources: tuple[int, ...] | None = None
    edited: Callable[[Logs], Logs] = list
    told: tuple[str, ...] = ()
    hints: tuple[str, ...] = ()
    rounds: int = DESIGNED


# -- faults ----------------------------------------------------------------------------------------


def nothing(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """A right set-up."""
    return Fault()


def lines(robot: RobotDescription, dead: Sequence[int], shared: Sequence[tuple[int, int]]) -> Fault:
    """Lines of some channels are dead; of some pairs the first has the pressure of the second."""
    name, sources = robot.channel_name, list(range(robot.n_pressures))
    told, hints = [], []
    for k in dead:
        sources[k] = -1
        told.append(f"the line of {name(k)} is dead")
        hints.append(f"of {name(k)} does not show")
    for k, other in shared:
        sources[k] = other
        told.append(f"{name(k)} has the pressure of {name(other)}")
        hints.append(f"of {name(k)} does not show")
    return Fault(tuple(sources), told=tuple(told), hints=tuple(hints))


def order(robot: RobotDescription, sources: Sequence[int]) -> Fault:
    """The channels are in another order."""
    name = robot.channel_name
    wrong = [(k, j) for k, j in enumerate(sources) if k != j]
    told = tuple(f"{name(k)} has the column of {name(j)}" for k, j in wrong)
    return Fault(tuple(sources), told=told)


def dead_line(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """One line is dead."""
    return lines(robot, [int(rng.integers(robot.n_pressures))], [])


def shared_line(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """A channel has the pressure of another one."""
    k, other = rng.permutation(robot.n_pressures)[:2].tolist()
    return lines(robot, [], [(k, other)])


def two_lines(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """Two lines are dead or shared, with a third channel."""
    one, other, third = rng.permutation(robot.n_pressures)[:3].tolist()
    if rng.random() < 0.5:
        return lines(robot, [one, other], [])
    return lines(robot, [one], [(other, third)])


def exchange(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """Two channels are exchanged."""
    i, j = rng.permutation(robot.n_pressures)[:2].tolist()
    return order(robot, [{i: j, j: i}.get(k, k) for k in range(robot.n_pressures)])


def cycle(robot: RobotDescription, rng: np.random.Generator, segments: int = 1) -> Fault:
    """The channels of a segment have each other's columns in a circle."""
    sources, first = [], 0
    chosen = rng.permutation(len(robot.segments))[:segments].tolist()
    for number, segment in enumerate(robot.segments):
        own = np.arange(first, first := first + segment.n_channels)
        turn = int(rng.integers(1, len(own))) if number in chosen else 0
        sources += np.roll(own, turn).tolist()
    return order(robot, sources)


def two_orders(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """A circle in one segment, two channels exchanged in another one."""
    found = list(cycle(robot, rng).sources or ())
    first = 0
    for segment in robot.segments:
        own = list(range(first, first := first + segment.n_channels))
        if found[own[0]] == own[0]:
            i, j = rng.permutation(own)[:2].tolist()
            found[i], found[j] = j, i
    return order(robot, found)


def axes(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The tracker's axes are turned in all logs."""
    turn = int(rng.integers(1, 24))
    back = CUBE_ROTATIONS[turn].T
    return Fault(
        edited=lambda right: [(name, moved(log, back)) for name, log in right],
        told=(turned(robot, (turn,) * FITTED),),
    )


def axes_of_one_log(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The body was defined anew in one log, with axes turned by quarter turns."""
    turn, which = int(rng.integers(1, 24)), int(rng.integers(FITTED))
    told = turned(robot, tuple(turn if k == which else 0 for k in range(FITTED)))
    anew = f"its poses are turned {turn_text(CUBE_ROTATIONS[turn])}"  # as `validate` tells it
    return Fault(
        edited=in_one(which, CUBE_ROTATIONS[turn].T), told=(f"{told}|{anew}",), hints=(MISFIT,)
    )


def turned(robot: RobotDescription, turns: tuple[int, ...]) -> str:
    """What is told of turned axes; see `Hypothesis`."""
    names = ["sweeps", *(f"round {k + 1}" for k in range(DESIGNED))]
    sources = tuple(range(robot.n_pressures))
    return Hypothesis("axes", "", sources, turns).told(robot, names)


def another_pose(rng: np.random.Generator) -> tuple[Rotation, Array]:
    """A turn by 20 to 60 degrees and a shift of 20 mm, in any directions."""
    axis, far = rng.normal(size=(2, 3))
    angle = np.radians(rng.uniform(20, 60))
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    return turn, 0.02 * far / np.linalg.norm(far)


def frame_of_one_log(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The frame was defined anew in one log."""
    turn, shift = another_pose(rng)
    changed = in_one(int(rng.integers(FITTED)), turn.as_matrix(), shift)
    return Fault(edited=changed, told=("the frame of",), hints=(MISFIT,))


def body_of_one_log(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The tip's body was defined anew in one log."""
    turn, shift = another_pose(rng)
    which = int(rng.integers(FITTED))
    return Fault(
        edited=lambda right: one_changed(right, which, lambda log: anew(log, turn, shift)),
        told=("the body 'tip' was defined anew",),
        hints=(MISFIT,),
    )


def frame_and_body(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The frame was defined anew in one of five logs, the tip's body in another one."""
    (turn, shift), (own_turn, own_shift) = another_pose(rng), another_pose(rng)
    one, other = rng.permutation(5)[:2].tolist()

    def edited(right: Logs) -> Logs:
        moved = in_one(one, turn.as_matrix(), shift)(right)
        return one_changed(moved, other, lambda log: anew(log, own_turn, own_shift))

    told = ("the frame of", "the body 'tip' was defined anew")
    return Fault(edited=edited, told=told, rounds=4)


def frame_and_body_of_one_log(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """Both were defined anew in one log; only that it does not fit the others is told."""
    (turn, shift), (own_turn, own_shift) = another_pose(rng), another_pose(rng)

    def both(log: Log) -> Log:
        return anew(moved(log, turn.as_matrix(), shift), own_turn, own_shift)

    which = int(rng.integers(FITTED))
    told = ("the frame of", "the body 'tip' was defined anew")
    return Fault(
        edited=lambda right: one_changed(right, which, both),
        told=told,
        hints=(MISFIT, "look at whether"),
    )


def mirrored(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """In one log without orientations z has the other sign."""
    mirror, which = np.array([1.0, 1.0, -1.0]), int(rng.integers(FITTED))
    return Fault(
        edited=positions_times(mirror, which),
        told=("are mirrored",),
        hints=(MISFIT, "look at whether"),
    )


def left_handed(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """One log without orientations has positions in a left-handed frame: axes are exchanged."""
    mirror, which = -CUBE_ROTATIONS[int(rng.integers(24))], int(rng.integers(FITTED))

    def edited(right: Logs) -> Logs:
        without = [(name, replace(log, tip_quaternion=None)) for name, log in right]
        return one_changed(
            without, which, lambda log: replace(log, tip_position=log.tip_position @ mirror.T)
        )

    return Fault(edited=edited, told=("are mirrored",), hints=(MISFIT, "look at whether"))


def left_handed_poses(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The same of a log with orientations, ``M R M'``: that it does not fit is told."""
    mirror, which = -CUBE_ROTATIONS[int(rng.integers(24))], int(rng.integers(FITTED))

    def changed(log: Log) -> Log:
        assert log.tip_quaternion is not None
        rotation = Rotation.from_quat(log.tip_quaternion, scalar_first=True).as_matrix()
        turned = Rotation.from_matrix(mirror @ rotation @ mirror.T)
        return replace(
            log,
            tip_position=log.tip_position @ mirror.T,
            tip_quaternion=turned.as_quat(scalar_first=True),
        )

    return Fault(
        edited=lambda right: one_changed(right, which, changed), hints=(MISFIT, "look at whether")
    )


def scaled(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The positions of one log have another scale, as another arm would have: it is left."""
    scale = float(rng.choice([0.6, 1.3]))
    changed = positions_times(scale * np.ones(3), int(rng.integers(FITTED)))
    return Fault(edited=changed, hints=(MISFIT, "look at whether"))


def positions_times(factors: Array, which: int) -> Callable[[Logs], Logs]:
    """Leave out all orientations, and multiply the positions of one log by factors (3,)."""

    def edited(right: Logs) -> Logs:
        without = [(name, replace(log, tip_quaternion=None)) for name, log in right]
        return one_changed(
            without, which, lambda log: replace(log, tip_position=log.tip_position * factors)
        )

    return edited


def anew(log: Log, turn: Rotation, shift: Array) -> Log:
    """The log with the tip's body turned and shifted (3,) in its own axes."""
    assert log.tip_quaternion is not None
    body = Rotation.from_quat(log.tip_quaternion, scalar_first=True)
    return replace(
        log,
        tip_position=log.tip_position + body.apply(shift),
        tip_quaternion=(body * turn).as_quat(scalar_first=True),
    )


def order_of_one_log(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The channels of a segment have each other's columns in a circle, in one log."""
    found = cycle(robot, rng)
    sources, which = list(found.sources or ()), int(rng.integers(FITTED))

    def reordered(log: Log) -> Log:
        commanded = log.commanded.copy()
        commanded[:, sources] = log.commanded
        return replace(log, commanded=commanded)

    return Fault(
        edited=lambda right: one_changed(right, which, reordered),
        told=found.told,
        hints=(MISFIT,),
    )


def units(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The pressures of all logs have another unit."""
    unit = list(UNITS)[int(rng.integers(len(UNITS)))]
    return Fault(
        edited=lambda right: [
            (name, replace(log, commanded=log.commanded / UNITS[unit])) for name, log in right
        ],
        told=(f"the pressures are in {unit}",),
        hints=(f"the pressures look like {unit}",),
    )


def clocks(robot: RobotDescription, rng: np.random.Generator) -> Fault:
    """The tip of one log is early by 3 to 7 s."""
    by, which = float(rng.uniform(3, 7)), int(rng.integers(FITTED))

    def early(log: Log) -> Log:
        late = [np.interp(log.time - by, log.time, each) for each in log.commanded.T]
        return replace(log, commanded=np.column_stack(late))

    return Fault(edited=lambda right: one_changed(right, which, early), told=("two clocks",))


def moved(log: Log, turn: Array, shift: Sequence[float] | Array = (0.0, 0.0, 0.0)) -> Log:
    """The log with its poses turned (3, 3) and shifted (3,) in the frame of the tracker."""
    assert log.tip_quaternion is not None
    turned = Rotation.from_matrix(turn) * Rotation.from_quat(log.tip_quaternion, scalar_first=True)
    return replace(
        log,
        tip_position=log.tip_position @ turn.T + shift,
        tip_quaternion=turned.as_quat(scalar_first=True),
    )


def one_changed(right: Logs, which: int, change: Callable[[Log], Log]) -> Logs:
    """The logs with one of them changed; the last one if there are fewer."""
    which = min(which, len(right) - 1)
    return [(name, change(log) if k == which else log) for k, (name, log) in enumerate(right)]


def in_one(
    which: int, turn: Array, shift: Sequence[float] | Array = (0.0, 0.0, 0.0)
) -> Callable[[Logs], Logs]:
    """Move the poses of one log."""
    return lambda right: one_changed(right, which, lambda log: moved(log, turn, shift))


FAULTS: dict[str, Callable[[RobotDescription, np.random.Generator], Fault]] = {
    "none": nothing,
    "dead line": dead_line,
    "shared line": shared_line,
    "two lines": two_lines,
    "exchange": exchange,
    "cycle": cycle,
    "two orders": two_orders,
    "axes": axes,
    "axes of one log": axes_of_one_log,
    "frame of one log": frame_of_one_log,
    "units": units,
    "clocks": clocks,
    "body of one log": body_of_one_log,
    "order of one log": order_of_one_log,
    "frame, body of another log": frame_and_body,
    "frame and body of one log": frame_and_body_of_one_log,
    "mirrored log": mirrored,
    "scaled log": scaled,
    "left-handed log": left_handed,
    "left-handed log with orientations": left_handed_poses,
}
ONLY_CALIBRATED = ("axes", "frame, body of another log")  # `validate` sees one log


# -- runs ------------------------------------------------------------------------------------------


@dataclass
class Misconnected(Arm):
    """An arm whose channels have other pressures than those that are recorded."""

    sources: tuple[int, ...] = field(kw_only=True)

    def recorded(self, times: Array, pressures: Array) -> Log:
        """Log of the commands, while `sources` say which of them each channel has."""
        begin, none = self.now, np.zeros(len(pressures))
        log = super().recorded(
            times, np.column_stack([none if k < 0 else pressures[:, k] for k in self.sources])
        )
        commanded = [np.interp(log.time - begin, times, column) for column in pressures.T]
        return replace(log, commanded=np.round(np.column_stack(commanded), -1))


def recorded(rig: str, seed: int, fault: Fault, rounds: slice) -> tuple[RobotDescription, Logs]:
    """The robot file of an arm, and some of its logs, recorded with the fault."""
    robot, arm = made(rig, seed)
    if fault.sources is not None:
        arm = Misconnected(arm.plant, arm.rng, arm.lag, arm.dead_time, sources=fault.sources)
    return robot, fault.edited(list(islice(logs(robot, arm), rounds.stop))[rounds])


def told_in_calibration(rig: str, seed: int, fault: Fault) -> list[str]:
    """What `calibrate` tells of the set-up, without its fit."""
    robot, faulty = recorded(rig, seed, fault, slice(0, 1 + fault.rounds))
    try:
        read = [without_drift(each) for each in recordings_of(robot, faulty, QUICK)]
    except InputError as error:
        return [str(error)]
    own = [remark for each in read for remark in each.remarks]
    return [*own, *put_right(Setup.of(robot, read, (), QUICK)).found]


class Validated:
    """What `validate` tells of a round with a fault, with robot files that are fitted once."""

    def __init__(self) -> None:
        self._fitted: dict[tuple[str, int], RobotDescription] = {}

    def told(self, rig: str, seed: int, fault: Fault) -> list[str]:
        """Remarks on the first round that was not fitted."""
        if (rig, seed) not in self._fitted:
            robot, right = recorded(rig, seed, Fault(), slice(0, FITTED))
            quick = QUICK.quick(is_loaded=any(robot.gravity))
            self._fitted[rig, seed] = calibrate(robot, right, settings=quick).robot
        _, faulty = recorded(rig, seed, fault, slice(FITTED, FITTED + 1))
        try:
            (found,) = validate(self._fitted[rig, seed], faulty, QUICK)
        except InputError as error:
            return [str(error)]
        return list(found.remarks)


def judged(fault: Fault, remarks: Sequence[str]) -> tuple[str, float]:
    """How a fault was told, and the share of the misfit that its corrections leave."""
    told = [each for each in remarks if any(mark in each for mark in MARKS)]
    found = [LEFT.search(each) for each in told]
    shares = [float(each[1]) / float(each[2]) for each in found if each]
    if not told:
        return ("nothing" if fault.told else "rightly"), float("nan")
    known = [words for each in (*fault.told, *fault.hints) for words in each.split("|")]
    parts = [part for each in told for part in LIST.split(each.removeprefix(AGAIN))]
    if not all(any(words in part for words in known) for part in parts):
        return "wrongly", float("nan")
    complete = all(
        any(words in each for each in told for words in wordings.split("|"))
        for wordings in fault.told
    )
    share = float(np.prod(shares)) if shares else float("nan")
    return ("rightly" if complete else "in part"), share


def row(name: str, found: Sequence[tuple[str, float]]) -> tuple[str, ...]:
    """Row of the table."""
    count = Counter(how for how, _ in found)
    left = [100 * share for how, share in found if how == "rightly" and np.isfinite(share)]
    ends = f"{min(left):.0f} to {max(left):.0f}" if left and name != "none" else ""
    return (name, str(len(found)), *(str(count[each]) for each in COLUMNS[2:6]), ends)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first", type=int, default=44000, help="the first of the seeds")
    parser.add_argument("--cases", type=int, default=4, help="arms of each rig")
    parser.add_argument("--rig", nargs="+", choices=list(CASES), default=["sim", "two-segment"])
    parser.add_argument("--faults", nargs="+", choices=list(FAULTS), default=list(FAULTS))
    parser.add_argument("--validate", action="store_true", help="in a log that is only tested")
    given = parser.parse_args()
    told = Validated().told if given.validate else told_in_calibration
    for rig in given.rig:
        rows = []
        for number, name in enumerate(FAULTS):
            found = []
            for seed in range(given.first, given.first + given.cases):
                robot, _ = made(rig, seed)
                few = name == "two orders" and len(robot.segments) < 2
                if name not in given.faults or few or (given.validate and name in ONLY_CALIBRATED):
                    continue
                fault = FAULTS[name](robot, np.random.default_rng([seed, number]))
                remarks = told(rig, seed, fault)
                found.append(judged(fault, remarks))
                said = "\n    ".join(remarks)
                print(f"{rig} {seed}, {name} {fault.told}: {found[-1][0]}\n    {said}",
                      file=sys.stderr, flush=True)  # fmt: skip
            if found:
                rows.append(row(name, found))
        print(f"### {rig}", "", *table(COLUMNS, rows), sep="\n", end="\n\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
