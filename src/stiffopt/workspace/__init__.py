"""Workspace maps: where an arm's tip can be, and how stiff it can be made there.

`map_workspace` samples the pressures of an arm (`plan`) and collects the samples in the cells of a
regular grid in space (`table`), with threads or a cluster (`workers`). The result (`map`) can be
stored and resumed (`store`). zarr (extra ``map``) and distributed (extra ``dask``) are imported
only when needed.
"""

from stiffopt.workspace.map import Extreme, WorkspaceMap
from stiffopt.workspace.mapping import map_workspace, open_workspace_map

__all__ = ["Extreme", "WorkspaceMap", "map_workspace", "open_workspace_map"]
