"""What the optional networks cost on this machine, and whether a GPU finds what the processor finds.

    source ros2_ws/env.sh
    python tests/networks.py [--only NAME ...] [--devices cuda cpu] [--repeat 10] [--tiny] [--out FILE]

The networks have their published sizes and random weights: times and memory are those of trained ones, and so is the rounding of half
precision; how good their answers are is another question. Weights are made in a temporary folder and loaded as a user's would be.

One row a network and device: millions of weights, seconds to load, the first pass and the median of the following ones for one new
object (features and the best places on it; masks: a 640x480 picture with four prompts; words: four pictures, four texts), for features
the seconds that a reference's 24 views take once, the most GPU memory, and how far the answer is from that of the device in the row
above: features in pixels of a 768 px picture (median and worst over eight objects, of the best place), masks by their
least IoU, words by the largest difference of a logit. ``--tiny`` takes networks of a few thousand weights,
but for SAM 2, to try the command itself.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from magic_core import sensor, shapes, transforms
from magic_core.open_words import OpenWords
from magic_matcher import features, global_stage
from magic_perception.segmenters import make_segmenter

#: A reference and its contact, and the new objects, as families and seeds of made shapes.
REFERENCE = ("l_hook", 3, "inner")
OBJECTS = (("l_hook", 5), ("l_hook", 9), ("caliper", 2), ("hammer", 1), ("scissors", 1), ("mug", 3), ("mug", 7), ("hanger", 1))

DINO = {  # hidden size, layers, heads
    "dinov2-small": (384, 12, 6),
    "dinov2-base": (768, 12, 12),
    "dinov2-large": (1024, 24, 16),
    "dinov2-giant": (1536, 40, 24),
}
NAMES = (*DINO, "sam2.1-hiera-tiny", "sam-vit-base", "clip-vit-base", "dift (SD 2.1)", "sd_dino (SD 2.1, dinov2-base)")


def save_dino(folder: Path, name: str, tiny: bool) -> None:
    """A DINOv2 of the published size."""
    import transformers

    hidden, layers, heads = (32, 2, 4) if tiny else DINO[name]
    giant = {"use_swiglu_ffn": True} if name == "dinov2-giant" else {}
    config = transformers.Dinov2Config(hidden_size=hidden, num_hidden_layers=layers, num_attention_heads=heads, image_size=518, **giant)
    transformers.Dinov2Model(config).save_pretrained(folder)


def save_diffusion(folder: Path, tiny: bool) -> None:
    """The parts of Stable Diffusion 2.1: what DIFT and SD-DINO pass through."""
    import diffusers
    import transformers

    words = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    words = words if tiny else {"hidden_size": 1024, "intermediate_size": 4096, "num_hidden_layers": 23, "num_attention_heads": 16}
    width = words["hidden_size"]
    (folder / "vocab.json").write_text(json.dumps({"!": 0, "<|startoftext|>": 1, "<|endoftext|>": 2, "a</w>": 3}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    transformers.CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt")).save_pretrained(folder / "tokenizer")
    text = transformers.CLIPTextConfig(vocab_size=4, bos_token_id=1, eos_token_id=2, **words)
    transformers.CLIPTextModel(text).save_pretrained(folder / "text_encoder")
    blocks = (8, 8, 16, 16) if tiny else (320, 640, 1280, 1280)
    heads: Any = 4 if tiny else (5, 10, 20, 20)
    groups = {"norm_num_groups": 4} if tiny else {}
    diffusers.UNet2DConditionModel(
        sample_size=96, block_out_channels=blocks, attention_head_dim=heads, cross_attention_dim=width, use_linear_projection=True, **groups
    ).save_pretrained(folder / "unet")
    diffusers.AutoencoderKL(
        block_out_channels=(8, 8, 8, 8) if tiny else (128, 256, 512, 512), layers_per_block=1 if tiny else 2,
        down_block_types=["DownEncoderBlock2D"] * 4, up_block_types=["UpDecoderBlock2D"] * 4, **groups,
    ).save_pretrained(folder / "vae")  # fmt: skip
    diffusers.DDIMScheduler().save_pretrained(folder / "scheduler")


def save_sam(folder: Path, name: str, tiny: bool) -> None:
    """SAM 2.1 with the tiny Hiera, or SAM with ViT-B: the sizes that transformers takes where none are said."""
    import transformers

    if name == "sam-vit-base":
        small = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2, "mlp_dim": 32, "global_attn_indexes": [0]}
        vision = transformers.SamVisionConfig(**(small if tiny else {}), initializer_range=0.02)
        transformers.SamModel(transformers.SamConfig(vision_config=vision.to_dict())).save_pretrained(folder)
    else:
        transformers.Sam2Model(transformers.Sam2Config()).save_pretrained(folder)


def save_clip(folder: Path, tiny: bool) -> None:
    """CLIP ViT-B/32; its tokenizer knows single letters, which is all that the time asks for."""
    import transformers
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    letters = {word: i for i, word in enumerate(["<pad>", "<s>", "</s>", "<unk>", *"abcdefghijklmnopqrstuvwxyz"])}
    reader = Tokenizer(models.WordLevel(letters, unk_token="<unk>"))
    reader.pre_tokenizer = pre_tokenizers.Split("", "isolated")
    reader.post_processor = processors.TemplateProcessing(single="<s> $A </s>", special_tokens=[("<s>", 1), ("</s>", 2)])
    names = {"pad_token": "<pad>", "unk_token": "<unk>", "bos_token": "<s>", "eos_token": "</s>"}
    transformers.PreTrainedTokenizerFast(tokenizer_object=reader, model_max_length=77, **names).save_pretrained(folder)
    transformers.CLIPImageProcessor().save_pretrained(folder)
    small = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2} if tiny else {}
    text = {**small, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
    transformers.CLIPModel(transformers.CLIPConfig(text_config=text, vision_config=small)).save_pretrained(folder)


def repeated(call: Callable[[], Any], count: int) -> tuple[Any, float, float]:
    """What a call gives, the seconds of the first one and the median of ``count`` more; each ends with its answer in main memory."""
    start = time.perf_counter()
    answer = call()
    first, seconds = time.perf_counter() - start, []
    for _ in range(count):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return answer, first, statistics.median(seconds)


def measure_features(name: str, weights: Path, device: str, repeat: int, tiny: bool) -> tuple[dict[str, float], list[Any], Any]:
    """Times of a features backend, the best place on each object, and its network."""
    family, number, contact = REFERENCE
    shape = shapes.make(family, number)
    view = shape.view()
    at = shape.contact(contact, view)
    reference = global_stage.make_reference(view, at.pixel, at.normal)
    kind = name.split()[0].split("-")[0]
    paths = f"{weights / 'sd'},{weights / 'dino'}" if kind == "sd_dino" else str(weights / ("sd" if kind == "dift" else "dino"))
    start = time.perf_counter()
    small = {"rotations": 2, **({"size": 256} if "SD" in name else {})} if tiny else {}
    backend = features.load(kind, paths, device, **small)
    times = {"load": time.perf_counter() - start}
    start = time.perf_counter()
    prepared = backend.prepare(reference)
    times["reference"] = time.perf_counter() - start
    views = [shapes.make(f, n).view() for f, n in OBJECTS]
    _, times["first"], times["median"] = repeated(lambda: backend.propose(prepared, views[0], reference.contour, None, 3), repeat)
    places = [backend.propose(prepared, v, reference.contour, None, 3).proposals[0] for v in views]
    return times, [p.pixel for p in places], backend


def measure_masks(name: str, weights: Path, device: str, repeat: int) -> tuple[dict[str, float], list[Any], Any]:
    """Times of a segmenter's network, and its masks about four objects."""
    meshes = [shapes.make(f, n).mesh for f, n in (("mug", 3), ("l_hook", 1), ("cylinder", 1), ("caliper", 2))]
    meshes = [
        m.transformed(transforms.make(translation=[0.45 + 0.12 * (i // 2), 0.2 * (i % 2) - 0.1, -m.bounds[0, 2]]))
        for i, m in enumerate(meshes)
    ]
    frame = sensor.capture(meshes, sensor.D435, sensor.looking_at((0.25, 0.45, 0.62), (0.55, 0.0, 0.02)), 0)
    prompts = []
    for row, column in ((120, 160), (120, 400), (280, 160), (280, 400)):
        prompts.append(np.zeros(frame.color.shape[:2], bool))
        prompts[-1][row : row + 90, column : column + 110] = True
    start = time.perf_counter()
    segmenter: Any = make_segmenter("sam" if name == "sam-vit-base" else "sam2", str(weights / "sam"), device)
    times = {"load": time.perf_counter() - start}
    found, times["first"], times["median"] = repeated(lambda: segmenter.masks(frame.color, prompts), repeat)
    return times, [p > 0.5 for p, _ in found], segmenter


def measure_words(weights: Path, device: str, repeat: int) -> tuple[dict[str, float], list[Any], Any]:
    """Times of a text-image network, and its logits."""
    start = time.perf_counter()
    network = OpenWords(str(weights / "clip"), device)
    times = {"load": time.perf_counter() - start}
    pictures = [np.random.default_rng(i).integers(0, 255, (120, 90, 3), dtype=np.uint8) for i in range(4)]
    texts = ["a photo of the screwdriver", "a photo of an object", "a photo of a thing on a table", "a photo of something"]
    found, times["first"], times["median"] = repeated(lambda: network.logits(texts, pictures), repeat)
    return times, [found], network


def differing(name: str, found: list[Any], exact: list[Any]) -> str:
    """How far two devices' answers are from each other."""
    if name.startswith("sam"):
        least = min(float((a & b).sum() / max((a | b).sum(), 1)) if (a | b).any() else 1.0 for a, b in zip(found, exact, strict=True))
        return f"least IoU {least:.3f}"
    if name.startswith("clip"):
        return f"logits {np.abs(found[0] - exact[0]).max():.4f}"
    apart = sorted(float(np.hypot(*(a - b))) for a, b in zip(found, exact, strict=True))
    return f"{statistics.median(apart):.1f} px, worst {apart[-1]:.1f}"


def weighs(part: Any) -> float:
    """Millions of weights of all networks in an object and in what it holds."""
    import torch

    held, seen = [part], set()
    total = 0
    while held:
        item = held.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, torch.nn.Module):
            total += sum(p.numel() for p in item.parameters())
        elif hasattr(item, "__dict__") and type(item).__module__.startswith("magic_"):
            held.extend(vars(item).values())
    return total / 1e6


def rows_of(name: str, devices: list[str], repeat: int, tiny: bool) -> list[str]:
    """The rows of one network."""
    import torch

    torch.manual_seed(0)
    rows, answers = [], []
    with tempfile.TemporaryDirectory() as temporary:
        weights = Path(temporary)
        for part in ("dino", "sd", "sam", "clip"):
            (weights / part).mkdir()
        if name in DINO or name.startswith("sd_dino"):
            save_dino(weights / "dino", name if name in DINO else "dinov2-base", tiny)
        if "SD" in name:
            save_diffusion(weights / "sd", tiny)
        if name.startswith("sam"):
            save_sam(weights / "sam", name, tiny)
        if name.startswith("clip"):
            save_clip(weights / "clip", tiny)
        for device in devices:
            if device != "cpu":
                torch.cuda.reset_peak_memory_stats()
            count = repeat if device != "cpu" else min(repeat, 2)
            if name.startswith("sam"):
                times, answer, network = measure_masks(name, weights, device, count)
            elif name.startswith("clip"):
                times, answer, network = measure_words(weights, device, count)
            else:
                times, answer, network = measure_features(name, weights, device, count, tiny)
            memory = f"{torch.cuda.max_memory_allocated() / 2**20:.0f} MiB" if device != "cpu" else ""
            reference = f"{times['reference']:.2f} s" if "reference" in times else ""
            against = differing(name, answer, answers[-1]) if answers else ""
            rows.append(
                f"| {name} | {weighs(network):.1f} | {device} | {times['load']:.2f} s | {reference} | {1000 * times['first']:.0f} ms |"
                f" {1000 * times['median']:.1f} ms | {memory} | {against} |"
            )
            print(rows[-1], flush=True)
            answers.append(answer)
            del network
            gc.collect()
            if device != "cpu":
                torch.cuda.empty_cache()
    return rows


def main() -> None:
    """See the module's head."""
    import torch

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=NAMES, default=list(NAMES), metavar="NAME", help=f"of {', '.join(NAMES)}")
    parser.add_argument("--devices", nargs="+", default=["cuda", "cpu"] if torch.cuda.is_available() else ["cpu"])
    parser.add_argument("--repeat", type=int, default=10, help="passes that the median is of (two at most on the processor)")
    parser.add_argument("--tiny", action="store_true", help="networks of a few thousand weights")
    parser.add_argument("--out", type=Path, help="file that the table is written to as well")
    given = parser.parse_args()
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ", no GPU"
    head = f"torch {torch.__version__}{gpu}, {torch.get_num_threads()} threads\n\n"
    head += (
        "| network | M weights | device | load | reference | first | new object | GPU memory | against the row above |\n"
        + "| --- " * 9
        + "|"
    )
    print(head, flush=True)
    rows = [head]
    for name in given.only:
        try:
            rows += rows_of(name, given.devices, given.repeat, given.tiny)
        except ImportError as error:
            print(f"{name}: {error}", flush=True)
        if given.out:
            given.out.write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
