"""Matching from picture files: masks from plain backgrounds, the command, its errors."""

import json
import os

import cv2
import numpy as np
import pytest

from magic_core import shapes
from magic_core.errors import Code, MagicError
from magic_matcher import images, match_images


def picture(view, background=(235, 232, 228), noise=2.0):
    random = np.random.default_rng(0)
    image = np.where(view.mask[..., None], view.image, np.array(background, np.uint8))
    return np.clip(image + random.normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def write(path, image):
    cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)
    return str(path)


@pytest.mark.parametrize("background", [(235, 232, 228), (0, 0, 0), (30, 90, 200)])
def test_mask_from_a_plain_background(background):
    view = shapes.make("mug", 3).view()
    mask = images.mask_from_background(picture(view, background))
    assert (mask & view.mask).sum() / (mask | view.mask).sum() > 0.9


def test_mask_from_background_is_not_moved():
    image = np.full((60, 80, 3), 220, np.uint8)
    image[20:41, 30:52] = 40
    image[5, 10:60] = 40  # a line is no object
    mask = images.mask_from_background(image)
    assert np.array_equal(np.argwhere(mask).min(axis=0), [20, 30]) and np.array_equal(np.argwhere(mask).max(axis=0), [40, 51])


def test_mask_from_transparency():
    image = np.zeros((40, 40, 4), np.uint8)
    image[10:30, 10:30, 3] = 255
    assert images.mask_from_background(image).sum() == 400


def test_an_object_of_the_background_s_colour_is_found_by_its_outline():
    view = shapes.make("l_hook", 3).view()
    inner = cv2.erode(view.mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    image = np.full((*view.mask.shape, 3), 200, np.uint8)
    image[view.mask & ~inner] = 188  # an outline, fainter than the difference in colour that is asked for
    mask = images.mask_from_background(image)
    assert (mask & view.mask).sum() / (mask | view.mask).sum() > 0.85


@pytest.mark.parametrize("kind", ["grey", "16 bits", "12 bits", "float", "alpha", "mask of ones", "mask with alpha"])
def test_formats_of_files(tmp_path, kind):
    view = shapes.make("caliper", 3).view()
    image, path, mask = picture(view), tmp_path / "p.png", None
    if kind == "grey":
        cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    elif kind == "16 bits":
        cv2.imwrite(str(path), image[..., ::-1].astype(np.uint16) * 257)
    elif kind == "12 bits":
        cv2.imwrite(str(path), image[..., ::-1].astype(np.uint16) * 16)
    elif kind == "float":
        path = tmp_path / "p.tiff"
        cv2.imwrite(str(path), image[..., ::-1].astype(np.float32) / 255)
    elif kind == "alpha":
        cv2.imwrite(str(path), np.dstack([image[..., ::-1], view.mask.astype(np.uint8) * 255]))
    else:
        write(path, image)
        mask = tmp_path / "m.png"
        on = view.mask.astype(np.uint8)
        cv2.imwrite(str(mask), on if kind == "mask of ones" else np.dstack([on * 0 + 255] * 3 + [on * 255]))
    found = images.view(path, mask)
    assert found.image.dtype == np.uint8 and found.image.shape == (*view.mask.shape, 3)
    assert (found.mask & view.mask).sum() / (found.mask | view.mask).sum() > 0.9


@pytest.mark.parametrize("content", [b"", b"no picture", None])
def test_unreadable_files_have_a_code(tmp_path, content):
    path = tmp_path / "x.png"
    path.mkdir() if content is None else path.write_bytes(content)
    for work in (lambda: images.read(path), lambda: images.read_mask(path, (9, 9))):
        with pytest.raises(MagicError) as caught:
            work()
        assert caught.value.code == Code.BAD_REQUEST_IMAGE


def test_a_busy_background_is_refused():
    random = np.random.default_rng(0)
    for image in (random.integers(0, 255, (100, 100, 3), dtype=np.uint8), np.full((100, 100, 3), 90, np.uint8)):
        with pytest.raises(MagicError) as caught:
            images.mask_from_background(image)
        assert caught.value.code == Code.EMPTY_MASK and "mask" in caught.value.message


def test_the_command_writes_match_json_and_a_picture(tmp_path):
    hook, caliper = shapes.make("l_hook", 3), shapes.make("caliper", 4)
    first, second = hook.view(), caliper.view()
    u, v = hook.contact("inner", first).pixel
    arguments = ["--reference", write(tmp_path / "r.png", picture(first)), "--reference-point", str(u), str(v)]
    arguments += ["--target", write(tmp_path / "t.png", picture(second)), "--top", "2", "--out", str(tmp_path / "out")]
    match_images.main(arguments)
    data = json.loads((tmp_path / "out" / "match.json").read_text())
    assert len(data["candidates"]) == 2 and os.path.getsize(tmp_path / "out" / "match.png") > 1000
    best = data["candidates"][0]
    assert set(best) >= {"pixel", "normal", "radius", "scale", "score", "s_dino", "s_curv", "rotation", "flipped", "concave"}
    heat = cv2.imread(str(tmp_path / "out" / "heatmap.png"), cv2.IMREAD_UNCHANGED)
    assert heat.shape == second.mask.shape and heat.max() > 128
    assert data["target"]["size"] == [384, 384] and data["reference"]["concave"] and data["reference"]["scale"] > 0
    # target_from_reference carries the reference pixel onto the candidate's
    planar = np.array(best["target_from_reference"])
    assert planar @ [*data["reference"]["pixel"], 1] == pytest.approx([*best["pixel"], 1], abs=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"--reference": "missing.png"}, "missing.png"),
        ({"--reference-mask": "small.png"}, "size of mask"),
        ({"--target-mask": "black.png"}, "EMPTY_MASK"),
        ({"--reference-point": ("900", "10")}, "POINT_OUTSIDE"),
        ({"--reference-point": ("5", "370")}, "POINT_OUTSIDE"),
        ({"--reference-point": ("nan", "10")}, "POINT_OUTSIDE"),
        ({"--target": "."}, "BAD_REQUEST_IMAGE"),
        ({"--out": "r.png"}, "r.png"),
        ({"--features": "dinov2"}, "FEATURE_WEIGHTS"),
        ({"--top": "0"}, "top_k"),
    ],
)
def test_errors_are_one_line_and_status_2(tmp_path, capsys, monkeypatch, change, said):
    monkeypatch.chdir(tmp_path)
    view = shapes.make("l_hook", 3).view()
    u, v = shapes.make("l_hook", 3).contact("inner", view).pixel
    write("r.png", picture(view))
    write("small.png", np.full((9, 9), 255, np.uint8))
    write("black.png", np.zeros(view.mask.shape, np.uint8))
    options = {"--reference": "r.png", "--reference-point": (str(u), str(v)), "--target": "r.png", "--out": "out", **change}
    with pytest.raises(SystemExit) as caught:
        match_images.main([x for key, value in options.items() for x in (key, *((value,) if isinstance(value, str) else value))])
    assert caught.value.code == 2
    error = capsys.readouterr().err.strip()
    assert said in error and len(error.splitlines()) == 1


def test_large_pictures_are_matched_small_and_answered_at_full_size(tmp_path):
    hook, mug = shapes.make("l_hook", 3), shapes.make("mug", 4)
    first, second = hook.view(), mug.view("side")
    factor, found = 4, {}
    point = hook.contact("inner", first).pixel
    for name, f in (("small", 1), ("large", factor)):
        # Nearest neighbours, so that a pixel becomes a block and both are the same shape; the larger one stands in a wide picture.
        grown = [np.kron(view.mask, np.ones((f, f), bool)) for view in (first, second)]
        shown = [np.where(m[..., None], (120, 110, 100), (235, 232, 228)).astype(np.uint8) for m in grown]
        shift = np.array([700, 40]) if f > 1 else np.zeros(2)
        if f > 1:
            shown[1] = np.pad(shown[1], ((40, 0), (700, 0), (0, 0)), mode="edge")
        u, v = (point + 0.5) * f - 0.5
        arguments = ["--reference", write(tmp_path / f"r{f}.png", shown[0]), "--reference-point", str(u), str(v)]
        match_images.main([*arguments, "--target", write(tmp_path / f"t{f}.png", shown[1]), "--out", str(tmp_path / name)])
        found[name] = json.loads((tmp_path / name / "match.json").read_text()), shift
        heat = cv2.imread(str(tmp_path / name / "heatmap.png"), cv2.IMREAD_UNCHANGED)
        assert heat.shape == shown[1].shape[:2]
    (small, _), (large, shift) = found["small"], found["large"]
    assert (
        small["target"]["block"] == 1
        and large["target"]["block"] == 2
        and large["reference"]["mask_pixels"] == 16 * small["reference"]["mask_pixels"]
    )
    a, b = small["candidates"][0], large["candidates"][0]
    # Beside the way of sampling, the same place: within a few steps of the described points.
    assert (np.array(b["pixel"]) - shift + 0.5) / factor - 0.5 == pytest.approx(np.array(a["pixel"]), abs=8)
    assert b["radius"] / factor == pytest.approx(a["radius"], rel=0.15) and np.dot(a["normal"], b["normal"]) > 0.97
    # On the edge of the file's own mask.
    mask = cv2.imread(str(tmp_path / "t4.png"))[..., 0] < 180
    inside, outside = (np.rint(np.array(b["pixel"]) + s * 2.0 * np.array(b["normal"])).astype(int) for s in (-1, 1))
    assert mask[inside[1], inside[0]] and not mask[outside[1], outside[0]]


def test_view_and_file_pixels_agree(tmp_path):
    mask = np.zeros((1500, 2100), np.uint8)
    cv2.circle(mask, (1203, 702), 600, 255, -1)
    path = write(tmp_path / "m.png", mask)
    picture_ = images.load(path, path)
    points = np.random.default_rng(0).uniform(0, 1400, (5, 2))
    assert picture_.block == 2 and picture_.to_file(picture_.to_view(points)) == pytest.approx(points)
    centre = np.array([np.nonzero(picture_.view.mask.any(axis=axis))[0].mean() for axis in (0, 1)])
    assert picture_.to_file(centre) == pytest.approx([1203, 702], abs=1)
    out = np.array([0.6, 0.8])
    for off in (-3.0, 0.0, 2.5):
        edge = picture_.on_edge(np.array([1203, 702]) + (600 + off) * out, out)
        assert np.hypot(*(edge - [1203, 702])) == pytest.approx(600, abs=1.0)
