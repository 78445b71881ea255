"""Names in ROS 2: of nodes, namespaces and topics, and their remapping."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from stiffopt.errors import InputError, shown

_WORD = r"[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(rf"(?:~/|/)?{_WORD}(?:/{_WORD})*")


def _checked(name: str, what: str) -> str:
    """Return a name; raise `InputError` if it is invalid in ROS 2."""
    if not _NAME.fullmatch(name) or "__" in name:
        raise InputError(
            f"{what} {shown(name)} is no name of ROS 2: expected words of letters, digits and "
            "single underscores, with '/' between them, such as 'lab/arm_1'"
        )
    return name


@dataclass(frozen=True)
class NodeNames:
    """The full names of a node's topics and services.

    Raises `InputError`: one of them is invalid in ROS 2, or two rules are for the same name.
    """

    node: str  # name of the node
    namespace: str = "/"  # begins with ``/``; ``/`` alone means none
    # names that replace others. Both may be full (``/a``), relative to the namespace (``a``) or to
    # the node (``~/a``)
    remap: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if "/" in _checked(self.node, "the node name"):
            raise InputError(
                f"the node name {shown(self.node)} has a '/'; give a namespace as such"
            )
        namespace = "/" + self.namespace.strip("/")
        if namespace != "/":
            _checked(namespace, "the namespace")
        object.__setattr__(self, "namespace", namespace)
        rules: dict[str, str] = {}
        for old, new in self.remap.items():
            full = self._expanded(_checked(old, "the remapped name"))
            if full in rules:
                raise InputError(f"two names are given for '{full}'")
            rules[full] = self._expanded(_checked(new, "the new name"))
        object.__setattr__(self, "remap", rules)

    def full(self, name: str) -> str:
        """Return the full name of a topic or service, remapped."""
        expanded = self._expanded(name)
        return self.remap.get(expanded, expanded)

    def unused(self, names: Iterable[str]) -> list[str]:
        """Return the remapped names that are not among the node's `names`."""
        known = {self._expanded(name) for name in names}
        return sorted(set(self.remap) - known)

    def _expanded(self, name: str) -> str:
        if name.startswith("/"):
            return name
        parts = [self.namespace.strip("/")]
        if name.startswith("~/"):
            parts, name = [*parts, self.node], name[2:]
        return "/" + "/".join(filter(None, [*parts, name]))


def remap_rules(texts: Iterable[str]) -> dict[str, str]:
    """Read rules such as ``~/tip:=/arm/tip``, as ROS 2 writes them; `InputError` if invalid."""
    rules = {}
    for text in texts:
        old, sign, new = text.partition(":=")
        if not (sign and old and new):
            raise InputError(
                f"{shown(text)} is no remapping; expected one such as '~/tip:=/arm/tip'"
            )
        rules[old] = new
    return rules
