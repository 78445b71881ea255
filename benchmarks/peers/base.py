"""What a peer is, and how one that is not installed is left out."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from stiffopt import Target, Task

Vector = NDArray[np.float64]


class PeerMissingError(Exception):
    """A peer's package is not installed; the text says which."""


class Peer(ABC):
    """A package on one kind of work, for an arm of so many equal segments without gravity.

    Attributes
    ----------
    name : as the tables call it.
    distributions : what has to be installed.
    """

    name: ClassVar[str]
    distributions: ClassVar[tuple[str, ...]]

    def __init__(self, segments: int) -> None:
        self.segments = segments

    @classmethod
    def of(cls, segments: int) -> Self:
        """Prepare the peer for an arm; its one-time work is done here, untimed.

        Raises
        ------
        PeerMissingError
        """
        for name in cls.distributions:
            try:
                version(name)
            except PackageNotFoundError:
                raise PeerMissingError(f"{name} is not installed") from None
        try:
            return cls(segments)
        except ImportError as error:
            raise PeerMissingError(f"{cls.distributions[0]} cannot be imported: {error}") from error


class TaskSolver(Peer):
    """A peer for the full task: reach a position and maximise one directional stiffness."""

    @abstractmethod
    def cold(self, task: Task) -> Vector | None:
        """Pressures (n,) in Pa, knowing nothing of the answer."""

    @abstractmethod
    def remember(self, task: Task) -> Callable[[Target], Vector | None]:
        """Solve a task, untimed; what is returned solves for another target from there."""


def available(kinds: list[type[Peer]], segments: int) -> tuple[list[Peer], dict[str, str]]:
    """Peers that can be had, and why the others cannot, by name."""
    peers: list[Peer] = []
    missing: dict[str, str] = {}
    for kind in kinds:
        try:
            peers.append(kind.of(segments))
        except PeerMissingError as error:
            missing[kind.name] = str(error)
    return peers, missing
