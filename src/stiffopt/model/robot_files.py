"""Load robots by name or path: built-in ones and users' files."""

from __future__ import annotations

import difflib
import os
import warnings
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path

from stiffopt.errors import InputError, UnfitWarning, printable, shown
from stiffopt.files import read_file, save_file
from stiffopt.model.description import RobotDescription


@cache
def builtin_robots() -> tuple[str, ...]:
    """Return the names of the robots that come with stiffopt."""
    folder = files("stiffopt").joinpath("robots")
    names = (entry.name for entry in folder.iterdir() if entry.name.endswith(".yaml"))
    return tuple(sorted(name.removesuffix(".yaml") for name in names))


def load_description(
    name_or_path: str | os.PathLike[str], base: str | os.PathLike[str] | None = None
) -> RobotDescription:
    """Return a built-in robot or read a robot file.

    `name_or_path`: text that ends in ``.yaml`` or ``.yml`` or has a path separator is a path, as is
    a `Path`; any other is the name of a built-in robot. `base`: folder from which a relative path
    starts; by default the current one. Raises `InputError`: there is no such built-in robot;
    `FileError`: the file cannot be read or is wrong.

    Warns
    -----
    UnfitWarning
        The calibration missed its own recordings widely.
    """
    if not isinstance(name_or_path, str | os.PathLike):
        raise InputError(f"expected a robot's name or path, not {shown(name_or_path)}")
    text = os.fspath(name_or_path)
    if not isinstance(name_or_path, str) or _is_path(text):
        robot = read_file(Path(base or "") / text, "robot", RobotDescription)
        if robot.calibration is not None and robot.calibration.unfit:
            warnings.warn(
                f"the robot file {printable(text)} is marked as unfit: its calibration missed its "
                "own recordings by more than 10 % of the arm's length; calibrate it again",
                UnfitWarning,
                stacklevel=2,
            )
        return robot
    if text not in builtin_robots():
        near = difflib.get_close_matches(text, builtin_robots(), n=1)
        hint = f"did you mean '{near[0]}'? The" if near else "the"
        raise InputError(
            f"there is no robot '{text}'; {hint} built-in robots are "
            f"{', '.join(builtin_robots())}; the path of a robot file ends in .yaml"
        )
    with as_file(files("stiffopt").joinpath("robots", f"{text}.yaml")) as path:
        return read_file(path, "robot", RobotDescription)


def save_robot(path: str | os.PathLike[str], robot: RobotDescription) -> None:
    """Write a robot file, replacing any that exists; it reads back as its equal.

    Raises
    ------
    FileError
        The file cannot be written.
    """
    save_file(path, "robot", robot)


def robot_path(name_or_path: str, base: str | os.PathLike[str]) -> str:
    """Return a built-in robot's name, or an absolute path, valid in a file of any folder."""
    return str((Path(base) / name_or_path).resolve()) if _is_path(name_or_path) else name_or_path


def _is_path(text: str) -> bool:
    return text.endswith((".yaml", ".yml")) or "/" in text or os.sep in text
