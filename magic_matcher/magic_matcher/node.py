"""The matcher node: answers ``match_contact`` from the latest objects or from images in the request."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node

from magic_core import conversions, devices, diagnostics, qos, strategy
from magic_core import node as nodes
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.rendering import canonical_view
from magic_core.scene import CanonicalView, Scene, SceneObject
from magic_core.strategy import Strategy
from magic_interfaces.msg import CanonicalView as CanonicalViewMsg
from magic_interfaces.msg import SceneObjectArray
from magic_interfaces.srv import MatchContact
from magic_matcher import clear_way, features, global_stage, matching, score
from magic_matcher.cache import Cache
from magic_matcher.features import BACKENDS
from magic_matcher.remembered import Remembered


class MatcherNode(Node):
    """Contacts on new tools by analogy with a demonstration's.

    Service ``match_contact`` (magic_interfaces/MatchContact), subscription ``objects``
    (magic_interfaces/SceneObjectArray, latched).

    Parameters: ``features`` (auto, embedded, dinov2, dift, sd_dino), ``weights`` (hub name or folder,
    for dinov2), ``device`` (auto, cpu, cuda), ``top_k``, ``curvature_weight`` (lambda),
    ``strategies`` (folder; empty: the installed ones), ``cache`` (folder of what is kept
    of references; empty: the user's cache folder; ``none``: memory only).
    """

    def __init__(self) -> None:
        super().__init__("matcher")
        name = nodes.parameter(self, "features", "auto", "feature backend: auto takes dinov2 where weights are named", choices=BACKENDS)
        weights = nodes.parameter(self, "weights", "", "hub name or local folder of DINOv2 or DINOv3 weights")
        device = nodes.parameter(self, "device", devices.AUTO, "torch device of the network; auto: cuda where there is a GPU, else cpu")
        nodes.parameter(
            self, "top_k", 3, "candidates returned for each tool where the request names no number", low=1, high=50, read_only=False
        )
        weight = nodes.parameter(self, "curvature_weight", score.LAMBDA, "lambda of score = s_dino + lambda s_curv", low=0.0, high=10.0)
        self._root = nodes.parameter(self, "strategies", "", "folder of strategies; empty: the installed ones")
        cache = nodes.parameter(
            self, "cache", "", "folder in which prepared references are kept; empty: the user's cache; none: memory only"
        )
        self._matcher = matching.Matcher(features.load(name, weights, device), weight, cache=None if cache == "none" else Cache(cache))
        self._remembered = Remembered(self._matcher)
        self._scene: Scene | None = None
        self._strategies: dict[str, tuple[int, Strategy]] = {}
        self._lock = threading.Lock()
        # Requests run side by side; the objects come in beside them.
        self.create_subscription(
            SceneObjectArray, "objects", self._on_objects, qos.LATCHED, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._warm_up()
        self._answered = self._refused = 0
        self._last = "none yet"
        group = ReentrantCallbackGroup()
        self._service = self.create_service(MatchContact, "match_contact", self._on_match, callback_group=group)
        self._diagnostics = diagnostics.Diagnostics(self, self._report, group)
        self.get_logger().info(
            f"ready: features {self._matcher.backend.name}; waiting for objects on {self.resolve_topic_name('objects')} (requests with images need none)"
        )

    def _warm_up(self) -> None:
        """Prepare the installed strategies' references, so that the first request is as quick as the rest."""
        try:
            root = Path(self._root) if self._root else strategy.installed_folder()
        except LookupError:
            self.get_logger().warning("no strategies: magic_bringup is not installed; requests must name the path of a strategy folder")
            return
        names = sorted(path.parent.name for path in root.glob("*/strategy.yaml"))
        for name in names:
            try:
                self._matcher.prepare(global_stage.from_strategy(self._strategy(name)))
            except MagicError as error:
                self.get_logger().warning(f"strategy {name} cannot be matched: {error}")
        try:
            # One match of a demonstration with itself, and one picture of a mesh, load what requests need beyond that.
            found = self._strategy(names[0])
            self._matcher.match(found, [matching.Tool("warm_up", found.tool_view)], found.target_view, 1)
            corner = Mesh(
                np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]),
                np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
            )
            canonical_view(corner, np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]), "top")
        except (IndexError, MagicError) as error:  # a request will be answered with the reason
            self.get_logger().debug(f"warm-up: {error}")
        if names:
            self.get_logger().info(f"strategies in {root}: {', '.join(names)}")
        else:
            self.get_logger().warning(f"no strategies in {root} (parameter strategies)")

    def _strategy(self, name: str) -> Strategy:
        """The strategy of that name, read again where its file has changed."""
        if not name:
            raise MagicError(Code.UNKNOWN_STRATEGY, "strategy", name, "the name of an installed strategy or the path of a strategy folder")
        if "/" in name:
            folder = Path(name)
        else:
            try:
                folder = (Path(self._root) if self._root else strategy.installed_folder()) / name
            except LookupError as error:
                raise MagicError(
                    Code.UNKNOWN_STRATEGY, "strategy", name, "the path of a strategy folder (magic_bringup is not installed)"
                ) from error
        stamp = strategy.stamp(folder)
        with self._lock:
            kept = self._strategies.get(name)
        if kept is not None and kept[0] == stamp:
            return kept[1]
        found = strategy.find(name, self._root or None)
        with self._lock:
            if len(self._strategies) >= 32:
                self._strategies.pop(next(iter(self._strategies)))
            self._strategies[name] = (stamp, found)
        return found

    def _on_objects(self, msg: SceneObjectArray) -> None:
        try:
            scene = conversions.scene_from_msg(msg)
        except Exception as error:  # a bad message must not end the node
            self.get_logger().error(f"objects ignored: {nodes.describe(self, error)[1]}")
            return
        first = self._scene is None
        self._scene = scene
        if first:
            self.get_logger().info(f"objects: {', '.join(item.id for item in scene.objects) or 'none'}")

    def _on_match(self, request: MatchContact.Request, response: MatchContact.Response) -> MatchContact.Response:
        try:
            self._answer(request, response)
            self._answered += 1
        except Exception as error:  # every failure is answered with a code
            response.code, response.message = nodes.describe(self, error)
            response.candidates = []
            self._refused += 1
            self.get_logger().warning(f"match refused: {response.message}")
        self._last = f"{response.code}: {response.message}"
        return response

    def _report(self) -> list[DiagnosticStatus]:
        """What the matcher says about itself once a second."""
        servers = self.count_services(self._service.service_name)
        level, message = DiagnosticStatus.OK, f"answers {self._service.service_name}"
        if servers > 1:
            level, message = DiagnosticStatus.ERROR, f"{servers} servers of {self._service.service_name} (allowed: 1)"
        scene = self._scene
        values = {
            "features": self._matcher.backend.name,
            "objects": "none received yet" if scene is None else ", ".join(item.id for item in scene.objects) or "none",
            "answered": self._answered,
            "refused": self._refused,
            "last answer": self._last,
        }
        return [diagnostics.status(self, "requests", level, message, values)]

    def _answer(self, request: MatchContact.Request, response: MatchContact.Response) -> None:
        found = self._strategy(request.strategy)
        top_k = int(request.top_k) or int(self.get_parameter("top_k").value)

        def match(tools: Sequence[SceneObject], target: SceneObject) -> matching.MatchResult:
            return self._remembered.match(found, tools, target, top_k, request.want_heatmap)

        if request.tool_views or _has_image(request.target_view):
            tools, target, poses = self._parties(request)
            result = self._matcher.match(found, tools, target, top_k, request.want_heatmap)
            if isinstance(target, SceneObject) and found.turned_by:
                result = self._led(found, target, result)
        else:
            scene = self._objects()
            result = clear_way.match_led(self._matcher, match, found, scene, list(request.tool_ids), request.target_id)
            poses = {item.id: item.world_from_object for item in scene.objects}
        response.code, response.message = (
            int(Code.OK),
            f"{len(result.candidates)} candidates on {len({c.tool_id for c in result.candidates})} tool(s)",
        )
        if result.refused:
            response.message += f"; none on: {'; '.join(result.refused)}"
        response.candidates = [conversions.candidate_to_msg(c, poses.get(c.tool_id)) for c in result.candidates]
        response.target_id = result.target_id
        response.features = result.features
        response.seconds = result.seconds
        if result.heatmap is not None:
            response.heatmap = conversions.image_to_msg(result.heatmap, "32FC1")

    def _parties(
        self, request: MatchContact.Request
    ) -> tuple[list[SceneObject] | list[matching.Tool], SceneObject | CanonicalView | None, dict[str, np.ndarray]]:
        """Tools, target and the tools' poses of a request with images."""
        has_target_view = _has_image(request.target_view)
        views = [_view(view, f"tool_views[{k}]") for k, view in enumerate(request.tool_views)]
        if request.tool_ids and views:
            raise MagicError(Code.BAD_REQUEST, "tool_ids and tool_views", "both given", "one of the two")
        if request.target_id and has_target_view:
            raise MagicError(Code.BAD_REQUEST, "target_id and target_view", "both given", "one of the two")
        target: SceneObject | CanonicalView | None = _view(request.target_view, "target_view") if has_target_view else None
        if views:
            if target is None and request.target_id:
                target = self._objects().find(request.target_id)
            return [matching.Tool(f"view_{k}", view) for k, view in enumerate(views)], target, {}
        scene = self._objects()
        items = [scene.find(name) for name in request.tool_ids] or [item for item in scene.objects if item.source != "known"]
        return items, target, {item.id: item.world_from_object for item in items}

    def _led(self, found: Strategy, target: SceneObject, result: matching.MatchResult) -> matching.MatchResult:
        """The candidates of tools that only pictures show, for a target of the scene, led among the other things."""
        objects, contact_at = self._objects().objects, clear_way.contacts_of(self._matcher, found, target)
        led = clear_way.lead(found, result.candidates, target, objects, contact_at)
        return clear_way.kept(found, result, target, led, objects)

    def _objects(self) -> Scene:
        if self._scene is None:
            raise MagicError(
                Code.UNKNOWN_OBJECT,
                "objects",
                "none received yet",
                f"a SceneObjectArray on {self.resolve_topic_name('objects')}, or images in the request",
            )
        return self._scene


def _has_image(view: CanonicalViewMsg) -> bool:
    return view.image.width > 0 or view.image.height > 0 or len(view.image.data) > 0


def _view(msg: CanonicalViewMsg, what: str) -> CanonicalView:
    """A view of a request; an unset scale (0) means one metre a pixel, as nothing better is known."""
    if msg.metres_per_pixel == 0.0 or math.isnan(msg.metres_per_pixel):
        msg.metres_per_pixel = 1.0
    try:
        return conversions.view_from_msg(msg)
    except MagicError as error:
        code = Code.BAD_REQUEST_IMAGE if 100 <= error.code < 200 else error.code
        raise MagicError(code, f"{what}: {error.message}") from error


def main() -> None:
    """Run the matcher until it is told to stop."""
    nodes.run(MatcherNode)


if __name__ == "__main__":
    main()
