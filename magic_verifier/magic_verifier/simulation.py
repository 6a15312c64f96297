"""Rigid-body worlds in SAPIEN (PhysX on the CPU), built from objects given as convex pieces.

Only what the verifier needs of a physics engine: a table plane, bodies that are
static, moved (kinematic) or free (dynamic), steps of fixed length, and contacts.
The same calls in the same order give the same poses.

PhysX reports no contact between a kinematic and a static body.  :class:`Probe`
fills the gap: it asks, in a world of its own, how deep a posed body is in others.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from magic_core import transforms
from magic_core.decomposition import extremes
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh

#: Two pieces that touch are looked at on a grid of so many points each way where they face each other.
FACING = 9
#: Smallest and largest edge length in metres of a body's axis-aligned box that the solver can treat well.
MIN_EXTENT = 0.002
MAX_EXTENT = 5.0
#: A hull below this volume in cubic metres (a cube of 0.1 mm) has no inertia to speak of.
MIN_VOLUME = 1e-12
#: More pieces than this cannot be simulated in useful time.
MAX_PIECES = 1024
#: PhysX convex meshes hold at most 255 vertices; the rest is left out in :func:`reduced`.
MAX_VERTICES = 200
#: Steps per simulated second at least.
LEAST_FREQUENCY = 30.0
#: Above this number only the outermost points of a piece are looked at.
MANY_POINTS = 20_000

STATIC = "static"
KINEMATIC = "kinematic"
DYNAMIC = "dynamic"


@dataclass(frozen=True)
class Settings:
    """Numbers of the solver.

    Attributes
    ----------
    frequency : steps a second.
    position_iterations, velocity_iterations : of the solver in each step.
    contact_offset, rest_offset : m; pairs nearer than twice the contact offset are solved.  PhysX's default of 10 mm makes things of 20 mm
        hover and stick.
    restitution, bounce_threshold : restitution counts where bodies meet faster than the threshold, m/s.
    max_depenetration_speed : m/s at which an initial overlap is pushed apart.
    linear_damping, angular_damping : 1/s.
    rolling_damping : 1/s, for balls; stands for the rolling resistance that PhysX does not have.  5 / s slows a ball of 0.1 m/s by
        0.14 m/s^2, a coefficient of rolling resistance of 0.015.
    max_speed, max_distance : m/s, and m from the origin; they bound what is believable.
    gravity : m/s^2.
    """

    frequency: float = 240.0
    position_iterations: int = 8
    velocity_iterations: int = 1
    contact_offset: float = 0.001
    rest_offset: float = 0.0
    restitution: float = 0.0
    bounce_threshold: float = 2.0
    max_depenetration_speed: float = 0.5
    linear_damping: float = 0.0
    angular_damping: float = 0.5
    rolling_damping: float = 5.0
    max_speed: float = 20.0
    max_distance: float = 10.0
    gravity: float = 9.81

    def __post_init__(self) -> None:
        if not LEAST_FREQUENCY <= self.frequency <= 5000.0:
            raise MagicError(Code.BAD_REQUEST, "simulation frequency", self.frequency, f"{LEAST_FREQUENCY:g} to 5000 Hz")


@dataclass(frozen=True)
class Touch:
    """One contact point between two bodies: world position (3,), unit normal (3,) towards the
    first body, separation in metres (negative: overlap), impulse (3,) in N s on the first body."""

    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    separation: float
    impulse: NDArray[np.float64]


def reduced(points: NDArray[np.float64], limit: int = MAX_VERTICES) -> NDArray[np.float64]:
    """The corners of the convex hull of points (N, 3); at most ``limit`` of them, those furthest out in evenly
    spread directions.  Raises ``QhullError`` or ``ValueError`` where the points span no volume."""
    if len(points) > MANY_POINTS:
        points = extremes(points, 4 * limit)  # an exact hull of a million points takes a minute
    if len(points) < 4:
        raise ValueError(f"{len(points)} points span no volume")
    hull = ConvexHull(points)
    if hull.volume < MIN_VOLUME:
        raise ValueError(f"hull of {hull.volume:.2g} m^3")
    corners = points[hull.vertices]
    return corners if len(corners) <= limit else extremes(corners, limit)


def sphere_of(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], float] | None:
    """Centre (3,) and radius of the ball that hull corners (N, 3) tessellate, ``None`` where it is not a ball.

    A ball rolls as it should only as a sphere; as a polyhedron it rocks over its facets.
    """
    if len(corners) < 30:
        return None
    extents = np.ptp(corners, axis=0)
    if extents.max() > 1.1 * extents.min():
        return None
    system = np.column_stack([2 * corners, np.ones(len(corners))])
    solution, *_ = np.linalg.lstsq(system, np.sum(corners**2, axis=1), rcond=None)
    centre = solution[:3]
    distance = np.linalg.norm(corners - centre, axis=1)
    radius = float(distance.mean())
    if radius <= 0 or np.abs(distance - radius).max() > 0.02 * radius:
        return None
    # Corners all over the ball, not on a cap of it.
    directions = (corners - centre) / distance[:, None]
    if np.abs(directions.mean(axis=0)).max() > 0.1 or ConvexHull(corners).volume < 0.85 * 4 / 3 * np.pi * radius**3:
        return None
    return centre, radius


def usable_pieces(name: str, pieces: tuple[Mesh, ...] | list[Mesh]) -> list[NDArray[np.float64]]:
    """The hull corners of each piece that has a volume; ``BAD_SCENE`` says what is wrong with the body."""
    if len(pieces) == 0:
        raise MagicError(Code.BAD_SCENE, f"pieces of {name}", 0, f"1 to {MAX_PIECES} convex pieces")
    if len(pieces) > MAX_PIECES:
        raise MagicError(Code.BAD_SCENE, f"pieces of {name}", len(pieces), f"1 to {MAX_PIECES} convex pieces")
    everything = np.concatenate([piece.vertices for piece in pieces])
    if len(everything) == 0 or not np.all(np.isfinite(everything)):
        raise MagicError(Code.BAD_SCENE, f"vertices of {name}", "none or not finite", "finite coordinates in metres")
    extents = everything.max(axis=0) - everything.min(axis=0)
    if extents.max() > MAX_EXTENT or extents.max() < MIN_EXTENT:
        raise MagicError(Code.BAD_SCENE, f"largest extent of {name}", f"{extents.max():.3g} m", f"{MIN_EXTENT} to {MAX_EXTENT} m")
    hulls = []
    for piece in pieces:
        try:
            hulls.append(reduced(piece.vertices))
        except (QhullError, ValueError):
            continue  # slivers of a decomposition carry neither mass nor contact
    if not hulls:
        raise MagicError(Code.BAD_SCENE, f"volume of {name}", "no piece has a volume", f"pieces above {MIN_VOLUME} m^3")
    return hulls


@lru_cache(maxsize=1)
def engine() -> Any:
    """The module sapien, imported on first use, without its warning that there is no Vulkan: nothing here renders with it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*[Vv]ulkan.*")
        import sapien
    return sapien


def to_pose(transform: NDArray[np.float64]) -> Any:
    """4x4 transform to sapien.Pose."""
    sapien = engine()
    return sapien.Pose(transform[:3, 3], transforms.quaternion_wxyz(transform))


def to_poses(stack: NDArray[np.float64]) -> list[Any]:
    """(T, 4, 4) transforms to a list of sapien.Pose."""
    sapien = engine()
    quaternions = transforms.quaternion_wxyz(stack)
    return [sapien.Pose(p, q) for p, q in zip(stack[:, :3, 3], quaternions, strict=True)]


def from_pose(pose: Any) -> NDArray[np.float64]:
    """sapien.Pose to a 4x4 float64 transform."""
    return np.asarray(pose.to_transformation_matrix(), dtype=float)


@dataclass(frozen=True)
class _Piece:
    """A convex piece in the world: corners (N, 3), and planes (M, 4) of unit normals outward, with normal @ x + offset <= 0 inside."""

    corners: NDArray[np.float64]
    planes: NDArray[np.float64]

    @classmethod
    def of(cls, body: Any, shape: Any) -> _Piece | None:
        """A shape of a body where it is now; ``None`` for what is neither a convex mesh nor a box."""
        physx = engine().physx
        if isinstance(shape, physx.PhysxCollisionShapeBox):
            corners = np.asarray(shape.half_size, dtype=float) * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        elif isinstance(shape, physx.PhysxCollisionShapeConvexMesh):
            corners = np.asarray(shape.vertices, dtype=float) * np.asarray(shape.scale, dtype=float)
        else:
            return None
        world_from_shape = from_pose(body.entity_pose * shape.local_pose)
        planes = _planes(corners.tobytes())
        normals = planes[:, :3] @ world_from_shape[:3, :3].T
        offsets = planes[:, 3] - normals @ world_from_shape[:3, 3]
        return cls(transforms.apply(world_from_shape, corners), np.column_stack([normals, offsets]))

    def ends(self, points: NDArray[np.float64], along: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far (P,) along a direction from each of the points (P, 3) its line enters and leaves; what it misses leaves before it
        enters."""
        slope = self.planes[:, :3] @ along
        height = points @ self.planes[:, :3].T + self.planes[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = -height / slope
        flat = np.abs(slope) < 1e-9
        enter = np.where(flat, np.where(height > 0, np.inf, -np.inf), np.where(slope < 0, at, -np.inf)).max(axis=1)
        leave = np.where(flat, np.where(height > 0, -np.inf, np.inf), np.where(slope > 0, at, np.inf)).min(axis=1)
        return enter, leave


@lru_cache(maxsize=2048)
def _planes(corners: bytes) -> NDArray[np.float64]:
    return np.asarray(ConvexHull(np.frombuffer(corners).reshape(-1, 3)).equations)


def _facing(upper: _Piece, lower: _Piece, along: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (P, 3) of the lower of two pieces under the upper one, on a grid across the direction up, and the gaps (P,) between them
    there."""
    side = transforms.unit(np.cross(along, np.eye(3)[int(np.abs(along).argmin())]))
    across = np.stack([side, np.cross(along, side)])
    flat = [piece.corners @ across.T for piece in (upper, lower)]
    low, high = np.maximum(*(f.min(axis=0) for f in flat)), np.minimum(*(f.max(axis=0) for f in flat))
    if np.any(high < low):
        return np.zeros((0, 3)), np.zeros(0)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, FACING).T), axis=-1).reshape(-1, 2) @ across
    (bottom, beyond), (before, top) = upper.ends(grid, along), lower.ends(grid, along)
    both = (beyond > bottom) & (top > before)
    return grid[both] + top[both, None] * along, (bottom - top)[both]


class World:
    """One simulation: bodies by name, stepped together.

    The pieces' hulls are computed once and can be handed on to another world
    (``hulls`` of :meth:`add`), which is what rollouts do.
    """

    def __init__(self, settings: Settings | None = None) -> None:
        sapien = self._sapien = engine()
        self.settings = settings or Settings()
        # Configuration is global in SAPIEN and read when the system is made.
        sapien.physx.set_scene_config(
            gravity=np.array([0, 0, -self.settings.gravity], dtype=np.float32),
            bounce_threshold=self.settings.bounce_threshold,
            enable_pcm=True,
            enable_tgs=True,
            enable_ccd=False,
            enable_enhanced_determinism=True,
            enable_friction_every_iteration=True,
            cpu_workers=0,
        )
        sapien.physx.set_shape_config(contact_offset=self.settings.contact_offset, rest_offset=self.settings.rest_offset)
        sapien.physx.set_body_config(
            solver_position_iterations=self.settings.position_iterations,
            solver_velocity_iterations=self.settings.velocity_iterations,
            sleep_threshold=0.0,
        )
        self.scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
        self._system = self.scene.physx_system
        self._system.timestep = 1.0 / self.settings.frequency
        self.time = 0.0
        self.steps = 0
        self._materials: dict[float, Any] = {}
        self._bodies: dict[str, Any] = {}
        self._sorted: dict[tuple[str, str], list[Any]] = {}
        self._sorted_at = -1
        # Contacts name their bodies by component.  The binding gives the same object for the same one as long as somebody has it; by its
        # address, which takes longer to ask for, a component is found whatever the binding does.
        self._names: dict[Any, str] = {}
        self._named_at: dict[int, str] = {}

    @property
    def timestep(self) -> float:
        """Length of a step in seconds."""
        return 1.0 / self.settings.frequency

    def material(self, friction: float) -> Any:
        """The PhysX material of a friction coefficient; pairs take the average of their two."""
        friction = float(friction)
        if friction not in self._materials:
            if not (np.isfinite(friction) and 0 <= friction <= 100):
                raise MagicError(Code.BAD_SCENE, "friction coefficient", friction, "0 to 100")
            self._materials[friction] = self._sapien.physx.PhysxMaterial(friction, friction, self.settings.restitution)
        return self._materials[friction]

    def _register(self, name: str, component: Any, pose: NDArray[np.float64]) -> None:
        if name in self._bodies:
            raise MagicError(Code.BAD_SCENE, "body name", name, "names that differ")
        entity = self._sapien.Entity()
        entity.name = name
        entity.add_component(component)
        entity.pose = to_pose(pose)
        self.scene.add_entity(entity)
        self._bodies[name] = component
        self.name_component(component, name)

    def name_component(self, component: Any, name: str) -> None:
        """Let contacts of a component (a robot's link) be found under a name; several may share one."""
        self._names[component] = self._named_at[component._physx_pointer] = name

    def add_table(self, plane: NDArray[np.float64], friction: float, name: str = "table") -> None:
        """The half space below the plane (4,) a x + b y + c z + d = 0, unit normal up."""
        physx = self._sapien.physx
        normal = transforms.unit(plane[:3])
        # PhysX's plane passes through its frame's origin with the normal along x.
        helper = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
        pose = transforms.frame(-float(plane[3]) * normal, normal, np.cross(normal, helper))
        component = physx.PhysxRigidStaticComponent()
        component.attach(self._spaced(physx.PhysxCollisionShapePlane(material=self.material(friction))))
        self._register(name, component, pose)

    def add(
        self,
        name: str,
        hulls: list[NDArray[np.float64]],
        world_from_object: NDArray[np.float64],
        kind: str,
        density: float,
        friction: float,
        mesh: Mesh | None = None,
        balls: Sequence[tuple[NDArray[np.float64], float] | None] | None = None,
        centre_shift: NDArray[np.float64] | None = None,
    ) -> None:
        """Add a body of convex hulls (see :func:`usable_pieces`), corners (N, 3) in its own frame; density in kg/m^3.

        ``mesh``: its exact surface, which a body that is not free may collide by instead of its hulls.  ``balls``: what
        :func:`sphere_of` says of each hull, where that is known.  ``centre_shift`` (3,): how far its centre of mass is from that of
        its hulls, metres in its own frame.
        """
        physx = self._sapien.physx
        if not (np.isfinite(density) and 0 < density < 1e5):
            raise MagicError(Code.BAD_SCENE, f"density of {name}", density, "above 0 and below 100000 kg/m^3")
        if not np.all(np.isfinite(world_from_object)):
            raise MagicError(Code.BAD_SCENE, f"pose of {name}", "not finite", "finite numbers")
        if mesh is not None and kind == DYNAMIC:
            raise MagicError(Code.BAD_SCENE, f"shape of {name}", "an exact surface", "convex pieces for a body that is free")
        component = physx.PhysxRigidStaticComponent() if kind == STATIC else physx.PhysxRigidDynamicComponent()
        material = self.material(friction)
        if mesh is not None:
            component.attach(self._spaced(self._surface(mesh, material)))
            hulls, balls = [], ()
        if balls is None:
            balls = [sphere_of(corners) for corners in hulls]
        for corners, ball in zip(hulls, balls, strict=True):
            shape = self._spaced(self._piece(name, corners, ball, material))
            shape.density = float(density)
            component.attach(shape)
        if kind != STATIC:
            self._let_move(component, kind, bool(balls) and all(balls), centre_shift)
        self._register(name, component, world_from_object)

    def _spaced(self, shape: Any) -> Any:
        """A shape with the settings' distances at which it is solved and rests."""
        shape.contact_offset = self.settings.contact_offset
        shape.rest_offset = self.settings.rest_offset
        return shape

    def _surface(self, mesh: Mesh, material: Any) -> Any:
        """A shape that is a mesh's exact surface."""
        return self._sapien.physx.PhysxCollisionShapeTriangleMesh(
            vertices=np.ascontiguousarray(mesh.vertices, dtype=np.float32),
            triangles=np.ascontiguousarray(mesh.faces, dtype=np.uint32),
            scale=np.ones(3, np.float32),
            material=material,
        )

    def _piece(self, name: str, corners: NDArray[np.float64], ball: tuple[NDArray[np.float64], float] | None, material: Any) -> Any:
        """The shape of one convex piece of a body: a ball where it stands for one.  Raises BAD_SCENE where PhysX cannot take it."""
        physx = self._sapien.physx
        if ball is not None:
            shape = physx.PhysxCollisionShapeSphere(radius=ball[1], material=material)
            shape.local_pose = self._sapien.Pose(ball[0])
            return shape
        try:
            return physx.PhysxCollisionShapeConvexMesh(
                vertices=np.ascontiguousarray(corners, dtype=np.float32), scale=np.ones(3, np.float32), material=material
            )
        except RuntimeError as error:
            raise MagicError(Code.BAD_SCENE, f"piece of {name}", str(error), "a convex piece that PhysX can cook") from error

    def _let_move(self, component: Any, kind: str, rolls: bool, centre_shift: NDArray[np.float64] | None) -> None:
        """Set how a body that is not static is solved and damped; rolls: it is made of balls alone."""
        component.solver_position_iterations = self.settings.position_iterations
        component.solver_velocity_iterations = self.settings.velocity_iterations
        component.sleep_threshold = 0.0
        component.linear_damping = self.settings.linear_damping
        component.angular_damping = self.settings.rolling_damping if rolls else self.settings.angular_damping
        component.max_depenetration_velocity = self.settings.max_depenetration_speed
        component.kinematic = kind == KINEMATIC
        if centre_shift is not None:
            middle = component.cmass_local_pose
            component.cmass_local_pose = self._sapien.Pose(middle.p + np.asarray(centre_shift, dtype=np.float32), middle.q)

    def component(self, name: str) -> Any:
        """The PhysX component of a body."""
        return self._bodies[name]

    def has(self, name: str) -> bool:
        """Whether there is a body of that name."""
        return name in self._bodies

    def pose(self, name: str) -> NDArray[np.float64]:
        """world_from_object (4, 4)."""
        return from_pose(self._bodies[name].entity_pose)

    def position(self, name: str) -> NDArray[np.float64]:
        """World position (3,) of a body's origin."""
        return np.asarray(self._bodies[name].entity_pose.p, dtype=float)

    def velocity(self, name: str) -> NDArray[np.float64]:
        """Linear velocity (3,) in m/s of a body's centre of mass."""
        return np.asarray(self._bodies[name].linear_velocity, dtype=float)

    def set_velocity(self, name: str, velocity: NDArray[np.float64]) -> None:
        """Set the linear velocity of a dynamic body."""
        self._bodies[name].linear_velocity = np.asarray(velocity, dtype=np.float32)

    def turning(self, name: str) -> NDArray[np.float64]:
        """Angular velocity (3,) of a body in rad/s."""
        return np.asarray(self._bodies[name].angular_velocity, dtype=float)

    def set_turning(self, name: str, velocity: NDArray[np.float64]) -> None:
        """Set the angular velocity of a dynamic body."""
        self._bodies[name].angular_velocity = np.asarray(velocity, dtype=np.float32)

    def place(self, name: str, pose: NDArray[np.float64]) -> None:
        """Put a body somewhere, at rest where it is free."""
        self.put(name, to_pose(pose))

    def put(self, name: str, pose: Any) -> None:
        """The same at a sapien.Pose."""
        component = self._bodies[name]
        component.entity_pose = pose
        if not component.kinematic:
            component.linear_velocity = component.angular_velocity = np.zeros(3, np.float32)

    def centre_of_mass(self, name: str) -> NDArray[np.float64]:
        """World position (3,) of a body's centre of mass."""
        component = self._bodies[name]
        return np.asarray((component.entity_pose * component.cmass_local_pose).p, dtype=float)

    def set_friction(self, name: str, friction: float) -> None:
        """Give all of a body's surface another friction coefficient."""
        for shape in self._bodies[name].collision_shapes:
            shape.physical_material = self.material(friction)

    def set_offset(self, names: Sequence[str], offset: float) -> None:
        """Give bodies another contact offset, m."""
        for name in names:
            for shape in self._bodies[name].collision_shapes:
                shape.contact_offset = offset

    def calm(self, name: str, damping: float) -> None:
        """Take speed off a free body, linear and angular, by so much per second."""
        self._bodies[name].linear_damping = self._bodies[name].angular_damping = float(damping)

    def doze(self, name: str, speed: float) -> None:
        """Let the engine leave a body where it is once it has been slower than this (m/s) for 0.4 s, until something touches it; 0:
        never."""
        self._bodies[name].sleep_threshold = speed**2 / 2
        if speed == 0 and not self._bodies[name].kinematic:
            self._bodies[name].wake_up()

    def move_to(self, name: str, pose: Any) -> None:
        """Where a kinematic body shall be after the next step (a sapien.Pose)."""
        self._bodies[name].kinematic_target = pose

    def hold(self, name: str) -> None:
        """Keep a free body where it is: make it kinematic."""
        self._bodies[name].kinematic = True

    def let_go(self, name: str) -> None:
        """Make a kinematic body free, at rest."""
        component = self._bodies[name]
        component.kinematic = False
        component.linear_velocity = np.zeros(3, np.float32)
        component.angular_velocity = np.zeros(3, np.float32)
        component.wake_up()

    def step(self) -> None:
        """Advance by one step."""
        self._system.step()
        self.steps += 1
        self.time = self.steps / self.settings.frequency

    def check(self, names: tuple[str, ...]) -> None:
        """Raise ``SIMULATION_EXPLODED`` where a body is nowhere, too far or too fast."""
        for name in names:
            speed = math.hypot(*self._bodies[name].linear_velocity.tolist())
            distance = math.hypot(*self._bodies[name].entity_pose.p.tolist())
            if not (math.isfinite(distance) and math.isfinite(speed)):
                raise MagicError(
                    Code.SIMULATION_EXPLODED, f"state of {name} at {self.time:.2f} s", "not a number", "finite positions and velocities"
                )
            if speed > self.settings.max_speed:
                raise MagicError(
                    Code.SIMULATION_EXPLODED,
                    f"speed of {name} at {self.time:.2f} s",
                    f"{speed:.1f} m/s",
                    f"up to {self.settings.max_speed} m/s",
                )
            if distance > self.settings.max_distance:
                raise MagicError(
                    Code.SIMULATION_EXPLODED,
                    f"distance of {name} at {self.time:.2f} s",
                    f"{distance:.1f} m",
                    f"up to {self.settings.max_distance} m",
                )

    def touches(self, first: str, second: str, within: float = 0.0) -> list[Touch]:
        """Contact points of the last step between two bodies whose separation is at most ``within`` metres."""
        result = []
        for sign, pair in ((1.0, (first, second)), (-1.0, (second, first))):
            for contact in self._contacts().get(pair, ()):
                for point in contact.points:
                    if point.separation <= within:
                        result.append(
                            Touch(
                                np.asarray(point.position, dtype=float),
                                sign * np.asarray(point.normal, dtype=float),
                                float(point.separation),
                                sign * np.asarray(point.impulse, dtype=float),
                            )
                        )
        return result

    def pressed(self, first: str, second: str, depth: float, along: NDArray[np.float64]) -> list[Touch]:
        """Where two bodies touch, one of which gives way by ``depth`` metres ``along`` a unit direction (3,): the contact points of the
        last step, and what else of the pieces that touch is no farther apart along it, on a grid across it, without an impulse.

        Rigid faces a little askew touch along an edge, or at a corner, and nothing else of them is among the engine's points.
        """
        result = self.touches(first, second, depth)
        for pair in ((first, second), (second, first)):
            for contact in self._contacts().get(pair, ()):
                near = min(contact.points, key=lambda point: point.separation, default=None)
                if near is None or near.separation > depth:
                    continue
                sign = 1.0 if pair == (first, second) else -1.0
                normal = sign * np.asarray(near.normal, dtype=float)
                # The normal is towards the first of the two.
                pieces = [_Piece.of(body, shape) for body, shape in zip(contact.bodies, contact.shapes, strict=True)]
                if any(piece is None for piece in pieces):
                    continue
                upper, lower = pieces if np.asarray(near.normal) @ along > 0 else pieces[::-1]
                points, gaps = _facing(upper, lower, along)
                result += [Touch(p, normal, float(gap), np.zeros(3)) for p, gap in zip(points, gaps, strict=True) if gap <= depth]
        return result

    def touching(self, first: str, second: str, within: float = 0.0) -> bool:
        """Whether two bodies were within ``within`` metres of each other in the last step."""
        return any(point.separation <= within for contact in self._between(first, second) for point in contact.points)

    def depth(self, first: str, second: str) -> float:
        """How deep two bodies were in each other in the last step, m, at the deepest contact point; 0 where they were not."""
        return max([0.0, *(-point.separation for contact in self._between(first, second) for point in contact.points)])

    def force(self, first: str, second: str) -> float:
        """With how many newtons two bodies pressed on each other in the last step: all their contact points, whichever way each of them
        goes."""
        return sum(math.hypot(*p.impulse.tolist()) for contact in self._between(first, second) for p in contact.points) / self.timestep

    def _between(self, first: str, second: str) -> list[Any]:
        """The last step's contacts of two bodies, whichever of them is named first."""
        contacts = self._contacts()
        return [*contacts.get((first, second), ()), *contacts.get((second, first), ())]

    def touched_by(self, name: str, within: float = 0.0) -> tuple[str, ...]:
        """Names of the bodies that were within ``within`` metres of one in the last step, sorted."""
        found = {
            first if second == name else second
            for (first, second), contacts in self._contacts().items()
            if name in (first, second) and any(p.separation <= within for contact in contacts for p in contact.points)
        }
        return tuple(sorted(found))

    def _contacts(self) -> dict[tuple[str, str], list[Any]]:
        """The last step's contacts by the names of their bodies, sorted once a step."""
        if self._sorted_at != self.steps:
            self._sorted_at = self.steps
            # By the bodies first, of which there are few: each of the contacts, up to a hundred, is looked up once.
            by_bodies: dict[tuple[Any, Any], list[Any]] = {}
            for contact in self._system.get_contacts():
                first, second = contact.bodies
                pair = first, second
                if pair in by_bodies:
                    by_bodies[pair].append(contact)
                else:
                    by_bodies[pair] = [contact]
            found: dict[tuple[str, str], list[Any]] = {}
            for (first, second), contacts in by_bodies.items():
                found.setdefault((self._name_of(first), self._name_of(second)), []).extend(contacts)
            self._sorted = found
        return self._sorted

    def _name_of(self, component: Any) -> str:
        """The name under which contacts of a component are found; "" where it has none."""
        name = self._names.get(component)
        return self._named_at.get(component._physx_pointer, "") if name is None else name


class Probe:
    """How deep a posed body is in fixed ones, by the same collision shapes as the simulation's."""

    def __init__(
        self, settings: Settings, hulls: list[NDArray[np.float64]], others: dict[str, tuple[list[NDArray[np.float64]], NDArray[np.float64]]]
    ) -> None:
        """``others``: hulls and world_from_object by name."""
        self._world = World(settings)
        # So short a step that nothing moves: the contacts are those of the pose that was set.
        self._world.scene.physx_system.timestep = 1e-6
        self._others = tuple(others)
        self._world.add("probe", hulls, transforms.make(translation=[0, 0, 5.0]), DYNAMIC, 1000.0, 0.0)
        self._world.component("probe").disable_gravity = True
        for name, (other_hulls, pose) in others.items():
            self._world.add(name, other_hulls, pose, STATIC, 1000.0, 0.0)

    def depths(self, pose: Any) -> dict[str, float]:
        """The bodies that a pose (sapien.Pose) is in, and how deep in metres."""
        component = self._world.component("probe")
        component.entity_pose = pose
        component.linear_velocity = np.zeros(3, np.float32)
        component.angular_velocity = np.zeros(3, np.float32)
        self._world.step()
        return {other: depth for other in self._others if (depth := self._world.depth("probe", other)) > 0}
