"""The same thing keeps its id from scene to scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magic_core.scene import Scene, SceneObject


class Tracker:
    """Hands ids on from the last scenes.

    An object takes the id of the one it resembles most in place (within ``reach`` metres) and in size (box edges
    within ``growth`` of each other plus 15 mm); a thing not seen for ``memory`` scenes is forgotten, but its number is not given out again.
    """

    def __init__(self, reach: float = 0.10, growth: float = 0.5, memory: int = 10) -> None:
        self.reach, self.growth, self.memory = reach, growth, memory
        self._last: dict[str, tuple[np.ndarray, np.ndarray, int]] = {}
        self._next = 1

    def update(self, scene: Scene) -> Scene:
        """The scene with stable ids; known objects keep theirs."""
        seen = [o for o in scene.objects if o.source == "camera"]
        costs = []
        for i, item in enumerate(seen):
            for name, (centre, extents, _) in self._last.items():
                distance = float(np.linalg.norm(item.world_from_object[:3, 3] - centre))
                change = np.abs(np.sort(item.box_extents) - np.sort(extents))
                if distance < self.reach and np.all(change < 0.015 + self.growth * np.maximum(np.sort(extents), np.sort(item.box_extents))):
                    costs.append((distance + 0.5 * float(change.max()), i, name))
        names: dict[int, str] = {}
        for _, i, name in sorted(costs):
            if i not in names and name not in names.values():
                names[i] = name
        taken = {o.id for o in scene.objects if o.source != "camera"}
        renamed: list[SceneObject] = []
        for i, item in enumerate(seen):
            while i not in names:
                candidate = f"object_{self._next}"
                self._next += 1
                if candidate not in taken:
                    names[i] = candidate
            renamed.append(replace(item, id=names[i]))
        new = {old.id: item.id for old, item in zip(seen, renamed, strict=True)}
        renamed = [replace(item, cut_off=tuple(new.get(by, by) for by in item.cut_off)) for item in renamed]
        self._last = {n: (c, e, age + 1) for n, (c, e, age) in self._last.items() if age + 1 < self.memory}
        for item in renamed:
            self._last[item.id] = (item.world_from_object[:3, 3].copy(), item.box_extents.copy(), 0)
        return replace(scene, objects=(*renamed, *(o for o in scene.objects if o.source != "camera")))
