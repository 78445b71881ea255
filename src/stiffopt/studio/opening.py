"""Open the studio: a page with the view of a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any

from stiffopt.daemon.address import is_loopback
from stiffopt.errors import InputError
from stiffopt.studio.cloud import check_map
from stiffopt.studio.page import StudioPage
from stiffopt.studio.rig_view import RigView
from stiffopt.studio.rig_watch import RigWatch
from stiffopt.studio.sources import design_of, kind_of, timeline_of
from stiffopt.studio.task_view import TaskView
from stiffopt.studio.timeline_view import TimelineView
from stiffopt.studio.workbench import Workbench
from stiffopt.workspace.mapping import open_workspace_map


class OpenStudio:
    """An open page with its view. `view`: draws on the page."""

    def __init__(self, page: StudioPage, view: Any) -> None:
        self.page, self.view = page, view

    @property
    def url(self) -> str:
        """The address that opens the page."""
        return self.page.url

    def close(self) -> None:
        """End the view, then the page."""
        self.view.close()
        self.page.close()


def open_studio(
    file: str,
    *,
    robot: str | None = None,
    map_file: str | None = None,
    token: str | os.PathLike[str] | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
) -> OpenStudio:
    """Show a file on a page; return when a browser can open it.

    Raises `InputError`: the file is invalid or of another kind, or the address cannot be listened
    on; `MissingExtraError`: viser, or a package that reads the file, is not installed.

    Parameters
    ----------
    file : a built-in robot, or a file of a kind that the studio shows.
    robot : for a file that names none; by default `stiffopt.studio.sources.ROBOT`.
    map_file : a workspace map to show with a robot, a task or a scene.
    token : for a rig: its daemon's token, or the file with it; without it the rig is only shown.
    host, port : address to listen on, see `StudioPage`.
    """
    kind = kind_of(file)
    if map_file is not None and kind not in ("robot", "task", "scene"):
        raise InputError("--map: a map is shown with a robot, a task or a scene only")
    if kind == "rig":
        return _open_rig(file, token, host, port)
    if kind in ("path", "recording"):
        timeline = timeline_of(file, robot)
        page = StudioPage(host, port, f"stiffopt studio: {FilePath(file).name}")
        return OpenStudio(page, TimelineView(page.server, timeline))
    design, found = design_of(file, robot), None
    if map_file is not None:
        found = open_workspace_map(map_file)
        check_map(found, design.description)
    page = StudioPage(host, port, f"stiffopt studio: {design.description.name}")
    return OpenStudio(page, TaskView(page.server, Workbench(design), found))


def _open_rig(file: str, token: str | os.PathLike[str] | None, host: str, port: int) -> OpenStudio:
    """Show a rig; with a token, only this machine may connect."""
    if token is not None and not is_loopback(host):
        raise InputError(
            f"--host: other machines can reach {host}; a studio that commands a rig listens on "
            "127.0.0.1 only"
        )
    clients: list[Callable[[], Any]] = []
    watch = RigWatch(file, token, lambda: any(connected() for connected in clients))
    page = StudioPage(host, port, f"stiffopt studio: {FilePath(file).name}")
    clients.append(page.server.get_clients)
    return OpenStudio(page, RigView(page.server, watch))
