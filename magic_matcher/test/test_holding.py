"""Discs pressed against shapes for which the answer is plain; the bench and the meshes' command run."""

import json

import cv2
import numpy as np
import pytest

from magic_core import shapes
from magic_core.errors import MagicError
from magic_matcher import bench, contour, embedded, holding, jobs, match_meshes


def at(mask, pixel, normal, radius):
    edge = contour.extract(mask)
    index = edge.nearest(pixel)
    return holding.hold(edge, edge.points[index][None], np.array([normal], float) / np.hypot(*normal), radius)


@pytest.fixture(scope="module")
def corner():
    """An L of 20 px strokes: the inner corner at (79.5, 79.5), arms 170 px long."""
    mask = np.zeros((300, 300), bool)
    mask[60:80, 60:250] = True
    mask[60:250, 60:80] = True
    return mask


@pytest.mark.parametrize("radius", [10.0, 25.0])
def test_an_inner_corner_holds_as_deep_as_its_arms_rise(corner, radius):
    held = at(corner, (79.5, 79.5), (1, 1), radius)
    assert held.gap[0] == pytest.approx(np.sqrt(2) - 1, abs=0.12)
    assert held.drift[0] < 0.2
    # From the corner to where the disc's centre passes the end of an arm, along the diagonal: more than the arm itself, less a radius.
    assert held.press[0, 0] * radius > (170 - radius) / np.sqrt(2) - 5


def wedge(half):
    """Two arms of 200 px from (250, 250), that open downwards by twice ``half`` degrees."""
    mask = np.zeros((500, 500), np.uint8)
    for side in (-1, 1):
        end = (round(250 + side * 200 * np.sin(np.deg2rad(half))), round(250 + 200 * np.cos(np.deg2rad(half))))
        cv2.line(mask, (250, 250), end, 1, 16)
    return contour.extract(mask > 0)


@pytest.mark.parametrize(("radius", "hangs"), [(20.0, False), (40.0, False), (20.0, True)])
def test_a_disc_lies_between_the_arms_of_a_v_far_from_its_corner(radius, hangs):
    shape = wedge(25.0)
    found = holding.pockets(shape, radius, holding.centres(holding.room(shape, radius), radius), 0.2, hangs)
    # The arms' inner edges meet half their width over the sine further down.
    centre = 250 + (radius + 8) / np.sin(np.deg2rad(25.0))
    best = found[0]
    assert best.centre == pytest.approx([249.5, centre], abs=4)
    assert best.out @ [0, 1] > 0.99
    assert all(np.hypot(*(a.centre - b.centre)) > radius for i, a in enumerate(found) for b in found[:i])


def test_a_bar_and_a_disc_have_no_pockets():
    bar, round_one = np.zeros((300, 300), bool), np.zeros((300, 300), np.uint8)
    bar[140:160, 40:260] = True
    cv2.circle(round_one, (150, 150), 90, 1, -1)
    for mask in (bar, round_one > 0):
        shape = contour.extract(mask)
        curves = holding.centres(holding.room(shape, 25.0), 25.0)
        assert not holding.pockets(shape, 25.0, curves, 0.1)
        assert not holding.pockets(shape, 25.0, curves, 0.1, True)


def stepped(shoulder):
    """A bar with a wide head: at (300, 200) the inner corner whose one arm is the bar, the other a shoulder of so many pixels."""
    mask = np.zeros((500, 500), bool)
    mask[200:230, 60:300] = True
    mask[200 - shoulder : 230, 300:400] = True
    return contour.extract(mask)


@pytest.mark.parametrize("radius", [30.0, 45.0])
def test_a_large_disc_in_a_small_corner_is_pulled_towards_its_shorter_arm(radius):
    shape, bisector = stepped(22), np.array([-1.0, -1.0]) / np.sqrt(2)
    corner = shape.points[shape.nearest((300.0, 200.0))]
    around = holding.room(shape, radius)
    point, normal = holding.steadied(shape, corner, bisector, radius, holding.centres(around, radius), 0.2)
    # It is held between the bar's normal and that of the shoulder's end, and the disc touches both.
    end = np.degrees(np.arcsin((radius - 22) / radius))
    angle = np.degrees(np.arctan2(-normal[1], -normal[0]))
    assert end + 30 < angle < 90 - 5
    assert point[1] == pytest.approx(200, abs=2) and 300 - 1.5 * radius < point[0] < 300
    before, after = (holding.hold(shape, p[None], n[None], radius, around).press[0, 0] for p, n in ((corner, bisector), (point, normal)))
    assert after > 1.5 * before


def test_where_a_contact_holds_its_own_normal_stays():
    deep = stepped(90)
    curves = holding.centres(holding.room(deep, 30.0), 30.0)
    bisector = np.array([-1.0, -1.0]) / np.sqrt(2)
    place = deep.points[deep.nearest((300.0, 200.0))]
    assert holding.steadied(deep, place, bisector, 30.0, curves, 0.2) is None
    # On the bar's long side there is no hollow within reach, however it is turned.
    side = deep.points[deep.nearest((120.0, 200.0))]
    assert holding.steadied(deep, side, np.array([0.0, -1.0]), 30.0, curves, 0.2) is None


def hollow(left, short, right, far):
    """Two arms from (350, 300), of so many pixels, that rise by so many degrees."""
    mask = np.zeros((500, 700), np.uint8)
    ends = [
        (350 + sign * n * np.cos(a), 300 - n * np.sin(a)) for sign, a, n in ((-1, np.deg2rad(left), short), (1, np.deg2rad(right), far))
    ]
    corners = [ends[0], (350, 300), ends[1], (ends[1][0], 450), (ends[0][0], 450)]
    cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 1)
    return contour.extract(mask > 0)


@pytest.mark.parametrize(
    ("arms", "turned"),
    [
        # Pulls from 8 degrees to one side to 22 to the other are borne, none and 15 to either side of it: the middle is best.
        ((8, 150, 22, 150), -7),
        # Of a short steep arm and a long slight one the short one is the lower side of a pull towards it, and the long one, where the disc
        # still is at its place, of one away from it.
        ((40, 25, 12, 250), 0),
        ((50, 40, 12, 250), 10),
    ],
)
def test_in_a_shallow_hollow_the_pull_is_that_whose_lower_side_is_highest(arms, turned):
    edge, radius, up = hollow(*arms), 60.0, np.array([0.0, -1.0])
    place = edge.points[edge.nearest((350.0, 300.0))]
    found = holding.steadied(edge, place, up, radius, holding.centres(holding.room(edge, radius), radius), 0.2)
    normal = up if found is None else found[1]
    assert np.degrees(np.arctan2(normal[0], -normal[1])) == pytest.approx(turned, abs=3)


def test_a_turned_pull_leaves_a_hollow_as_deep_as_is_asked():
    # Its lower side is highest with the pull turned by 10 degrees, along which it is 0.17 radii deep.
    edge, radius, up = hollow(40, 36, 7, 250), 60.0, np.array([0.0, -1.0])
    place, curves = edge.points[edge.nearest((350.0, 300.0))], holding.centres(holding.room(edge, radius), radius)
    found = holding.steadied(edge, place, up, radius, curves, 0.2)
    assert found is not None and holding.hold(edge, found[0][None], found[1][None], radius).press[0, 0] >= 0.2


def test_of_a_shallow_hollow_a_tool_that_is_led_along_and_up_is_turned_to_the_middle_of_the_pulls_that_it_bears():
    edge, radius, up = hollow(8, 150, 22, 150), 60.0, np.array([0.0, -1.0])
    place, curves = edge.points[edge.nearest((350.0, 300.0))], holding.centres(holding.room(edge, radius), radius)
    _, normal = holding.steadied(edge, place, up, radius, curves, 0.2, straight=False)
    assert np.degrees(np.arctan2(normal[0], -normal[1])) == pytest.approx(-7, abs=3)


def test_sides_tips_and_outer_corners_do_not_hold(corner):
    for pixel, normal in (((59.5, 59.5), (-1, -1)), ((60, 150), (-1, 0)), ((249.5, 70), (1, 0))):
        held = at(corner, pixel, normal, 15.0)
        assert held.press[0, 0] < 0.2 or held.drift[0] > 1


def test_a_closed_ring_holds_where_the_disc_fits_only():
    v, u = np.mgrid[0:300, 0:300] - 149.5
    distance = np.hypot(u, v)
    ring = (distance < 120) & (distance > 100)
    inside = at(ring, (150, 49), (0, 1), 30.0)
    assert inside.gap[0] < 0.1 and inside.drift[0] < 0.2 and inside.press[0, 0] > 2
    tight = at(ring, (150, 49), (0, 1), 104.0)
    assert not (tight.gap[0] <= jobs.GAP and tight.press[0, 0] >= jobs.DEPTH)


def test_an_open_hook_hangs_by_its_inside_only():
    shape = shapes.make("hanger", 3)
    view = shape.view("side")
    edge = contour.extract(view.mask)
    tool = jobs.example("hanging", "hanger", 3)
    contact = shape.contact("hook", view)
    radius = 0.006 / view.metres_per_pixel
    assert tool.works(contact.pixel[None], contact.normal[None], radius)[0]
    lowest = int(np.argmax(edge.points[:, 1]))  # the outside of the bar
    assert not tool.works(edge.points[lowest][None], edge.normals[lowest][None], radius)[0]


def test_no_room_at_all_is_said():
    mask = np.ones((64, 64), bool)
    mask[28:36, 28:36] = False
    held = at(mask, (31.5, 27.5), (0, 1), 12.0)
    assert held.gap[0] > jobs.GAP


def test_left_out_weights_exist_for_every_family_and_differ():
    shipped = embedded.weights()
    for family in {name for job in jobs.JOBS.values() for name in job.regions}:
        assert not np.array_equal(embedded.weights(family), shipped)
        assert not np.array_equal(embedded.weights(family), embedded.default_weights())


def test_bench_writes_its_three_files(tmp_path):
    bench.main(["--count", "1", "--job", "scooping", "--tool", "spoon", "--out", str(tmp_path)])
    data = json.loads((tmp_path / "bench.json").read_text())
    assert {m["variant"] for m in data["means"]} == {"full", "no two-step", "no curvature", "global only", "shipped"}
    assert "| full | 1 |" in (tmp_path / "bench.md").read_text()
    assert cv2.imread(str(tmp_path / "bench.png")).shape == (bench.TILE, 2 * bench.TILE, 3)


def test_meshes_from_files(tmp_path, capsys):
    trimesh = pytest.importorskip("trimesh")
    for name in ("l_hook", "caliper"):
        mesh = shapes.make(name, 4).mesh
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / f"{name}.obj")
    tool = match_meshes.draw(tmp_path / "l_hook.obj", "top", True)
    point = shapes.make("l_hook", 4).contact("inner", tool.view).pixel
    common = ["--reference", str(tmp_path / "l_hook.obj"), "--kind", "top", "--as-is", "--radius", "0.02", "--out", str(tmp_path / "out")]
    match_meshes.main(
        [*common, "--reference-point", *map(str, point), "--tools", str(tmp_path / "caliper.obj"), str(tmp_path / "l_hook.obj")]
    )
    data = json.loads((tmp_path / "out" / "matches.json").read_text())
    assert [len(row["candidates"]) > 0 for row in data["matches"]] == [True, True]
    assert np.hypot(*(np.array(data["matches"][1]["candidates"][0]["pixel"]) - point)) < 12
    with pytest.raises(SystemExit) as caught:
        match_meshes.main([*common[:-4], "--radius", "nan", "--out", str(tmp_path), "--tools", "x.obj"])
    assert caught.value.code == 2 and "radius" in capsys.readouterr().err
    with pytest.raises(MagicError):
        match_meshes.draw(tmp_path / "nothing.obj", "top", True)


def test_shapes_and_folders_of_meshes(tmp_path, capsys):
    trimesh = pytest.importorskip("trimesh")
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "notes.txt").write_text("no mesh")
    for name in ("a", "b"):
        mesh = shapes.make("l_hook", ord(name)).mesh
        trimesh.Trimesh(mesh.vertices, mesh.faces).export(folder / f"{name}.stl")
    shape = shapes.make("l_hook", 3)
    u, v = shape.contact("inner", shape.view("top")).pixel
    shown = ["--reference", "l_hook:3", "--kind", "top", "--reference-point", str(u), str(v), "--radius", "0.02"]
    match_meshes.main([*shown, "--tools", str(folder), "caliper:7001", "--columns", "2", "--out", str(tmp_path)])
    said = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0].split("/")[-1] for line in said] == ["a.stl", "b.stl", "caliper"] and all("score" in line for line in said)
    sheet = cv2.imread(str(tmp_path / "matches.png"))
    assert sheet.shape[0] == 2 * (192 + 24) and sheet.shape[1] == 2 * 192
    (tmp_path / "empty").mkdir()
    for change in (["--tools", str(tmp_path / "empty")], ["--tools", "caliper:1", "--columns", "-1"]):
        with pytest.raises(SystemExit) as caught:
            match_meshes.main([*shown, *change, "--out", str(tmp_path)])
        assert caught.value.code == 2 and "BAD_REQUEST" in capsys.readouterr().err


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("off", [0.2, 0.4, 0.6])
def test_in_a_wide_bowl_of_few_pixels_the_pull_stays(off, straight):
    # A wide flat bowl, a little askew, and a disc of 17 pixels that it holds when pulled straight: 5 degrees more or less are a matter of
    # its pixels.
    column = np.arange(200)
    floor = 70 - 0.0024 * (column - 100 - off) ** 2 + 0.06 * (column - 100)
    floor[(column <= 20) | (column >= 180)] = 40
    edge = contour.extract((np.arange(120)[:, None] >= np.round(floor)) & (np.arange(120)[:, None] < 95))
    place, radius = edge.points[edge.nearest((100.0, 70.0))], 17.0
    curves = holding.centres(holding.room(edge, radius), radius)
    assert holding.steadied(edge, place, np.array([0.0, -1.0]), radius, curves, 0.2, straight) is None
