"""The paper's other methods (section IV, Baselines), each answering with ranked contacts as the matcher does.

``pca``        the clouds of the demonstrated and the new tool are laid on each other by their centres and principal axes; of the
               four turns that the axes leave open the one with the least distance between the clouds comes first.
``fpfh_icp``   FPFH features, RANSAC and point-to-plane ICP on the clouds (Open3D).  The released figures come without a
               stated voxel size; here it is a share of the reference's size.
``curvature``  contact points drawn at random on the new tool's outline, ranked by the curvature score alone, until all are
               looked at or the time is over.

The first two carry the demonstrated contact over with the alignment of the whole shape.  Feature matching alone (``dino``) and
the ablations are settings of :class:`magic_matcher.matching.Matcher`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magic_core import transforms
from magic_core.contact import Contact, ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_core.views import as_it_stands
from magic_matcher import contour as contours
from magic_matcher import curvature, global_stage, score
from magic_matcher.candidates import to_contact
from magic_matcher.matching import SAME_PLACE
from magic_matcher.targets import Target

#: Points of a cloud; the voxel of FPFH as a share of the reference's diagonal; RANSAC's draws.
POINTS, VOXEL, DRAWS = 3000, 0.03, 100_000
#: Contact points of the outline looked at together.
BATCH = 32

#: tool_from_reference (4, 4) and how good it is (higher is better), best first.
Alignments = list[tuple[NDArray[np.float64], float]]


def sampled(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (count, 3) spread evenly over a mesh's surface at random, and their unit normals (count, 3)."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    if not doubled.sum() > 0:
        raise MagicError(Code.BAD_MESH, "area of the mesh", float(doubled.sum()), "above 0")
    face = rng.choice(len(corners), count, p=doubled / doubled.sum())
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.column_stack([1 - u, u * (1 - v), u * v])
    return np.einsum("nk,nki->ni", weights, corners[face]), normals[face] / doubled[face, None]


def apart(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Mean distance in metres of the points of either cloud (N, 3), (M, 3) from the other."""
    return 0.5 * float(cKDTree(second).query(first)[0].mean() + cKDTree(first).query(second)[0].mean())


def pca(reference: Mesh, tool: Mesh, seed: int = 0) -> Alignments:
    """Centres on each other, principal axes on each other."""
    rng = np.random.default_rng(seed)
    a, b = sampled(reference, POINTS, rng)[0], sampled(tool, POINTS, rng)[0]
    axes = []
    for cloud in (a, b):
        vectors = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)[2].T
        # The sign of an axis means nothing; a turn has a determinant of 1.
        axes.append(vectors * [1, 1, np.sign(np.linalg.det(vectors))])
    found = []
    for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]):
        rotation = (axes[1] * signs) @ axes[0].T
        moved = transforms.make(rotation, b.mean(axis=0) - rotation @ a.mean(axis=0))
        found.append((moved, -apart(transforms.apply(moved, a), b)))
    return sorted(found, key=lambda pair: -pair[1])


def fpfh_icp(reference: Mesh, tool: Mesh, seed: int = 0) -> Alignments:
    """The alignment that FPFH features, RANSAC and ICP find; empty where they find none."""
    import open3d

    rng = np.random.default_rng(seed)
    open3d.utility.random.seed(seed)
    registration = open3d.pipelines.registration
    voxel = VOXEL * float(np.linalg.norm(reference.extents))
    clouds, described = [], []
    for mesh in (reference, tool):
        points, normals = sampled(mesh, POINTS, rng)
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.normals = open3d.utility.Vector3dVector(normals)
        cloud = cloud.voxel_down_sample(voxel)
        clouds.append(cloud)
        near = open3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
        described.append(registration.compute_fpfh_feature(cloud, near))
    coarse = registration.registration_ransac_based_on_feature_matching(
        clouds[0],
        clouds[1],
        described[0],
        described[1],
        True,
        1.5 * voxel,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
        ],
        registration.RANSACConvergenceCriteria(DRAWS, 0.999),
    )
    if coarse.fitness == 0:
        return []
    fine = registration.registration_icp(
        clouds[0], clouds[1], 0.75 * voxel, coarse.transformation, registration.TransformationEstimationPointToPlane()
    )
    return [(np.asarray(fine.transformation, dtype=float), float(fine.fitness))]


#: Methods that align the whole shape.
ALIGNERS: dict[str, Callable[[Mesh, Mesh, int], Alignments]] = {"pca": pca, "fpfh_icp": fpfh_icp}


def by_shape(name: str, strategy: Strategy, tools: Sequence[SceneObject], target: Target, top_k: int, seed: int) -> list[ContactCandidate]:
    """The demonstrated contact carried over to each tool by one of :data:`ALIGNERS`, best first; raises ``NO_MATCH`` where there is
    none."""
    candidates = []
    for tool in tools:
        view = as_it_stands(tool, strategy.view)
        for tool_from_reference, quality in ALIGNERS[name](strategy.tool_mesh, tool.mesh, seed)[:top_k]:
            frame = tool_from_reference @ strategy.tool_contact.object_from_contact
            pixel = view.pixels(frame[:3, 3])
            picture = frame[:3, 0] @ view.object_from_view[:3, :2]
            normal = picture / max(float(np.linalg.norm(picture)), 1e-9)
            contact = replace(strategy.tool_contact, pixel=pixel, normal=normal, object_from_contact=frame)
            candidates.append(_candidate(tool.id, contact, target, tool_from_reference, quality, 0.0, quality))
    if not candidates:
        raise MagicError(Code.NO_MATCH, f"alignments of the tool by {name}", 0, "a tool that can be laid on the demonstrated one")
    return sorted(candidates, key=lambda candidate: -candidate.score)


def by_curvature(
    strategy: Strategy,
    tools: Sequence[SceneObject],
    target: Target,
    top_k: int,
    seed: int,
    seconds: float = 180.0,
    clock: Callable[[], float] = time.monotonic,
) -> list[ContactCandidate]:
    """Random contact points of the tools' outlines, ranked by the curvature score; ``seconds`` bound the search (the paper: 180)."""
    rng = np.random.default_rng(seed)
    deadline = clock() + seconds
    reference = global_stage.from_strategy(strategy)
    shown, disc = strategy.target_contact.disc_radius, target.contact.disc_radius
    of_reference = reference.contour.size * reference.view.metres_per_pixel if shown is None or disc is None else shown
    ratio = reference.radius * reference.view.metres_per_pixel / of_reference
    found: list[ContactCandidate] = []
    for number, tool in enumerate(tools):
        view = as_it_stands(tool, strategy.view)
        contour = contours.extract(view.mask)
        scale = contour.size * view.metres_per_pixel if shown is None or disc is None else disc
        order = rng.permutation(len(contour.points))
        # Each tool gets its share of the time that is left.
        until = clock() + (deadline - clock()) / (len(tools) - number)
        mine: list[ContactCandidate] = []
        for begin in range(0, len(order), BATCH):
            if clock() > until and mine:
                break
            for local in curvature.estimate_many(contour, order[begin : begin + BATCH], reference.concave):
                if local is None or local.concave != reference.concave:
                    continue
                contact = to_contact(view, local)
                s_curv = score.curvature_score(ratio, contact.radius / scale)
                carried = contact.object_from_contact @ transforms.inverse(strategy.tool_contact.object_from_contact)
                mine.append(_candidate(tool.id, contact, target, carried, 0.0, s_curv, s_curv))
        if mine:
            points = np.array([c.tool.pixel for c in mine])
            kept = global_stage.suppress(points, np.array([c.score for c in mine]), SAME_PLACE * contour.size, top_k)
            found += [mine[k] for k in kept]
    if not found:
        raise MagicError(Code.NO_MATCH, "contact points of the reference's convexity", 0, "a tool that has some")
    return sorted(found, key=lambda candidate: -candidate.score)


def _candidate(
    tool_id: str,
    contact: Contact,
    target: Target,
    tool_from_reference: NDArray[np.float64],
    s_dino: float,
    s_curv: float,
    total: float,
) -> ContactCandidate:
    return ContactCandidate(tool_id, contact, target.contact, 0.0, False, s_dino, s_curv, total, tool_from_reference)
