"""Motions that undo a new definition of the tracker's frame, or of a tracked body.

Tracking software defines a body by its markers, with an origin and axes as somebody chose them. If
the body that is the frame is defined anew, all poses of later logs are moved alike, ``T X``. If the
tip's body, or another tracked one, is, its poses are moved in its own axes, ``X G``. If no
orientations were recorded, positions may also be those of a left-handed frame. Another scale is no
explanation, since an arm of another length or modulus looks the same; it only keeps a frame from
being told.

Poses are compared by points on the bodies: their origins and, where orientations were recorded,
points on their axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.identify.discrepancy import centres
from stiffopt.identify.hypotheses import moved, turn_text
from stiffopt.identify.recording import FRAME, Recording, Track
from stiffopt.identify.settings import DETECTION
from stiffopt.identify.tracker_faults import CUBE_ROTATIONS, mean_rotation, whole
from stiffopt.model.description import RobotDescription

SHOWN = 5e-4
"""Shortest translation of a frame that is told, in m."""
Tracks = tuple[Track, ...]
"""Poses in the rows of a log, the tip's first, in the frame of the recordings."""
MotionKind = Literal["frame", "mirror", "scale"] | int


@dataclass(frozen=True, eq=False)
class Motion:
    """What undoes a new definition of the frame or of a body in some logs.

    Attributes
    ----------
    logs : indices of the logs.
    kind : "frame", or the index of the track whose body was defined anew; "mirror" or "scale" of
        recordings without orientations.
    turn : (3, 3), a rotation; a mirror is one times -1, a scale one times its factor, and
    shift : (3,), in m. A pose ``X, x`` of the frame becomes ``R X, R x + s``, that of a body
        ``X R, x + X s``.
    """

    logs: tuple[int, ...]
    kind: MotionKind
    turn: Array
    shift: Array

    def applied(self, recordings: Sequence[Recording]) -> list[Recording]:
        """Return the recordings, with those of the logs moved."""
        anew = recordings[0].tracks[self.kind].name if isinstance(self.kind, int) else FRAME
        return [
            replace(each, tracks=self.of(each.tracks), anew=anew) if i in self.logs else each
            for i, each in enumerate(recordings)
        ]

    def of(self, tracks: Tracks) -> Tracks:
        """Return the poses of a log after the motion."""
        if not isinstance(self.kind, int):
            return moved(tracks, self.turn, self.shift)
        own = tracks[self.kind]
        assert own.rotation is not None
        turned = Track(own.name, own.position + own.rotation @ self.shift, own.rotation @ self.turn)
        return (*tracks[: self.kind], turned, *tracks[self.kind + 1 :])

    def told(self, recordings: Sequence[Recording]) -> str:
        """Describe the motion, as the beginning of a sentence."""
        names = ", ".join(recordings[i].name for i in self.logs)
        if self.kind == "mirror":
            return f"the positions of {names} are mirrored: {_mirror_text(self.turn)}"
        words = f"turned {turn_text(self.turn)}"
        if np.linalg.norm(self.shift) > SHOWN:
            words += f" and moved by {np.linalg.norm(self.shift) * 1e3:.0f} mm"
        if not isinstance(self.kind, int):
            return f"the frame of {names} was defined anew: its poses are {words}"
        body = recordings[0].tracks[self.kind].name
        return f"the body '{body}' was defined anew in {names}: it is {words} in its own axes"


def _mirror_text(turn: Array) -> str:
    """Describe which axes a mirror (3, 3) changes, as the end of a sentence."""
    if np.sum(np.diag(turn) > 0.5) == 2:
        return f"{'xyz'[int(np.argmin(np.diag(turn)))]} has the other sign"
    signs = ("-" if row.sum() < 0 else "" for row in turn)
    axes = (f"{sign}{'xyz'[k]}" for sign, k in zip(signs, np.abs(turn).argmax(axis=1), strict=True))
    return f"(x, y, z) should be ({', '.join(axes)})"


NOWHERE = Motion((), "frame", np.eye(3), np.zeros(3))
"""Moves no log."""


# poses --------------------------------------------------------------------------------------------


def of_rows(tracks: Tracks, rows: NDArray[np.intp]) -> Tracks:
    """Return the poses in some rows."""
    return tuple(
        Track(
            each.name,
            each.position[rows],
            None if each.rotation is None else each.rotation[rows],
        )
        for each in tracks
    )


def joined(logs: Sequence[Tracks]) -> Tracks:
    """Return the poses of several logs, one after the other."""
    found = []
    for tracks in zip(*logs, strict=True):
        turns = [each.rotation for each in tracks if each.rotation is not None]
        position = np.concatenate([each.position for each in tracks])
        found.append(Track(tracks[0].name, position, np.concatenate(turns) if turns else None))
    return tuple(found)


def apart(one: Tracks, other: Tracks, length: float) -> Array:
    """Return the RMS distances (N,) of points on the bodies between poses of an arm, in m."""
    between = _points(one, length) - _points(other, length)
    return np.asarray(np.sqrt((between**2).sum(axis=2).mean(axis=1)))


def _points(tracks: Tracks, length: float) -> Array:
    """Return the origins of the bodies, and points on their axes: (N, m, 3)."""
    found = []
    for each in tracks:
        origin = each.position[:, np.newaxis]
        found.append(origin)
        if each.rotation is not None:
            axes = each.rotation.swapaxes(1, 2)
            found.append(origin + DETECTION.frame_lever * length * axes)
    return np.concatenate(found, axis=1)


def distances(one: Tracks, other: Tracks, k: int = 0) -> Array:
    """Return the distances (N,) of a track, by default of the tip, in two poses, in m."""
    return np.asarray(np.linalg.norm(one[k].position - other[k].position, axis=1))


def angles(one: Tracks, other: Tracks, k: int = 0) -> Array:
    """Return the angles (N,) of a track in two poses, in rad; zero if they are not known."""
    own, expected = one[k].rotation, other[k].rotation
    if own is None or expected is None:
        return np.zeros(len(one[k].position))
    cosine = (np.einsum("nij,nij->n", own, expected) - 1) / 2
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


def turned_like(tracks: Tracks, expected: Tracks) -> Tracks:
    """Return poses with that rotation of the cube in each body's axes that is nearest."""
    return tuple(
        own
        if own.rotation is None or other.rotation is None
        else replace(own, rotation=own.rotation @ nearest_cube(own.rotation, other.rotation))
        for own, other in zip(tracks, expected, strict=True)
    )


def nearest_cube(own: Array, expected: Array) -> Array:
    """Return the rotation of the cube that brings rotations (N, 3, 3) nearest to others."""
    between = np.einsum("nji,njk->ik", expected, own)
    return CUBE_ROTATIONS[np.argmax(np.einsum("ij,gji->g", between, CUBE_ROTATIONS))]


def different_poses(pressures: Array, description: RobotDescription) -> NDArray[np.intp]:
    """Return rows of pressures (N, n) that are at different poses of an arm.

    None if there are too few, or if none of them is near rest, where the pose of every arm is
    known: elsewhere a frame could replace a wrong modulus.
    """
    span = float(np.max(np.subtract(description.pressure_max, description.pressure_min)))
    nothing = np.zeros(0, dtype=np.intp)
    if not len(pressures) or np.abs(pressures).max(axis=1).min() > DETECTION.rest * span:
        return nothing
    rows = np.asarray(centres(pressures, DETECTION.apart * span, DETECTION.rows))
    return rows if len(rows) >= DETECTION.poses else nothing


def turning(track: Track) -> NDArray[np.bool_]:
    """Return in which rows (N,) a track's orientation is known."""
    if track.rotation is None:
        return np.zeros(len(track.position), dtype=bool)
    return np.asarray(np.isfinite(track.rotation).all(axis=(1, 2)))


def is_turning(track: Track) -> bool:
    """Return True if the orientation is known in most of the rows in which the position is."""
    seen = whole(track.position)
    return bool(np.sum(turning(track)[seen]) > 0.8 * np.sum(seen))


def in_line(positions: Array) -> bool:
    """Return True if positions (N, 3) lie about on a line.

    They could be turned to fit any other arm, so that a motion has to move all of them.
    """
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return bool(spread[1] < DETECTION.in_line * spread[0])


# the best motions ---------------------------------------------------------------------------------


def best_motions(
    logs: tuple[int, ...],
    recorded: Tracks,
    expected: Tracks,
    length: float,
    *,
    has_orientations: bool,
) -> list[Motion]:
    """Return the motion of each kind that brings the poses of logs nearest to the expected ones.

    Parameters
    ----------
    logs : their indices.
    recorded, expected : poses in all of their rows.
    length : of the arm, in m.
    has_orientations : whether some were recorded, be it in too few rows to be compared.
    """
    found = [frame_motion(logs, recorded, expected, length)]
    turning = [k for k, each in enumerate(recorded) if each.rotation is not None]
    found += [_body_motion(logs, k, recorded[k], expected[k]) for k in turning]
    return found if has_orientations else found + _distortions(logs, recorded, expected)


def frame_motion(
    logs: tuple[int, ...], recorded: Tracks, expected: Tracks, length: float
) -> Motion:
    """Return the motion of all tracks that brings them nearest to the expected poses.

    Flips of the bodies may leave all orientations of a log turned by one rotation of the cube.
    """
    target = _points(expected, length).reshape(-1, 3)
    best, least = NOWHERE, np.inf
    turns = any(each.rotation is not None for each in recorded)
    for cube in CUBE_ROTATIONS if turns else CUBE_ROTATIONS[:1]:
        turned = tuple(
            each if each.rotation is None else replace(each, rotation=each.rotation @ cube)
            for each in recorded
        )
        source = _points(turned, length).reshape(-1, 3)
        rotation = nearest_rotation(source, target, DETECTION.known_turn * length)
        shift = target.mean(axis=0) - rotation @ source.mean(axis=0)
        left = float(np.mean((source @ rotation.T + shift - target) ** 2))
        if left < least:
            best, least = Motion(logs, "frame", rotation, shift), left
    return best


def _body_motion(logs: tuple[int, ...], k: int, recorded: Track, expected: Track) -> Motion:
    """Return the motion of a track in its own axes that brings it nearest to the expected."""
    assert recorded.rotation is not None
    assert expected.rotation is not None
    turn = mean_rotation(recorded.rotation.swapaxes(1, 2) @ expected.rotation)
    off = expected.position - recorded.position
    shift = np.einsum("nji,nj->i", recorded.rotation, off) / len(off)
    return Motion(logs, k, turn, shift)


def _moved_by_both(recorded: Tracks, expected: Tracks, length: float) -> Tracks:
    """Return poses after motions of the frame and of the tip's body, each in turn the best one."""
    for _ in range(DETECTION.frame_rounds):
        recorded = frame_motion((), recorded, expected, length).of(recorded)
        recorded = _body_motion((), 0, recorded[0], expected[0]).of(recorded)
    return recorded


def are_both_moved(motion: Motion, recorded: Tracks, expected: Tracks, length: float) -> bool:
    """Return True if frame and tip's body were moved, so that each alone would be told wrongly.

    `motion` is the best motion alone. Where it leaves little, it is enough: a second one would only
    replace what the model has wrong. If it leaves the orientation far off, less has to be gained by
    a second one.
    """
    if recorded[0].rotation is None:
        return False
    after = turned_like(motion.of(recorded), expected)
    left = float(apart(after, expected, length).mean())
    if left <= DETECTION.frame * DETECTION.off * length:
        return False
    both = turned_like(_moved_by_both(recorded, expected, length), expected)
    is_turned = angles(after, expected).mean() > DETECTION.both_angle
    share = DETECTION.tie if is_turned else DETECTION.overwhelming
    return bool(apart(both, expected, length).mean() < share * left)


def _distortions(logs: tuple[int, ...], recorded: Tracks, expected: Tracks) -> list[Motion]:
    """Return the best mirror of positions, which may be shifted, and scale about the origin."""
    own = np.concatenate([each.position for each in recorded])
    wanted = np.concatenate([each.position for each in expected])
    spread = (wanted - wanted.mean(axis=0)).T @ (own - own.mean(axis=0))
    mirror = -CUBE_ROTATIONS[np.argmin(np.einsum("gij,ij->g", CUBE_ROTATIONS, spread))]
    scale = float((own * wanted).sum() / (own**2).sum())
    return [
        Motion(logs, "mirror", mirror, wanted.mean(axis=0) - mirror @ own.mean(axis=0)),
        Motion(logs, "scale", scale * np.eye(3), np.zeros(3)),
    ]


def nearest_rotation(source: Array, target: Array, known: float) -> Array:
    """Return the rotation (3, 3) that turns points (N, 3) to others about their means.

    Turns that spreads of less than `known`, in m, would determine stay small.
    """
    spread = (target - target.mean(axis=0)).T @ (source - source.mean(axis=0))
    u, _, vt = np.linalg.svd(spread + len(source) * known**2 * np.eye(3))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
