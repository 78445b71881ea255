"""Opens the studio: what a file is, and the view that shows it."""

from __future__ import annotations

from stiffopt.documents import read_document
from stiffopt.errors import FileError
from stiffopt.model.robot_files import builtin_robots
from stiffopt.optimise.task import load_task
from stiffopt.studio.design import Design
from stiffopt.studio.page import StudioPage
from stiffopt.studio.task_view import TaskView
from stiffopt.studio.workbench import Workbench

_KINDS = ("robot", "task")


class OpenStudio:
    """A page with the view of a file; `close` ends both.

    Attributes
    ----------
    page : StudioPage
    view : what draws on it.
    """

    def __init__(self, page: StudioPage, view: TaskView) -> None:
        self.page, self.view = page, view

    @property
    def url(self) -> str:
        """The address that opens the page."""
        return self.page.url

    def close(self) -> None:
        """End the view, then the page."""
        self.view.close()
        self.page.close()


def open_studio(file: str, *, host: str = "127.0.0.1", port: int = 0) -> OpenStudio:
    """Show a file on a page, and return when it can be opened.

    Parameters
    ----------
    file :
        A built-in robot, a robot file or a task file.
    host, port :
        Where to listen, see `StudioPage`.

    Raises
    ------
    InputError
        The file is wrong or of another kind, or the address cannot be listened on.
    MissingExtraError
        viser is not installed.
    """
    design = Design.of_task(load_task(file)) if kind_of(file) == "task" else Design.of_robot(file)
    page = StudioPage(host, port, f"stiffopt studio: {design.description.name}")
    return OpenStudio(page, TaskView(page.server, Workbench(design)))


def kind_of(file: str) -> str:
    """Return what a file is, by its ``format``; what is no path is a robot.

    Raises
    ------
    FileError
        It cannot be read, or is nothing that the studio shows.
    """
    if file in builtin_robots():
        return "robot"
    given = read_document(file).data.get("format")
    kind = given.partition("/")[0].removeprefix("stiffopt-") if isinstance(given, str) else ""
    if kind not in _KINDS:
        known = ", ".join(_KINDS[:-1]) + f" or {_KINDS[-1]}"
        raise FileError(file, f"is nothing that the studio shows; expected a {known} file")
    return kind
