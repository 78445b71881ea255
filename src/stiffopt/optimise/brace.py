"""`Brace`, the key ``brace`` of a task file: objects that the arm may lean on to be stiffer."""

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
    """Objects of the scene that the arm may lean on, and demands on the contacts.

    Attributes
    ----------
    objects : names of objects of the scene that allow contact; the arm leans on one or several.
    margin : push at the tip, in N, both ways along each direction that is maximised, under which no
        contact may be lost.
    contacts : "sliding": contacts slide without resistance, and one is lost where it lifts off; the
        stiffness is a lower bound.  "sticking": they stick, and one that slips is lost too; all
        `objects` must have friction.
    approach : how the equilibrium is reached from rest.  "pressures": with the objects in place;
        "objects": they come to the arm when it is under pressure.
    """

    objects: Annotated[Items[Annotated[str, Field(min_length=1)]], Field(min_length=1)]
    margin: Annotated[Force, Field(gt=0), within(1e6, "N")] = 0.02
    contacts: Grip = "sliding"
    approach: Approach = "pressures"

    def __repr__(self) -> str:
        return f"Brace(on {quoted(self.objects)}, margin {1e3 * self.margin:g} mN)"

    def check(self, task: Task) -> None:
        """Reject a brace that does not suit the goals of its task; see `check_objects`.

        Raises
        ------
        BadKeyError
            With the key and the reason.
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

    def check_objects(self, scene: Scene) -> None:
        """Reject objects that a scene lacks, or that may not be touched as the brace says.

        Raises
        ------
        BadKeyError
            With the key of the brace and the reason.
        """
        known = {item.name: item for item in scene.objects}
        for index, name in enumerate(self.objects):
            key = f"objects.{index}"
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
            if self.contacts == "sticking" and not contact.friction:
                raise BadKeyError(
                    "contacts",
                    f"nothing sticks to '{name}', which has no friction; give its contact a "
                    "'friction' above 0, or take 'contacts: sliding'",
                )


def quoted(names: Iterable[str]) -> str:
    """Quote and join names: ``'post', 'rib'``."""
    return ", ".join(f"'{name}'" for name in names)


def leant_on(scene: Scene, brace: Brace) -> Scene:
    """Return the scene of the objects that a brace names; the same object for the same scene."""
    return _leant_on(SceneKey(scene), brace.objects)


@lru_cache(maxsize=64)
def _leant_on(key: SceneKey, names: tuple[str, ...]) -> Scene:
    return _only(key.scene, [item for item in key.scene.objects if item.name in names])


def kept_clear_of(scene: Scene, brace: Brace) -> Scene | None:
    """Return the scene of the other objects, if any; the same object for the same scene."""
    return _kept_clear_of(SceneKey(scene), brace.objects)


@lru_cache(maxsize=64)
def _kept_clear_of(key: SceneKey, names: tuple[str, ...]) -> Scene | None:
    others = [item for item in key.scene.objects if item.name not in names]
    return _only(key.scene, others) if others else None


def _only(scene: Scene, objects: list[SceneObject]) -> Scene:
    return scene.model_copy(update={"objects": tuple(objects)})
