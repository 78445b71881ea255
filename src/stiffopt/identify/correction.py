"""Correct the errors that logs share, as `stiffopt.identify.hypotheses` finds them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.identify.detection import idle_channels
from stiffopt.identify.frames import FrameComparer, Misfit, MovedFrame, OtherChannels
from stiffopt.identify.hypotheses import Comparer, Found, Hypothesis, best_lines, found_wrong
from stiffopt.identify.settings import DETECTION
from stiffopt.identify.setup import Setup
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS
from stiffopt.model.description import Recordings
from stiffopt.registration import Placement


def put_right(setup: Setup) -> Setup:
    """Return the setup with faults of the recordings corrected where the evidence is overwhelming.

    After each correction it looks again for another fault. A remark in `found` reports each, and
    each channel that does nothing.
    """
    comparer, lines = _comparer(setup), set[int]()
    for _ in range(DETECTION.faults):
        again = "with that corrected, " if setup.found else ""
        found = found_wrong(comparer, setup.description, setup.settings.keep)
        corrected = setup if found is None else _under(setup, found.hypothesis, comparer.low)
        frame = _moved_frame(setup, found)
        if isinstance(frame, OtherChannels | Misfit):  # which is not corrected
            setup = replace(setup, found=(*setup.found, again + _told(frame, setup)))
            break
        if frame is not None:
            recordings = frame.motion.applied(setup.recordings)
            corrected = Setup.of(setup.description, recordings, setup.tables, setup.settings)
            told = f"{frame.told(setup.recordings)}; --keep axes leaves it as it was recorded"
        elif found is not None:
            told = (
                f"{found.hypothesis.told(setup.description, [e.name for e in setup.recordings])}; "
                f"the robot file's arm then misses the tip by {found.then * 1e3:.1f} mm instead of "
                f"{found.as_is * 1e3:.1f} mm, however soft it is; --keep {found.hypothesis.kind} "
                "leaves that as it was recorded"
            )
            if found.hypothesis.kind == "lines":
                lines |= {*found.hypothesis.wrong, *found.hypothesis.wrong.values()}
        else:
            break
        setup = replace(corrected, found=(*setup.found, again + told))
        comparer = _comparer(setup)
    return _with_idle_channels(setup, comparer, lines)


def _told(found: OtherChannels | Misfit, setup: Setup) -> str:
    if isinstance(found, Misfit):
        return found.told(setup.recordings)
    return found.told(setup.description, setup.recordings)


def _moved_frame(setup: Setup, found: Found | None) -> MovedFrame | OtherChannels | Misfit | None:
    """Return the motion of some logs that undoes a new definition of their frame or of a body.

    None if there is none, or if a correction that was found otherwise explains the logs about as
    well. Quarter turns of some logs explain them if neither a motion nor other channels in these
    logs fit far better, nor a mirror as well, and if they leave little: a wrong correction is worse
    than none.
    """
    turns = () if found is None else found.hypothesis.turns
    logs = tuple(i for i, turn in enumerate(turns) if turn)
    if len(setup.recordings) < 2 or (found is not None and len(set(turns)) == 1):
        return None
    comparer = FrameComparer(setup)
    if "axes" in setup.settings.keep:
        return comparer.channels_alone()
    frame = comparer.found()
    if found is None:
        return frame
    if len(logs) == len(turns):  # each log is turned, by itself
        return None
    turned = comparer.turned(turns)
    if isinstance(frame, MovedFrame) and frame.score < DETECTION.overwhelming * turned.score():
        return frame
    if isinstance(frame, OtherChannels) and frame.logs == logs:
        channels: OtherChannels | None = frame
    else:
        channels = comparer.other_channels(logs)
    left = turned.left(logs)
    if channels is not None and channels.left < DETECTION.tie * left:
        return channels
    is_mirrored = left > DETECTION.tie * comparer.left_of_mirror(logs)
    if is_mirrored and isinstance(frame, MovedFrame) and frame.motion.kind == "mirror":
        return frame
    then = turned.misfit(logs).left
    is_left = then > DETECTION.off * setup.description.length
    return replace(comparer.misfit(logs), turned=then) if is_mirrored or is_left else None


def _comparer(setup: Setup) -> Comparer:
    length = setup.description.length
    stations = [length if each.at is None else each.at for each in setup.points]
    return Comparer(setup.description, setup.base, stations, setup.recordings)


def _with_idle_channels(setup: Setup, comparer: Comparer, corrected: Collection[int]) -> Setup:
    """Return the setup with a remark on each channel that does nothing.

    Channels (from 0) whose lines were corrected are not judged: their pressures follow others.
    """
    if "lines" in setup.settings.keep:
        return setup
    description = setup.description
    remarks = [
        words + best_lines(comparer, description, k)
        for k, words in idle_channels(description, setup.recordings).items()
        if k not in corrected
    ]
    return replace(setup, found=(*setup.found, *remarks))


def _under(setup: Setup, hypothesis: Hypothesis, low: Array) -> Setup:
    """Return the setup corrected as a hypothesis says.

    The robot file stores an order of channels, and a turn of the axes if all logs share it.
    """
    given = setup.description.recordings or Recordings()
    recordings = hypothesis.applied(setup.recordings, low)
    if hypothesis.kind == "channels":
        columns = given.channels or tuple(range(1, len(hypothesis.sources) + 1))
        given = given.model_copy(update={"channels": tuple(columns[k] for k in hypothesis.sources)})
    elif hypothesis.kind == "axes" and len(set(hypothesis.turns)) == 1:  # of the tracker
        recordings = hypothesis.with_turns(0).applied(setup.recordings, low)
        turn = lie.transform(CUBE_ROTATIONS[hypothesis.turns[0]], np.zeros(3))
        places = {"tracker_in_base": inverse_placement(np.linalg.inv(turn) @ setup.base)}
        registration = given.registration.model_copy(update=places)
        given = given.model_copy(update={"registration": registration})
    description = setup.description.model_copy(update={"recordings": given})
    return Setup.of(description, recordings, setup.tables, setup.settings)


def inverse_placement(transform: Array) -> Placement:
    """Return the inverse of a transform (4, 4), rounded for a file."""
    found = Placement.of(np.asarray(np.linalg.inv(transform), dtype=float))
    return Placement(
        position=tuple(round(x, 8) for x in found.position),
        orientation=tuple(round(q, 8) for q in found.orientation),
    )
