"""Read closed triangle meshes and compute grids of signed distances from them.

trimesh reads the files and libigl computes distances: that of the nearest triangle, with the sign
of the fast winding number, which is robust against small faults of the mesh.
"""

from __future__ import annotations

import hashlib
import io
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import InputError, os_reason, require_package
from stiffopt.model.compiler import BuildError, cache_directory, write_atomically

_NEAR = 0.025  # m, margin of the fine grid about the surface
_FAR = 0.15  # m, least margin of the coarse grid; at least the largest extent
_CELLS, _COARSE_CELLS = 64, 48  # along the largest extent of the grids
_MOST_POINTS = 4_000_000


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface of triangles, wound so that their normals point outwards.

    `vertices`: (k, 3), in m. `faces`: indices (m, 3) of vertices.
    """

    vertices: Array
    faces: NDArray[np.int64]

    @property
    def extent(self) -> Array:
        """Edges (3,) of its bounding box, in m."""
        return np.asarray(np.ptp(self.vertices, axis=0))

    def distances(self, points: Array) -> Array:
        """Return signed distances (N,) of points (N, 3), negative inside."""
        import igl

        # igl.signed_distance is inexact with this sign: errors are up to 0.1 mm
        far = np.sqrt(igl.point_mesh_squared_distance(points, self.vertices, self.faces)[0])
        inside = igl.fast_winding_number(self.vertices, self.faces, points) > 0.5
        return np.asarray(np.where(inside, -far, far))


@lru_cache(maxsize=256)
def distance_of(surface: Surface, point: tuple[float, ...]) -> float:
    """Return the signed distance of one point (3,), cached: igl reads all triangles first."""
    return float(surface.distances(np.array([point]))[0])


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distances at the corners of cubes."""

    origin: Array  # first corner (3,), in m
    spacing: float  # edge of a cube, in m
    values: NDArray[np.float32]  # (nx, ny, nz), in m

    @property
    def cells(self) -> tuple[int, ...]:
        """Numbers of cubes (3,)."""
        return tuple(n - 1 for n in self.values.shape)


@lru_cache(maxsize=32)
def read_surface(path: Path, changed: int, scale: float) -> Surface:
    """Read an STL or OBJ file.

    `changed`: modification time of the file; part of the cache key. `scale`: length of one unit of
    the file, in m. Raises `InputError`: it cannot be read, is empty or not closed;
    `MissingExtraError`.
    """
    require_package("trimesh", "mesh")
    require_package("libigl", "mesh", "igl")
    import trimesh

    if path.suffix.lower() not in (".stl", ".obj"):
        raise InputError(f"'{path.name}' is neither an .stl nor an .obj file")
    try:
        read = trimesh.load_mesh(path, process=True)
        mesh = trimesh.Trimesh(read.vertices, read.faces, process=True)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces())
    except OSError as error:
        raise InputError(f"'{path}' cannot be read: {os_reason(error)}") from None
    except Exception as error:  # whatever a broken file leads a parser to
        raise InputError(f"'{path}' cannot be read as a mesh: {error}") from None
    _check(mesh, path)
    vertices, faces = np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)
    if mesh.volume < 0:  # wound the wrong way round
        faces = faces[:, ::-1]
    return Surface(np.asfortranarray(vertices * scale), np.asfortranarray(faces))


def _check(mesh: object, path: Path) -> None:
    """Reject a mesh that is not a closed surface."""
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)  # type: ignore[attr-defined]
    if not len(faces):
        raise InputError(f"'{path}' is empty: it has no triangles with an area")
    if not np.isfinite(vertices).all():
        raise InputError(f"'{path}' has coordinates that are not finite")
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    odd = int((counts % 2).sum())
    if odd:
        raise InputError(
            f"'{path}' is not closed: {odd} of its {len(counts)} edges belong to one triangle "
            "only, so there is no inside; expected a mesh that is closed ('watertight')"
        )
    if not mesh.is_winding_consistent:  # type: ignore[attr-defined]
        raise InputError(f"the triangles of '{path}' are not wound alike; make its normals agree")
    size = np.ptp(vertices, axis=0)
    if abs(mesh.volume) < 1e-9 * size.max() ** 3:  # type: ignore[attr-defined]
        raise InputError(f"'{path}' encloses no volume")


@lru_cache(maxsize=16)
def grids_about(surface: Surface, spacing: float) -> tuple[DistanceGrid, DistanceGrid]:
    """Return a fine grid near a surface and a coarse one that reaches farther."""
    extent = float(surface.extent.max())
    far = max(_FAR, extent)
    coarse = max(spacing, (extent + 2 * far) / _COARSE_CELLS)
    return _kept_grid(surface, spacing, _NEAR), _kept_grid(surface, coarse, far)


def usual_spacing(surface: Surface) -> float:
    """Return the default edge of the fine grid's cubes, in m."""
    return (float(surface.extent.max()) + 2 * _NEAR) / _CELLS


def _kept_grid(surface: Surface, spacing: float, reach: float) -> DistanceGrid:
    """Return the grid from the cache folder, or compute it and store it there if possible."""
    low = surface.vertices.min(axis=0) - reach
    shape = np.ceil((surface.extent + 2 * reach) / spacing).astype(int) + 2
    path = None
    with suppress(BuildError):
        path = cache_directory() / f"grid-{_content(surface, spacing, reach)}.npy"
    values = None if path is None else _read(path, shape)
    if values is None:
        values = _measured(surface, low, spacing, shape)
        if path is not None:
            stream = io.BytesIO()
            np.save(stream, values)
            with suppress(OSError):
                write_atomically(path, stream.getvalue())
    return DistanceGrid(low, spacing, values)


def _content(surface: Surface, spacing: float, reach: float) -> str:
    """Return a hash of everything that a grid depends on, for a file name."""
    total = hashlib.sha256(surface.vertices.tobytes())
    total.update(surface.faces.tobytes())
    total.update(f"{spacing!r} {reach!r}".encode())
    return total.hexdigest()[:32]


def _read(path: Path, shape: Array) -> NDArray[np.float32] | None:
    with suppress(OSError, ValueError, EOFError):
        values = np.load(path, allow_pickle=False)
        if values.dtype == np.float32 and values.shape == tuple(shape):
            return np.ascontiguousarray(values)
    return None


def _measured(surface: Surface, low: Array, spacing: float, shape: Array) -> NDArray[np.float32]:
    if int(np.prod(shape)) > _MOST_POINTS:
        raise InputError(
            f"a grid of {spacing * 1e3:.3g} mm about this mesh has more than "
            f"{_MOST_POINTS // 1_000_000} million points; expected a coarser 'resolution'"
        )
    axes = [start + spacing * np.arange(n) for start, n in zip(low, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return surface.distances(points).astype(np.float32).reshape(tuple(shape))
