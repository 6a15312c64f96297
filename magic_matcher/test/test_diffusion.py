"""Diffusion features on small random models: loading, shapes, repeatability, refusals."""

import json

import numpy as np
import pytest

pytest.importorskip("torch")

from magic_core.errors import Code, MagicError
from magic_matcher import features


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A Stable Diffusion pipeline of a few thousand weights, and a DINOv2."""
    diffusers = pytest.importorskip("diffusers")
    import torch
    import transformers

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("diffusion")
    (folder / "vocab.json").write_text(json.dumps({"!": 0, "<|startoftext|>": 1, "<|endoftext|>": 2, "a</w>": 3}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = transformers.CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"))
    tokenizer.save_pretrained(folder / "sd" / "tokenizer")
    words = transformers.CLIPTextConfig(
        vocab_size=4, hidden_size=16, intermediate_size=16, num_hidden_layers=1, num_attention_heads=2, bos_token_id=1, eos_token_id=2
    )
    transformers.CLIPTextModel(words).save_pretrained(folder / "sd" / "text_encoder")
    cross = {"block_out_channels": (8, 8, 16, 16), "layers_per_block": 1, "cross_attention_dim": 16, "norm_num_groups": 4}
    diffusers.UNet2DConditionModel(sample_size=8, attention_head_dim=4, **cross).save_pretrained(folder / "sd" / "unet")
    pieces = {"down_block_types": ["DownEncoderBlock2D"] * 4, "up_block_types": ["UpDecoderBlock2D"] * 4}
    diffusers.AutoencoderKL(block_out_channels=[8] * 4, norm_num_groups=4, **pieces).save_pretrained(folder / "sd" / "vae")
    diffusers.DDIMScheduler().save_pretrained(folder / "sd" / "scheduler")
    config = transformers.Dinov2Config(hidden_size=32, num_hidden_layers=1, num_attention_heads=4, image_size=224, patch_size=14)
    transformers.Dinov2Model(config).save_pretrained(folder / "dino")
    return folder


def made(name, weights, size=256, device="auto"):
    paths = str(weights / "sd") if name == "dift" else f"{weights / 'sd'},{weights / 'dino'}"
    own = {"draws": 2} if name == "dift" else {"tokens": size // 16}
    return features.load(name, paths, device, size=size, rotations=2, **own)


@pytest.mark.parametrize(("name", "width"), [("dift", 16), ("sd_dino", 16 + 16 + 8 + 32)])
def test_maps_have_the_stated_shape_and_are_the_same_again(weights, name, width):
    backend = made(name, weights)
    pictures = np.random.default_rng(0).integers(0, 255, (2, 256, 256, 3), dtype=np.uint8)
    maps = backend.extract(pictures)
    assert maps.shape == (2, 16, 16, width)
    assert maps.dtype == np.float32
    assert np.isfinite(maps).all()
    np.testing.assert_array_equal(maps, backend.extract(pictures))
    assert not np.allclose(maps[0], maps[1])
    assert backend.key() == made(name, weights).key()
    if name == "sd_dino":
        np.testing.assert_allclose(np.linalg.norm(maps, axis=-1), 1.0, atol=1e-5)


@pytest.mark.parametrize("name", ["dift", "sd_dino"])
def test_maps_of_a_gpu_are_those_of_the_processor(weights, name):
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no GPU here")
    pictures = np.random.default_rng(0).integers(0, 255, (1, 256, 256, 3), dtype=np.uint8)
    there, here = (made(name, weights, device=device).extract(pictures) for device in ("auto", "cpu"))
    assert there.dtype == np.float32 and np.abs(there - here).max() < 0.02 * np.abs(here).max()


@pytest.mark.parametrize("name", ["dift", "sd_dino"])
def test_a_tool_is_found_on_itself(weights, reference, name):
    backend = made(name, weights, 448)
    found = backend.propose(backend.prepare(reference), reference.view, reference.contour, None, 2).proposals
    assert np.hypot(*(found[0].pixel - reference.pixel)) < 2 * reference.contour.size / 28
    assert not found[0].flipped


def test_weights_that_are_none_have_a_code(weights, tmp_path):
    for name, path in (("dift", str(tmp_path)), ("sd_dino", str(weights / "sd"))):
        with pytest.raises(MagicError) as error:
            features.load(name, path)
        assert error.value.code == Code.FEATURE_WEIGHTS
    with pytest.raises(MagicError) as error:
        features.load("dift", str(weights / "sd"), size=100)
    assert error.value.code == Code.BAD_REQUEST


@pytest.mark.parametrize("name", ["dift", "sd_dino"])
def test_without_weights_it_is_said(name):
    with pytest.raises(MagicError) as error:
        features.load(name, "")
    assert error.value.code == Code.FEATURE_WEIGHTS
