"""`Scene`: objects around an arm, as the key ``scene`` of a file, a file of its own, or in code.

In code::

    post = SceneObject(name="post", sphere={"centre": (0, 0.04, 0.12), "radius": 0.005})
    scene = Scene(clearance=0.002, objects=[post])
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import (
    BeforeValidator,
    Field,
    ValidationInfo,
    create_model,
    model_validator,
)

from stiffopt.documents import read_document
from stiffopt.errors import FileError, InputError, dotted
from stiffopt.files import SourceFile, folder_of, from_document, line_of
from stiffopt.model.description import RobotDescription
from stiffopt.model.obstacle import Obstacle
from stiffopt.model.obstacles import OBSTACLES
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Force, Length, Number, TranslationalStiffness


class AllowedContact(Schema):
    """Whether and how an arm may lean on an object.

    Attributes
    ----------
    allowed : whether the arm may lean on it; tasks may then brace against it or press it.
    max_force : largest force on it, in N, or None for no limit.
    friction : coefficient of friction.
    stiffness : force per depth of a soft object, in N/m, or None: it is rigid.
    """

    allowed: bool = False
    max_force: Annotated[Force, Field(gt=0)] | None = None
    friction: Annotated[Number, Field(ge=0)] = 0.0
    stiffness: Annotated[TranslationalStiffness, Field(gt=0)] | None = None


if TYPE_CHECKING:
    from stiffopt.model.obstacles.box import Box
    from stiffopt.model.obstacles.capsule import Capsule
    from stiffopt.model.obstacles.cylinder import Cylinder
    from stiffopt.model.obstacles.half_space import HalfSpace
    from stiffopt.model.obstacles.inside_tube import InsideTube
    from stiffopt.model.obstacles.mesh import Mesh
    from stiffopt.model.obstacles.sphere import Sphere
    from stiffopt.model.obstacles.trocar import Trocar

    class _Shapes(Schema):
        box: Box | None = None
        capsule: Capsule | None = None
        cylinder: Cylinder | None = None
        half_space: HalfSpace | None = None
        inside_tube: InsideTube | None = None
        mesh: Mesh | None = None
        sphere: Sphere | None = None
        trocar: Trocar | None = None

else:
    _Shapes = create_model(
        "_Shapes", __base__=Schema, **{key: (kind | None, None) for key, kind in OBSTACLES.items()}
    )


class SceneObject(_Shapes):
    """One object of a scene: a name and a shape, under the key of its kind.

    Attributes
    ----------
    name : for messages and results.
    box, capsule, cylinder, half_space, inside_tube, mesh, sphere, trocar : the shape; one of them.
    contact : whether the arm may lean on it, or None: it may not.
    """

    name: Annotated[str, Field(min_length=1)]
    contact: AllowedContact | None = None

    @property
    def shape(self) -> Obstacle:
        """The shape that it has."""
        (found,) = self._given().values()
        return found

    @property
    def may_be_leant_on(self) -> bool:
        """Whether the scene allows the arm to touch this object."""
        return self.contact is not None and self.contact.allowed

    def _given(self) -> dict[str, Obstacle]:
        shapes = ((key, getattr(self, key)) for key in OBSTACLES)
        return {key: shape for key, shape in shapes if shape is not None}

    @model_validator(mode="after")
    def _check(self) -> SceneObject:
        given = list(self._given())
        if not given:
            *keys, last = OBSTACLES
            raise ValueError(f"has no shape; expected the key {', '.join(keys)} or {last}")
        if len(given) > 1:
            raise BadKeyError(
                given[1], f"is the object's second shape, beside {given[0]}; expected one"
            )
        return self


class Scene(Schema):
    """Objects around an arm, in its base frame.

    Attributes
    ----------
    clearance : least distance between the arm's body and each object that tasks keep, in m.
    objects : at least one.
    source : the file of its own that it was read from, or None.
    """

    clearance: Annotated[Length, Field(ge=0)] = 0.0
    objects: Annotated[Items[SceneObject], Field(min_length=1)]
    source: SourceFile = None

    @model_validator(mode="after")
    def _check(self) -> Scene:
        seen: dict[str, int] = {}
        for index, item in enumerate(self.objects):
            if item.name in seen:
                raise BadKeyError(
                    f"objects.{index}.name",
                    f"objects {seen[item.name] + 1} and {index + 1} are both called "
                    f"'{item.name}'; expected a name of its own for each",
                )
            seen[item.name] = index
        return self

    def check_against(
        self, robot: RobotDescription, path: str | os.PathLike[str] | None = None
    ) -> None:
        """Reject a scene that does not suit an arm.

        Parameters
        ----------
        robot :
            The arm.
        path :
            The file that has the scene under its key ``scene``, if there is one.

        Raises
        ------
        InputError
            The arm's base lies within an object or is nearer to it than the clearance, and is not
            mounted on it (see `Obstacle.begin`); a ring or a tube is narrower than the arm; a mesh
            is of another scale. With file, line and key if the scene is from a file.
        """
        for index, item in enumerate(self.objects):
            try:
                item.shape.check_against(robot, self.clearance)
            except BadKeyError as error:
                raise self._error(("objects", index, *error.loc), str(error), path) from None

    def _error(
        self, place: tuple[str | int, ...], reason: str, path: str | os.PathLike[str] | None
    ) -> InputError:
        reason = f"{self.objects[int(place[1])].name}: {reason}"
        if self.source is not None:
            path = self.source
            if line_of(path, *place) is None:
                place = ("scene", *place)
        elif path is not None:
            place = ("scene", *place)
        else:
            return InputError(f"Scene.{dotted(place)}: {reason}")
        return FileError(path, reason, line=line_of(path, *place), key=dotted(place))


class _SceneFile(Schema):
    """A file with its scene under the key ``scene``."""

    scene: Scene


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene file.

    Raises
    ------
    FileError
        With the line and the key of the first mistake.
    MissingExtraError
        It has a mesh, and packages for meshes are missing.
    """
    document = read_document(path)
    if "scene" in document.data:
        scene = from_document(document, "scene", _SceneFile).scene
    else:
        scene = from_document(document, "scene", Scene)
    return scene.model_copy(update={"source": Path(path)})


def _from_file(value: Any, info: ValidationInfo) -> Any:
    """Load a scene that is given as a path."""
    if isinstance(value, str | Path):
        return load_scene(folder_of(info) / value)
    return value


SceneOrFile = Annotated[Scene, BeforeValidator(_from_file, json_schema_input_type=Scene | str)]
"""A scene, or the path of a scene file: in a file relative to its folder."""
