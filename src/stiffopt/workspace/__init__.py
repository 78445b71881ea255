"""Maps of the workspace: where the tip can be, and how stiff it can be made there.

`map_workspace` samples the pressures of an arm and gathers the samples in the cells of a regular
grid in space.  zarr (the extra ``map``) and distributed (the extra ``dask``) are imported when
they are needed, not before.
"""

from stiffopt.workspace.map import Extreme, WorkspaceMap
from stiffopt.workspace.mapping import map_workspace, open_workspace_map
from stiffopt.workspace.plan import MapPlan

__all__ = ["Extreme", "MapPlan", "WorkspaceMap", "map_workspace", "open_workspace_map"]
