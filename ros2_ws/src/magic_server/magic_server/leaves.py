"""Leaves of a behaviour tree (py_trees): a run of a strategy, and each of its stages.

Needs py_trees, which nothing else here does.  Each leaf is set up with a node (``tree.setup(node=node)``, as py_trees_ros does; somebody
else spins it), is RUNNING while its server works, and answers SUCCESS where the server's code is OK, else FAILURE.  Another leaf that
interrupts it cancels what it asked for.  On the blackboard, below ``name``:

==============  ==========================================================================================
``code``        the answer's number (magic_interfaces/msg/ResultCode); ``message`` its sentence
``result``      the whole answer
==============  ==========================================================================================

and for the stages in a row, below ``namespace`` (they read what the one before has written): ``scene`` (SceneObjectArray), ``candidates``
(ContactCandidate[]), ``target_id``, ``plan`` (MotionPlan).
"""

from __future__ import annotations

import time
from typing import Any

import py_trees
from py_trees.common import Access, Status
from sensor_msgs.msg import JointState

from magic_core import qos
from magic_core.actions import ActionClient
from magic_core.errors import Code, MagicError
from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
from magic_interfaces.msg import SceneObject, SceneObjectArray
from magic_interfaces.srv import MatchContact


class _Leaf(py_trees.behaviour.Behaviour):
    """What the leaves share: their place on the blackboard, and how an answer is told.

    timeout: s that an answer may take.
    """

    def __init__(self, name: str, namespace: str, timeout: float) -> None:
        super().__init__(name)
        self._timeout = timeout
        self._node: Any = None
        self._deadline = 0.0
        self._told = self.attach_blackboard_client(name=name, namespace=f"/{namespace.strip('/')}/{name}")
        self._shared = self.attach_blackboard_client(name=name, namespace=f"/{namespace.strip('/')}")
        for key in ("code", "message", "result"):
            self._told.register_key(key, access=Access.WRITE)

    def setup(self, **kwargs: Any) -> None:
        """Take the node; raises KeyError where none was given."""
        if "node" not in kwargs:
            raise KeyError(f"leaf {self.name}: setup(node=...) is missing")
        self._node = kwargs["node"]

    def _reads(self, *keys: str) -> None:
        for key in keys:
            self._shared.register_key(key, access=Access.READ)

    def _writes(self, *keys: str) -> None:
        for key in keys:
            self._shared.register_key(key, access=Access.WRITE)

    def _tell(self, code: int, message: str, result: Any = None) -> Status:
        """Write an answer down; SUCCESS where it is OK."""
        self._told.code, self._told.message, self._told.result = int(code), message, result
        self.feedback_message = message
        return Status.SUCCESS if code == Code.OK else Status.FAILURE

    def _late(self) -> Status | None:
        if time.monotonic() < self._deadline:
            return None
        return self._tell(Code.SERVER_TIMEOUT, f"{self.name}: no answer within {self._timeout:g} s")

    def initialise(self) -> None:
        """The time begins to run."""
        self._deadline = time.monotonic() + self._timeout


class _ActionLeaf(_Leaf):
    """A goal of one action, made when the leaf begins by ``goal()``, which may raise what it lacks."""

    KIND: Any
    ACTION: str

    def setup(self, **kwargs: Any) -> None:
        super().setup(**kwargs)
        self._client = ActionClient(self._node, self.KIND, self.ACTION)

    def goal(self) -> Any:
        """The goal."""
        raise NotImplementedError

    def done(self, result: Any) -> None:
        """Write down what the leaves after this one read."""

    def initialise(self) -> None:
        """Nothing has been asked yet; the server may be about to come up."""
        super().initialise()
        self._sending: Any = None
        self._getting: Any = None
        self._handle: Any = None

    def update(self) -> Status:
        """Ask, wait, answer; never blocks."""
        try:
            if self._sending is None:
                if self._client.server_is_ready():
                    self._sending = self._client.send_goal_async(self.goal(), feedback_callback=self._on_feedback)
                else:
                    late = self._late()
                    if late is not None:
                        self._tell(Code.SERVER_UNAVAILABLE, f"nothing serves {self.ACTION} (waited {self._timeout:g} s)")
                    return late or Status.RUNNING
            if self._getting is None and self._sending.done():
                self._handle = self._sending.result()
                if not self._handle.accepted:
                    return self._tell(Code.BUSY, f"{self.ACTION} refused the goal")
                self._getting = self._handle.get_result_async()
            if self._getting is not None and self._getting.done():
                result = self._getting.result().result
                status = self._tell(result.code, result.message, result)
                if status is Status.SUCCESS:
                    self.done(result)
                self._sending = None
                return status
        except KeyError as error:  # of py_trees' blackboard
            return self._tell(Code.BAD_REQUEST, f"{self.name}: nothing on the blackboard of {error}")
        except MagicError as error:
            return self._tell(error.code, error.message)
        late = self._late()
        if late is not None:
            self._cancel()
        return late or Status.RUNNING

    def _on_feedback(self, message: Any) -> None:
        self.feedback_message = message.feedback.message if hasattr(message.feedback, "message") else str(message.feedback.phase)

    def terminate(self, new_status: Status) -> None:
        """Interrupted: what was asked for is canceled."""
        if new_status is Status.INVALID:
            self._cancel()

    def _cancel(self) -> None:
        sending = getattr(self, "_sending", None)
        self._sending = None
        if sending is None:
            return

        def stop(future: Any) -> None:
            handle = future.result()
            if handle is not None and handle.accepted:
                handle.cancel_goal_async()

        if sending.done():
            stop(sending)
        else:
            sending.add_done_callback(stop)  # accepted only later


class RunStrategyLeaf(_ActionLeaf):
    """The whole of it: action ``run_strategy`` with these fields of its goal."""

    KIND, ACTION = RunStrategy, "run_strategy"

    def __init__(self, name: str = "run_strategy", namespace: str = "magic", timeout: float = 600.0, **goal: Any) -> None:
        super().__init__(name, namespace, timeout)
        self._goal = RunStrategy.Goal(**goal)

    def goal(self) -> RunStrategy.Goal:
        return self._goal


class ObjectsLeaf(_Leaf):
    """The newest ``objects``: SUCCESS once there are some, FAILURE by NO_OBJECTS after the timeout.  Writes ``scene``."""

    def __init__(self, name: str = "objects", namespace: str = "magic", timeout: float = 10.0) -> None:
        super().__init__(name, namespace, timeout)
        self._writes("scene")
        self._newest: SceneObjectArray | None = None

    def setup(self, **kwargs: Any) -> None:
        super().setup(**kwargs)
        self._node.create_subscription(SceneObjectArray, "objects", self._on_objects, qos.LATCHED)

    def _on_objects(self, message: SceneObjectArray) -> None:
        self._newest = message

    def update(self) -> Status:
        """Take what has come."""
        scene = self._newest
        if scene is not None and scene.objects:
            self._shared.scene = scene
            return self._tell(Code.OK, f"{len(scene.objects)} objects: {', '.join(o.id for o in scene.objects)}", scene)
        if time.monotonic() < self._deadline:
            return Status.RUNNING
        return self._tell(Code.NO_OBJECTS, f"no objects came within {self._timeout:g} s")


class MatchLeaf(_Leaf):
    """Service ``match_contact`` for objects by their ids (none: the matcher chooses).  Writes ``candidates`` and ``target_id``."""

    def __init__(
        self,
        strategy: str,
        tool_id: str = "",
        target_id: str = "",
        top_k: int = 0,
        name: str = "match",
        namespace: str = "magic",
        timeout: float = 60.0,
    ) -> None:
        super().__init__(name, namespace, timeout)
        self._request = MatchContact.Request(strategy=strategy, tool_ids=[tool_id] if tool_id else [], target_id=target_id, top_k=top_k)
        self._writes("candidates", "target_id")
        self._future: Any = None

    def setup(self, **kwargs: Any) -> None:
        super().setup(**kwargs)
        self._client = self._node.create_client(MatchContact, "match_contact")

    def initialise(self) -> None:
        """Nothing has been asked yet."""
        super().initialise()
        self._future = None

    def update(self) -> Status:
        """Ask, wait, answer; never blocks."""
        if self._future is None:
            if self._client.service_is_ready():
                self._future = self._client.call_async(self._request)
        elif self._future.done():
            answer = self._future.result()
            if answer.code == Code.OK:
                self._shared.candidates, self._shared.target_id = list(answer.candidates), answer.target_id
            return self._tell(answer.code, answer.message or f"{len(answer.candidates)} candidates", answer)
        late = self._late()
        if late is not None and self._future is None:
            self._tell(Code.SERVER_UNAVAILABLE, f"nothing serves match_contact (waited {self._timeout:g} s)")
        return late or Status.RUNNING


class _StageLeaf(_ActionLeaf):
    """A stage for one candidate, the best one by default."""

    def __init__(self, strategy: str, candidate: int, name: str, namespace: str, timeout: float, **fields: Any) -> None:
        super().__init__(name, namespace, timeout)
        self._strategy, self._candidate, self._fields = strategy, candidate, fields
        self._reads("scene", "candidates", "target_id")

    def _common(self) -> dict[str, Any]:
        scene: SceneObjectArray = self._shared.scene
        candidates, target_id = self._shared.candidates, self._shared.target_id
        if not 0 <= self._candidate < len(candidates):
            raise MagicError(Code.BAD_REQUEST, "candidate", self._candidate, f"0 to {len(candidates) - 1}")
        candidate = candidates[self._candidate]
        objects: dict[str, SceneObject] = {item.id: item for item in scene.objects}
        missing = [name for name in (candidate.tool_id, target_id) if name not in objects]
        if missing:
            raise MagicError(Code.UNKNOWN_OBJECT, "objects that the matcher chose", ", ".join(missing), list(objects))
        return {
            "strategy": self._strategy,
            "tool": objects[candidate.tool_id],
            "target": objects[target_id],
            "obstacles": [item for name, item in objects.items() if name not in (candidate.tool_id, target_id)],
            "table": scene.table,
            "candidate": candidate,
            **self._fields,
        }


class PlanLeaf(_StageLeaf):
    """Action ``plan_motion`` for a candidate, with these fields of its goal besides; the arm is where ``joint_states`` has it, if anybody
    publishes them.  Reads ``scene``, ``candidates`` and ``target_id``; writes ``plan``."""

    KIND, ACTION = PlanMotion, "plan_motion"

    def __init__(
        self, strategy: str, variant: str = "arm", candidate: int = 0, name: str = "plan", namespace: str = "magic", timeout: float = 60.0,
        **fields: Any,
    ) -> None:  # fmt: skip
        super().__init__(strategy, candidate, name, namespace, timeout, variant=variant, **fields)
        self._writes("plan")
        self._joints = JointState()

    def setup(self, **kwargs: Any) -> None:
        super().setup(**kwargs)
        self._node.create_subscription(JointState, "joint_states", self._on_joints, qos.SENSOR)

    def _on_joints(self, message: JointState) -> None:
        self._joints = JointState(name=message.name, position=message.position)

    def goal(self) -> PlanMotion.Goal:
        return PlanMotion.Goal(start=self._joints, **self._common())

    def done(self, result: PlanMotion.Result) -> None:
        self._shared.plan = result.plan


class VerifyLeaf(_StageLeaf):
    """Action ``verify_motion`` for the plan, with these fields of its goal besides; SUCCESS where physics has passed it.

    Reads ``scene``, ``candidates``, ``target_id`` and ``plan``.  It publishes nothing: what may be executed is for ``run_strategy`` to say.
    """

    KIND, ACTION = VerifyMotion, "verify_motion"

    def __init__(
        self, strategy: str, candidate: int = 0, name: str = "verify", namespace: str = "magic", timeout: float = 180.0, **fields: Any
    ) -> None:
        super().__init__(strategy, candidate, name, namespace, timeout, **fields)
        self._reads("plan")

    def goal(self) -> VerifyMotion.Goal:
        return VerifyMotion.Goal(plan=self._shared.plan, **self._common())

    def _tell(self, code: int, message: str, result: Any = None) -> Status:
        if code == Code.OK and result is not None and not result.success:
            code = Code.GOAL_NOT_REACHED
        return super()._tell(code, message, result)


def stages_in_a_row(strategy: str, variant: str = "arm", tool_id: str = "", target_id: str = "", namespace: str = "magic") -> Any:
    """A sequence (py_trees.composites.Sequence) of objects, match, plan and verify for the best candidate."""
    row = py_trees.composites.Sequence(strategy, memory=True)
    row.add_children(
        [
            ObjectsLeaf(namespace=namespace),
            MatchLeaf(strategy, tool_id, target_id, namespace=namespace),
            PlanLeaf(strategy, variant, namespace=namespace),
            VerifyLeaf(strategy, namespace=namespace),
        ]
    )
    return row
