"""soromox (JAX): forward kinematics and Jacobian of a piecewise constant-strain arm.

Its coordinates are strains, not pressures: per segment two curvatures and the axial stretch
(three like the three channels), so it does less than `Manipulator.tip_pose` and `tip_jacobian`,
which start from pressures. soromox's local x axis runs along the backbone and its base stands
turned by a quarter about it; `position` undoes that, so that the tips can be compared. Double
precision; `jax.jit` and, for batches, `jax.vmap` outside of it; compiled before anything is
timed. JAX may use all cores.
"""

from typing import ClassVar

import numpy as np

from peers import paper
from peers.base import Peer, Vector

COORDINATES = 3  # per segment


class Soromox(Peer):
    """`PCS` with bending and stretch."""

    name: ClassVar[str] = "soromox (JAX)"
    distributions: ClassVar[tuple[str, ...]] = ("soromox", "jax")

    def __init__(self, segments: int) -> None:
        super().__init__(segments)
        import jax

        jax.config.update("jax_enable_x64", True)
        import jax.numpy as jnp
        from soromox.systems.components import LinkSpec
        from soromox.systems.pcs.pcs import PCS
        from soromox.systems.pcs.structures import PCSStructure

        link = LinkSpec.circular(
            length=paper.LENGTH,
            density=1070.0,
            radius=paper.OUTER,
            young_modulus=paper.E0,
            poisson_ratio=0.49,  # 0.5 is refused; of no effect on kinematics
            reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        )
        arm = PCS.from_links(
            [link] * segments,
            structure=PCSStructure(
                strain_selector=jnp.array([False, True, True, True, False, False] * segments),
                scale_rotational_basis_by_length=False,
            ),
        )
        tip = jnp.asarray(segments * paper.LENGTH)

        def both(q: Vector) -> tuple[Vector, Vector]:
            return arm.forward_kinematics_and_jacobian_inertialframe(q, tip)

        self._pose = jax.jit(lambda q: arm.forward_kinematics(q, tip))
        self._both = jax.jit(both)
        self._poses = jax.jit(jax.vmap(lambda q: arm.forward_kinematics(q, tip)))
        self._boths = jax.jit(jax.vmap(both))
        self._ready = jax.block_until_ready

    def coordinates(self, pressures: Vector) -> Vector:
        """Strains (N, 3 segments) at pressures (N, n) in Pa."""
        p = pressures.reshape(-1, 3) / paper.BAR
        E = paper.E0 - paper.SLOPE * np.linalg.norm(pressures.reshape(-1, 3), axis=1)
        stretch = 1 + p @ paper.FORCE / (E * paper.AREA)
        x, y = (p @ paper.MOMENT.T / (E * paper.INERTIA)[:, None]).T
        # soromox's axes (x, y, z) are the arm's (z, x, y); per reference length
        strains = np.stack([x * stretch, y * stretch, stretch - 1], axis=1)
        return strains.reshape(len(pressures), -1)

    def pose(self, q: Vector) -> Vector:
        """Pose (4, 4) of the tip, or poses (N, 4, 4)."""
        return self._ready((self._pose if q.ndim == 1 else self._poses)(q))

    def pose_and_jacobian(self, q: Vector) -> tuple[Vector, Vector]:
        """Pose and Jacobian (6, n) of the tip, or batches of both."""
        return self._ready((self._both if q.ndim == 1 else self._boths)(q))

    def position(self, q: Vector) -> Vector:
        """Tip position (3,) in the arm's axes."""
        x, y, z = np.asarray(self.pose(q))[:3, 3]
        return np.array([y, -x, z])
