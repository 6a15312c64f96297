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


def test_mask_from_transparency():
    image = np.zeros((40, 40, 4), np.uint8)
    image[10:30, 10:30, 3] = 255
    assert images.mask_from_background(image).sum() == 400


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
