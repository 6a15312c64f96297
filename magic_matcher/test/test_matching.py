"""Both stages together with the embedded features."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh
from scipy import ndimage

from magic_core import shapes, transforms
from magic_core.contact import turned_over
from magic_core.errors import Code, MagicError
from magic_core.mesh import from_trimesh
from magic_core.scene import CanonicalView, Scene, SceneObject
from magic_core.views import find_view, view_of_contact
from magic_matcher import contour, curvature, features, jobs, matching, plain, plausible, targets
from magic_matcher.cache import Cache
from magic_matcher.global_stage import Proposal, make_reference


@pytest.fixture(scope="module")
def matcher():
    return matching.Matcher(features.load("embedded"))


def reference_of(job, family, region, seed, radius):
    shown = jobs.example(job, family, seed)
    contact = shown.contact(region)
    return make_reference(shown.view, contact.pixel, contact.normal, radius / shown.view.metres_per_pixel, shown.contour), contact


def moved(view: CanonicalView, angle, mirror):
    """The view's mask turned by ``angle`` about the picture's centre, mirrored first."""
    size = view.mask.shape[0]
    c, s = np.cos(angle), np.sin(angle)
    linear = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if mirror else 1.0, 1.0])
    middle = np.full(2, (size - 1) / 2)
    back = np.linalg.inv(linear)[::-1, ::-1]  # in (v, u)
    mask = ndimage.affine_transform(np.pad(view.mask, 100).astype(float), back, middle + 100 - back @ (middle + 100), order=1) > 0.5
    image = np.where(mask[..., None], 150, 0).astype(np.uint8).repeat(3, axis=2)
    return CanonicalView(image, mask, view.metres_per_pixel, np.eye(4), view.kind), linear, middle


def test_the_reference_matches_itself(matcher):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    result = matcher.match_views(
        reference, contact, [matching.Tool("same", reference.view)], jobs.disc_target(0.025, "top"), reference_target_radius=0.025
    )
    best = result.candidates[0]
    assert np.hypot(*(best.tool.pixel - contact.pixel)) < 4
    assert best.s_dino > 0.75 and best.s_curv > 0.8 and not best.flipped
    assert min(best.rotation, 2 * np.pi - best.rotation) < 0.1
    assert best.tool_from_reference == pytest.approx(np.eye(4), abs=0.1)


@pytest.mark.parametrize(("angle", "mirror"), [(0.7, False), (2.5, False), (0.0, True), (4.0, True)])
def test_the_match_turns_with_the_tool(matcher, angle, mirror):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    view, linear, middle = moved(reference.view, angle, mirror)
    result = matcher.match_views(
        reference, contact, [matching.Tool("t", view)], jobs.disc_target(0.025, "top"), reference_target_radius=0.025
    )
    best = result.candidates[0]
    expected = linear @ (contact.pixel - middle) + middle + 100
    assert np.hypot(*(best.tool.pixel - expected)) < 5
    assert best.flipped == mirror
    assert (best.rotation - angle + 0.15) % (2 * np.pi) < 0.3


def test_a_mirrored_match_aligns_the_turned_frame(matcher):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    view, _, _ = moved(reference.view, 0.0, True)
    best = matcher.match_views(
        reference, contact, [matching.Tool("t", view)], jobs.disc_target(0.025, "top"), reference_target_radius=0.025
    ).candidates[0]
    assert best.tool_from_reference @ contact.object_from_contact == pytest.approx(turned_over(best.tool.object_from_contact), abs=1e-9)


@pytest.mark.parametrize(
    ("job", "family", "region", "tool", "radius"),
    [
        ("hooking", "l_hook", "inner", "caliper", 0.02),
        ("hooking", "l_hook", "inner", "j_hook", 0.02),
        ("hooking", "l_hook", "inner", "letter", 0.02),
        ("hanging", "hanger", "hook", "mug", 0.006),
        ("hanging", "hanger", "hook", "scissors", 0.006),
        ("scooping", "spoon", "bowl", "ladle", 0.025),
        ("scooping", "spoon", "bowl", "measuring_cup", 0.025),
    ],
)
def test_contacts_go_to_the_functionally_same_place(matcher, job, family, region, tool, radius):
    reference, contact = reference_of(job, family, region, 5001, radius)
    target = jobs.disc_target(radius, jobs.JOBS[job].view)
    right = []
    for seed in range(9100, 9106):
        example = jobs.example(job, tool, seed)
        if not jobs.usable(example, radius / example.view.metres_per_pixel):
            continue
        result = matcher.match_views(reference, contact, [matching.Tool(tool, example.view)], target, reference_target_radius=radius)
        pixels = np.array([c.tool.pixel for c in result.candidates])
        normals = np.array([c.tool.normal for c in result.candidates])
        right.append(bool(example.near(pixels, normals, example.contour.size / 50).any()))
    assert np.mean(right) >= 0.8


def test_candidates_are_different_places_best_first(matcher):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    tool = jobs.example("hooking", "caliper", 4)
    result = matcher.match_views(
        reference, contact, [matching.Tool("c", tool.view)], jobs.disc_target(0.02, "top"), 5, reference_target_radius=0.025, heatmap=True
    )
    scores = [c.score for c in result.candidates]
    assert scores == sorted(scores, reverse=True) and len(scores) <= 5
    for i, a in enumerate(result.candidates):
        for b in result.candidates[:i]:
            assert np.hypot(*(a.tool.pixel - b.tool.pixel)) >= matching.SAME_PLACE * tool.contour.size
    assert result.heatmap.shape == tool.view.mask.shape and 0.5 < result.heatmap.max() <= 1


def test_the_better_tool_is_selected(matcher):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    tools = [matching.Tool(name, shapes.make(name, 8).view()) for name in ("s_hook", "l_hook")]
    tools.append(matching.Tool("letter_i", shapes.make("letter", 0, glyph="I").view()))
    result = matcher.match_views(reference, contact, tools, jobs.disc_target(0.025, "top"), reference_target_radius=0.025)
    assert result.candidates[0].tool_id == "l_hook"
    # A letter I has no inner corner: it is no tool for this, however few there are.
    assert {c.tool_id for c in result.candidates} == {"s_hook", "l_hook"}


# ---------------------------------------------------------------- places that are none


def ring(inner):
    """A view of a ring of 8 px stock, inner radius in px of 1 mm."""
    v, u = np.mgrid[0:161, 0:161] - 80.0
    distance = np.hypot(u, v)
    mask = (distance <= inner + 8) & (distance >= inner)
    return CanonicalView(np.where(mask[..., None], 150, 0).astype(np.uint8).repeat(3, axis=2), mask, 0.001, np.eye(4), "side")


@pytest.mark.parametrize(("kind", "family"), [("hooking", "disc"), ("hooking", "bar"), ("hanging", "rod"), ("scooping", "polygon")])
def test_things_without_a_hollow_are_no_tools(matcher, kind, family):
    job = jobs.JOBS[kind]
    source, region = next(iter(job.references.items()))
    radius = float(np.mean(job.targets))
    reference, contact = reference_of(kind, source, region, 5001, radius)
    for seed in range(4):
        tool = matching.Tool(family, plain.view(family, seed, job.view, rough=seed % 2 == 1))
        with pytest.raises(MagicError, match=rf"{family}: .* \(similarity 0\.\d+\): .*allowed") as caught:
            matcher.match_views(reference, contact, [tool], jobs.disc_target(radius, job.view), reference_target_radius=radius)
        assert caught.value.code == Code.NO_MATCH


@pytest.mark.parametrize(("inner", "radius", "fits"), [(20.0, 6.0, True), (30.0, 10.0, True), (10.0, 12.0, False), (8.0, 20.0, False)])
def test_a_hole_takes_no_target_that_is_wider(matcher, inner, radius, fits):
    reference, contact = reference_of("hanging", "hanger", "hook", 5001, 0.006)
    tool, target = matching.Tool("ring", ring(inner)), jobs.disc_target(radius / 1000, "side")
    if fits:
        best = matcher.match_views(reference, contact, [tool], target, reference_target_radius=0.006).candidates[0].tool
        assert best.concave and np.hypot(*(best.pixel - 80)) == pytest.approx(inner, abs=2)
        return
    with pytest.raises(MagicError) as caught:
        matcher.match_views(reference, contact, [tool], target, reference_target_radius=0.006)
    assert caught.value.code == Code.NO_MATCH
    # The inside of the ring itself: what is refused there is the room, to the millimetre.
    c = contour.extract(tool.view.mask)
    index = c.nearest((80.0, 80.0 - inner))
    asked = plausible.demands(reference, 0.0)
    given = (c, c.points[[index]], c.normals[[index]], np.array([True]), np.array([0.9]), radius, 0.001)
    (refusal,) = plausible.refusals(asked, *given)
    assert refusal.what == "radius of the free room" and float(refusal.value.split()[0]) == pytest.approx(inner, abs=1.0)
    assert f"{radius:.1f} mm" in refusal.allowed


def test_the_sign_is_the_references(matcher):
    reference, _ = reference_of("hanging", "hanger", "hook", 5001, 0.006)
    c = contour.extract(ring(20.0).mask)
    outside = c.nearest((80.0, 52.0))
    given = (c, c.points[[outside]], c.normals[[outside]], np.array([False]), np.array([0.9]), 6.0, 0.001)
    (refusal,) = plausible.refusals(plausible.demands(reference, 0.0), *given)
    assert refusal.value == "convex" and refusal.allowed.startswith("concave")
    # Called concave by mistake it is still no hollow for the target.
    (refusal,) = plausible.refusals(plausible.demands(reference, 0.0), *given[:3], np.array([True]), *given[4:])
    assert refusal.what == "depth of the hollow" and float(refusal.value.split()[0]) < 0.5
    # A convex contact asks neither for room nor for a hollow.
    bump = make_reference(ring(20.0), np.array([80.0, 52.0]), target_radius=6.0)
    assert plausible.demands(bump, 0.3) == plausible.Demands(False, 0.3, None, None)


def test_a_shallow_hollow_will_do_where_a_simulation_judges(matcher):
    # A disc of 40 px on a bar lies against a step of 10 px: their normals are 41 degrees apart, and led along one 30 degrees from the
    # step's the disc climbs over it by 1 - cos 30 = 0.134 radii.
    v, u = np.mgrid[0:200, 0:400]
    mask = ((v >= 100) & (v < 140) & (u >= 20) & (u < 360)) | ((v >= 90) & (v < 100) & (u >= 300) & (u < 360))
    radius, c = 40.0, contour.extract(mask)
    normal = np.array([[-np.sin(np.deg2rad(11.4)), -np.cos(np.deg2rad(11.4))]])
    point = np.array([[300 - np.sqrt(40.0**2 - 30.0**2), 60.0]]) - radius * normal
    reference, _ = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    asked = replace(plausible.demands(reference, 0.0), gap=None)
    given = (c, point, normal, np.array([True]), np.array([0.9]), radius, 0.001)
    assert asked.hollow == pytest.approx(0.2)
    (refusal,) = plausible.refusals(asked, *given)
    assert refusal.what == "depth of the hollow" and float(refusal.value.split()[0]) == pytest.approx(40 * 0.134, abs=1.0)
    assert plausible.refusals(plausible.lesser(asked), *given) == [None]
    # Led the other way it rolls off the bar, however little is asked for.
    (refusal,) = plausible.refusals(plausible.lesser(asked), c, point, normal * [-1.0, 1.0], *given[3:])
    assert refusal.what == "depth of the hollow"
    assert plausible.lesser(plausible.Demands(True, 0.3, None, None)).hollow is None


def test_a_place_that_shows_less_is_held_as_surely(matcher):
    """A bar with a wide head, and a disc twice as large as the step between them: however like the demonstrated one it is said to be, it is
    pulled towards the step's end."""
    mask = np.zeros((500, 500), bool)
    mask[200:230, 60:300] = mask[178:230, 300:400] = True
    view = CanonicalView(np.zeros((500, 500, 3), np.uint8), mask, 0.001, np.eye(4), "top")
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    task = matcher._task(reference, contact, jobs.disc_target(0.045, "top"), 0.025, 3)
    places = [Proposal(np.array([299.0, 200.0]), 0.0, False, share * matcher.backend.floor) for share in (1.1, 0.9)]
    tool, shape = matching.Tool("tool", view), contour.extract(mask)
    alike, less = matcher._refine(task, tool, view, shape, 45.0, places, plausible.lesser(task.asked))[0]
    np.testing.assert_allclose(less.tool.normal, alike.tool.normal)
    assert np.degrees(np.arctan2(-alike.tool.normal[1], -alike.tool.normal[0])) > 58, "13 degrees and more past the corner's bisector"


def test_other_views_make_up_the_candidates(matcher):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    tools, target = [matching.Tool("same", reference.view)], jobs.disc_target(0.025, "top")
    one = matcher.match_views(reference, contact, tools, target, 1, reference_target_radius=0.025).candidates[0]

    def seen(*candidates):
        """Candidates by place, m along x, turn of the view about the normal, degrees, and score."""
        found = []
        for x, turn, score in candidates:
            frame = transforms.make(translation=[x, 0, 0]) @ transforms.from_rotvec([np.deg2rad(turn), 0, 0])
            found.append(replace(one, score=score, tool=replace(one.tool, object_from_contact=frame)))
        return matching._Seen(reference.view, found, None, None)

    best = seen((0.0, 0, 0.5))
    # The same place seen a little askew, and from behind, is no other; held across it is one, and so is another place.
    others = [(seen((0.001, 20, 0.6), (0.0, 180, 0.58)), False), (seen((0.0, 90, 0.55), (0.05, 0, 0.4)), False)]
    others.append((seen((0.1, 0, 0.45), (0.2, 0, 0.3)), False))
    more = matching._further(best, others, 0.01, 4)
    assert [(c.tool.object_from_contact[0, 3], c.score) for c in more] == [(0.0, 0.5), (0.05, 0.4), (0.1, 0.4)]
    assert matching._further(best, others, 0.01, 1) == []
    # As the tool stands, a little askew from the best view, it is one as well.
    more = matching._further(best, [(seen((0.001, 20, 0.6), (0.0, 0, 0.6)), True)], 0.01, 4)
    assert [(c.tool.object_from_contact[0, 3], c.score) for c in more] == [(0.001, 0.5)]


# ---------------------------------------------------------------- tools in any attitude


@pytest.mark.parametrize(("family", "regions"), [("mug", ("handle", "handle_loop")), ("hanger", ("hook",)), ("s_hook", ("upper", "lower"))])
def test_the_contact_follows_the_tool_in_any_attitude(matcher, demonstration, family, regions):
    shown = jobs.example("hanging", "hanger", 5001)
    found = replace(
        demonstration,
        view="side",
        tool_view=shown.view,
        tool_contact=shown.contact("hook"),
        target_view=jobs.disc_target(0.006, "side").view,
        target_contact=jobs.disc_target(0.006, "side").contact,
    )
    made = shapes.make(family, 4)
    target = jobs.disc_target(0.006, "side").view
    for angles in ((0, 0, 0), (np.pi / 2, 0, 0.3), (0, np.pi / 2, 1.0), (2.0, -0.7, 0.4)):
        turn = transforms.from_rpy(*angles, (0.1, -0.2, 0.05))
        mesh, pieces = made.mesh.transformed(turn), tuple(piece.transformed(turn) for piece in made.pieces)
        item = SceneObject("tool", mesh, pieces, np.eye(4), find_view(mesh, pieces))
        result = matcher.match(replace(found, target_normal=np.array([1.0, 0, 0])), [item], target, 1)
        place = (transforms.inverse(turn) @ result.candidates[0].tool.object_from_contact)[:3, 3]
        assert min(float(made.region(name).distance(place)[0]) for name in regions if name in made.regions) < 0.004
        # The picture in which it was found can be drawn again from the contact alone.
        again = view_of_contact(item, "side", result.candidates[0].tool.object_from_contact)
        assert (again.mask == result.views["tool"].mask).mean() > 0.999


# ---------------------------------------------------------------- several contacts


def trough(bump: float, fillet: int = 0) -> CanonicalView:
    """A U of one thickness, 260 px wide, with a round bump of 12 px under its floor at a share of the width, its right inner corner
    rounded."""
    mask = np.zeros((384, 384), bool)
    mask[120:260, 62:322] = True
    mask[120:230, 92:292] = False
    v, u = np.mgrid[:384, :384]
    mask |= np.hypot(u - (62 + 260 * bump), v - 259) < 12
    mask |= (u > 292 - fillet) & (u < 292) & (v > 230 - fillet) & (v < 230) & (np.hypot(u - 292 + fillet, v - 230 + fillet) > fillet)
    return CanonicalView(np.where(mask[..., None], 150, 0).astype(np.uint8).repeat(3, axis=2), mask, 0.001, np.eye(4), "top")


def test_the_second_contact_decides_against_what_the_first_alone_prefers(matcher):
    shown = trough(0.25)

    def part(pixel):
        reference = make_reference(shown, np.array(pixel, float))
        return reference, matching.to_contact(shown, curvature.estimate(reference.contour, reference.contour.nearest(reference.pixel)))

    (corner, contact), (bump, below) = part((92, 229)), part((62 + 0.25 * 260, 271))
    further = [matching.Further("bump", bump, below, None)]
    tool = matching.Tool("t", trough(0.75, 30))  # the reference mirrored, but for the corner that should be found
    alone = matcher.match_views(corner, contact, [tool], None, 4).candidates
    assert np.hypot(*(alone[0].tool.pixel - [92, 229])) < 12
    both = matcher.match_views(corner, contact, [tool], None, 4, further=further).candidates
    assert np.hypot(*(both[0].tool.pixel - [283, 221])) < 12 and both[0].flipped
    assert np.hypot(*(both[0].companions[0].tool.pixel - [62 + 0.75 * 260, 271])) < 6 and both[0].companions[0].name == "bump"
    left = max(c.score for c in both if np.hypot(*(c.tool.pixel - [92, 229])) < 12)
    assert both[0].score > left + 0.03
    # Turned in the picture, the companion follows.
    view, linear, middle = moved(tool.view, 2.0, False)
    turned = matcher.match_views(corner, contact, [matching.Tool("t", view)], None, 1, further=further).candidates[0]
    for pixel, at in ((turned.tool.pixel, (283, 221)), (turned.companions[0].tool.pixel, (62 + 0.75 * 260, 271))):
        assert np.hypot(*(pixel - (linear @ (np.array(at) - middle) + middle + 100))) < 12


def test_a_tool_without_the_second_contact_is_refused(matcher):
    shown = trough(0.25)
    corner = make_reference(shown, np.array([92.0, 229.0]))
    contact = matching.to_contact(shown, curvature.estimate(corner.contour, corner.contour.nearest(corner.pixel)))
    # The second place is concave, which a disc is nowhere; the first is asked of a disc as a place outside.
    disc = moved(trough(0.5), 0.0, False)[0]
    v, u = np.mgrid[: disc.mask.shape[0], : disc.mask.shape[1]]
    round_tool = replace(disc, mask=np.hypot(u - 280, v - 280) < 100)
    outside = make_reference(shown, np.array([62.0 + 0.25 * 260, 271.0]))
    below = matching.to_contact(shown, curvature.estimate(outside.contour, outside.contour.nearest(outside.pixel)))
    with pytest.raises(MagicError) as error:
        matcher.match_views(
            outside, below, [matching.Tool("disc", round_tool)], None, 3, further=[matching.Further("corner", corner, contact, None)]
        )
    assert error.value.code is Code.NO_MATCH and "corner" in error.value.message


# ---------------------------------------------------------------- targets


def plate_with_notch(at: float, radius: float = 0.011):
    """A plate 0.06 x 0.1 m lying, with a round notch in its far side (+x), at a place along that side (m)."""
    outline = shapely.box(-0.03, -0.05, 0.03, 0.05).difference(shapely.Point(0.03, at).buffer(radius))
    return from_trimesh(trimesh.creation.extrude_polygon(outline, 0.02))


def as_target(mesh, yaw=0.0):
    pose = transforms.from_rpy(0, 0, yaw, (0.5, 0.1, 0.0))
    return SceneObject("o", mesh, (mesh,), pose, find_view(mesh, None, "top"), source="known")


@pytest.mark.parametrize(("at", "yaw"), [(0.02, 0.0), (-0.03, 0.0), (0.01, 0.3), (-0.025, -0.35)])
def test_a_target_is_met_at_the_feature_that_was_shown(matcher, demonstration, at, yaw):
    shown = as_target(plate_with_notch(-0.015))
    strategy = replace(demonstration, target_outline="feature", target_normal=np.array([1.0, 0.0, 0.0]))
    seen = matching.target_view(shown, strategy)
    floor = seen.pixels([0.019, -0.015, 0.0])
    edge = contour.extract(seen.mask)
    contact = matching.to_contact(seen, curvature.estimate(edge, edge.nearest(floor)))
    strategy = replace(strategy, target_view=seen, target_contact=contact)
    item = as_target(plate_with_notch(at, 0.013), yaw)
    found = matching.target_contact(strategy, matching.target_view(item, strategy), item.world_from_object, matcher)
    place, normal = found.object_from_contact[:3, 3], found.object_from_contact[:3, 0]
    np.testing.assert_allclose(place[:2], [0.017, at], atol=0.003)
    assert normal[0] > 0.95
    # The rule of the outer side would meet the plate beside the notch.
    beside = matching.target_contact(replace(strategy, target_outline="outer"), seen, np.eye(4))
    assert beside.object_from_contact[0, 3] > 0.028


def test_a_feature_on_the_far_side_of_the_tool_is_no_place(matcher, demonstration):
    shown = as_target(plate_with_notch(0.0))
    strategy = replace(demonstration, target_outline="feature", target_normal=np.array([1.0, 0.0, 0.0]))
    seen = matching.target_view(shown, strategy)
    edge = contour.extract(seen.mask)
    contact = matching.to_contact(seen, curvature.estimate(edge, edge.nearest(seen.pixels([0.019, 0.0, 0.0]))))
    strategy = replace(strategy, target_view=seen, target_contact=contact)
    item = as_target(shown.mesh, 1.5)
    with pytest.raises(MagicError) as error:
        matching.target_contact(strategy, matching.target_view(item, strategy), item.world_from_object, matcher)
    assert error.value.code is Code.NO_MATCH and "30 degrees" in error.value.message


@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.7])
@pytest.mark.parametrize("radius", [0.015, 0.03])
def test_target_contact_lies_on_the_side_asked_for(demonstration, yaw, radius):
    found = demonstration
    item = shapes.make("cylinder", 2, radius=radius).as_object("o", transforms.from_rpy(0, 0, yaw, (0.5, 0.1, 0.02)))
    view = matching.target_view(item, found)
    contact = matching.target_contact(found, view, item.world_from_object)
    world = item.world_from_object @ contact.object_from_contact
    assert world[:3, 0] == pytest.approx([1, 0, 0], abs=0.05)
    assert world[:3, 2] == pytest.approx([0, 0, -1], abs=1e-6)
    assert world[:2, 3] == pytest.approx([0.5 + radius, 0.1], abs=0.002)
    assert contact.radius == pytest.approx(radius, rel=0.06) and not contact.concave


def test_support_point_is_in_the_middle_of_a_flat_side():
    mask = np.zeros((100, 200), bool)
    mask[30:70, 20:180] = True
    c = contour.extract(mask)
    assert c.points[targets.support_point(c, np.array([0.0, -1.0]))] == pytest.approx([99.5, 29.5], abs=1.0)


@pytest.mark.parametrize("angle", np.deg2rad([0.0, 37.0, 90.0, 200.0]))
def test_a_tool_meets_a_ring_at_the_side_of_its_hole_against_which_it_is_led(angle):
    v, u = np.mgrid[0:240, 0:240] - 119.5
    ring = (np.hypot(u, v) <= 100) & (np.hypot(u - 20, v) > 60)
    ring &= np.hypot(u + 75, v) > 8  # a small hole beside the wide one
    direction = np.array([np.cos(angle), np.sin(angle)])
    c = contour.extract(ring)
    at = targets.inner_point(c, direction)
    assert c.points[at] == pytest.approx(np.array([139.5, 119.5]) - 60 * direction, abs=1.5)
    assert c.normals[at] @ direction > 0.99


def test_what_is_open_has_an_inner_side_and_what_is_full_has_none():
    cup = np.zeros((120, 160), bool)
    cup[20:100, 20:140] = True
    cup[20:90, 40:120] = False
    c = contour.extract(cup)
    assert c.points[targets.inner_point(c, np.array([1.0, 0.0]))] == pytest.approx([39.5, 54.5], abs=2.0)
    with pytest.raises(MagicError) as error:
        targets.inner_point(c, np.array([0.0, -1.0]))  # from its bottom one comes into the open
    assert error.value.code == Code.NO_MATCH


def test_a_contact_inside_is_found_in_the_silhouette_or_in_the_cut(demonstration):
    # A ring on the table: from above its hole is seen, from the side only the cut shows it.
    mesh = from_trimesh(trimesh.creation.annulus(0.03, 0.045, 0.02))
    item = SceneObject("ring", mesh, (mesh,), transforms.from_rpy(0, 0, 0.8, (0.5, 0.1, 0.01)), demonstration.target_view)
    for outline, looked in (("inner", [0, 0, -1.0]), ("cut", [0, 1.0, 0])):
        strategy = replace(demonstration, target_outline=outline, target_view_direction=np.array(looked))
        contact = matching.target_contact(strategy, matching.target_view(item, strategy), item.world_from_object)
        world = item.world_from_object @ contact.object_from_contact
        assert world[:3, 3] == pytest.approx([0.47, 0.1, 0.01], abs=0.0015)
        assert world[:3, 0] == pytest.approx([1, 0, 0], abs=0.05)


def test_a_flat_target_and_one_met_inside_have_no_radius_to_compare(matcher):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    tool = matching.Tool("c", jobs.example("hooking", "caliper", 4).view)
    target = jobs.disc_target(0.02, "top")
    plain = matcher.match_views(reference, contact, [tool], None, 3)
    for change in ({"radius": np.inf}, {"concave": True}):
        met = replace(target, contact=replace(target.contact, **change))
        result = matcher.match_views(reference, contact, [tool], met, 3, reference_target_radius=float("inf"))
        assert [c.score for c in result.candidates] == pytest.approx([c.score for c in plain.candidates])
        assert all(np.isfinite(c.score) for c in result.candidates)


def test_target_and_tools_are_chosen_where_none_is_named(demonstration):
    found = demonstration
    items = [
        shapes.make(family, 4).as_object(f"{family}", transforms.make(translation=(0.4, 0.1 * k, 0.02)))
        for k, family in enumerate(("caliper", "cylinder", "l_hook"))
    ]
    scene = Scene(tuple(items), np.array([0, 0, 1.0, 0]))
    tools, target = matching.select(scene, found, [], "")
    assert target.id == "cylinder" and [t.id for t in tools] == ["caliper", "l_hook"]
    tools, target = matching.select(scene, found, ["l_hook"], "")
    assert target.id == "cylinder" and [t.id for t in tools] == ["l_hook"]
    for ids, name, code in (
        (["nothing"], "", Code.UNKNOWN_OBJECT),
        ([], "nothing", Code.UNKNOWN_OBJECT),
        (["cylinder"], "cylinder", Code.BAD_REQUEST),
    ):
        with pytest.raises(MagicError) as caught:
            matching.select(scene, found, ids, name)
        assert caught.value.code == code
    result = matching.match(found, tools, target, features.load("embedded"))
    assert result.target_id == "cylinder" and result.candidates[0].target.radius > 0
    # Nothing is planned below a hand.
    with pytest.raises(MagicError) as caught:
        matching.select(Scene((replace(items[0], hanging=True), *items[1:]), scene.table), found, [], "")
    assert caught.value.code == Code.SOMETHING_HANGS
    # What is seen in part is no tool: not chosen, and refused by name.
    part = Scene((replace(items[0], cut_off=("picture", "l_hook")), *items[1:]), scene.table)
    tools, _ = matching.select(part, found, [], "cylinder")
    assert [t.id for t in tools] == ["l_hook"]
    for ids in (["caliper"], ["l_hook", "caliper"]):
        with pytest.raises(MagicError, match="caliper, cut off by picture and l_hook") as caught:
            matching.select(part, found, ids, "cylinder")
        assert caught.value.code == Code.OBJECT_CUT_OFF
    with pytest.raises(MagicError, match="caliper") as caught:
        matching.select(Scene((part.objects[0], items[1]), scene.table), found, [], "cylinder")
    assert caught.value.code == Code.OBJECT_CUT_OFF


def test_codes_of_bad_views(matcher):
    reference, contact = reference_of("hooking", "l_hook", "inner", 3, 0.025)
    empty = CanonicalView(np.zeros((50, 50, 3), np.uint8), np.zeros((50, 50), bool), 1.0, np.eye(4))
    with pytest.raises(MagicError) as caught:
        matcher.match_views(reference, contact, [matching.Tool("e", empty)], None)
    assert caught.value.code == Code.EMPTY_MASK
    for pixel in ((500, 10), (np.nan, 1), (5, 380)):
        with pytest.raises(MagicError) as caught:
            make_reference(reference.view, np.array(pixel, dtype=float))
        assert caught.value.code == Code.POINT_OUTSIDE


def test_cache_keeps_and_survives_damage(tmp_path):
    cache = Cache(tmp_path)
    calls = []
    assert cache.get("a", lambda: calls.append(1) or {"x": 1}) == {"x": 1}
    assert cache.get("a", lambda: calls.append(1) or {"x": 2}) == {"x": 1} and len(calls) == 1
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    # A damaged pickle may yield another value, or crash the process: it must not be read at all.
    for count, damaged in enumerate(
        (b"not a pickle", b"", whole[:-5], whole.replace(b"x", b"y", 1) + b".", whole[:-4] + b"\x07" + whole[-3:]), 2
    ):
        path.write_bytes(damaged)
        assert cache.get("a", lambda: calls.append(1) or {"x": 1}) == {"x": 1} and len(calls) == count
        assert path.read_bytes() == whole


def test_the_cache_keeps_no_more_than_it_may_and_nothing_of_other_code(tmp_path, monkeypatch):
    from magic_matcher import cache as module

    monkeypatch.setattr(module, "KEPT", 3)
    kept = Cache(tmp_path)
    for k in range(6):
        assert kept.get(f"key {k}", lambda k=k: k) == k
    assert len(list(tmp_path.glob("*.pickle"))) == 3
    assert kept.get("key 5", lambda: "made anew") == 5
    monkeypatch.setattr(module, "code", lambda: "another version")
    assert kept.get("key 5", lambda: "made anew") == "made anew"
