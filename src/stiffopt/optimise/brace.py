"""`Brace`, the part ``brace`` of a task file: to lean on objects of the scene to be stiff."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from stiffopt.model.arm_clearance import SceneKey
from stiffopt.model.contact.equilibrium import Approach, Grip
from stiffopt.model.scene import Scene, SceneObject
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Force, within

if TYPE_CHECKING:
    from stiffopt.optimise.task import Task


class Brace(Schema):
    """Objects of the scene that the arm may lean on, and what the contacts have to hold.

    Attributes
    ----------
    objects : names of objects of the scene that allow contact; the arm leans on one or several.
    margin : push at the tip, both ways along each direction that is maximised, by which no contact
        is lost, in N.
    contacts : sliding, the stiffness is that of contacts that slide without resistance, the lower
        bound, and one is lost where it lifts off; sticking, it is that of contacts that stick where
        their object has friction, and one that slips is lost too.
    approach : how the equilibrium is reached from rest: pressures, with the objects in place, or
        objects, which come to the arm that is under pressure already.
    """

    objects: Annotated[Items[Annotated[str, Field(min_length=1)]], Field(min_length=1)]
    margin: Annotated[Force, Field(gt=0), within(1e6, "N")] = 0.02
    contacts: Grip = "sliding"
    approach: Approach = "pressures"

    def __repr__(self) -> str:
        return f"Brace(on {quoted(self.objects)}, margin {1e3 * self.margin:g} mN)"

    def check(self, task: Task) -> None:
        """Refuse what makes no sense in a task.

        Raises
        ------
        BadKeyError
            It says which key, and why.
        """
        if task.press is not None:
            raise BadKeyError("brace", "cannot be combined with press; remove one of the two")
        goal = task.stiffness
        if goal is None or not goal.maximise:
            raise BadKeyError(
                "brace", "needs stiffness.maximise, the direction in which to be stiff by leaning"
            )
        if any(getattr(each, "kind", None) != "translation" for each in goal.maximise):
            raise BadKeyError(
                "brace",
                "needs a stiffness against translation to maximise, along which its margin is",
            )
        if task.scene is None:
            raise BadKeyError("brace", "needs a scene with the objects to lean on")
        known = {item.name: item for item in task.scene.objects}
        for index, name in enumerate(self.objects):
            key = f"brace.objects.{index}"
            if name in self.objects[:index]:
                raise BadKeyError(key, f"names '{name}' twice")
            if name not in known:
                raise BadKeyError(
                    key, f"there is no object '{name}' in the scene; it has {quoted(known)}"
                )
            contact = known[name].contact
            if contact is None or not contact.allowed:
                raise BadKeyError(
                    key,
                    f"'{name}' may not be touched; its object needs 'contact: {{allowed: true}}'",
                )


def quoted(names: Iterable[str]) -> str:
    """Names as people read them: ``'post', 'rib'``."""
    return ", ".join(f"'{name}'" for name in names)


def leant_on(scene: Scene, brace: Brace) -> Scene:
    """The objects of a scene that a brace names, as a scene; the same one each time."""
    return _leant_on(SceneKey(scene), brace.objects)


@lru_cache(maxsize=64)
def _leant_on(key: SceneKey, names: tuple[str, ...]) -> Scene:
    return _only(key.scene, [item for item in key.scene.objects if item.name in names])


def kept_clear_of(scene: Scene, brace: Brace) -> Scene | None:
    """The other objects, if there are any; the same scene each time."""
    return _kept_clear_of(SceneKey(scene), brace.objects)


@lru_cache(maxsize=64)
def _kept_clear_of(key: SceneKey, names: tuple[str, ...]) -> Scene | None:
    others = [item for item in key.scene.objects if item.name not in names]
    return _only(key.scene, others) if others else None


def _only(scene: Scene, objects: list[SceneObject]) -> Scene:
    return scene.model_copy(update={"objects": tuple(objects)})
