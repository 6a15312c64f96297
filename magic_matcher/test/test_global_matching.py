"""The global stage on feature maps: identities, and the fast way against the literal one."""

import shutil

import cv2
import numpy as np
import pytest

from magic_core import shapes
from magic_core.errors import Code, MagicError
from magic_core.scene import CanonicalView
from magic_matcher import features, global_stage
from magic_matcher import global_matching as gm


def turned(view, angle, flipped=False):
    """A view turned and mirrored in the picture, and the map of its pixels."""
    size = view.mask.shape[0]
    matrix = gm.view_matrix(angle, flipped, np.full(2, (size - 1) / 2), size, 0.95)
    mask = cv2.warpAffine(view.mask.astype(np.float32), matrix, (size, size)) > 0.5
    return CanonicalView(cv2.warpAffine(view.image, matrix, (size, size)), mask, view.metres_per_pixel, np.eye(4)), matrix


def test_all_pairs_factor_into_box_sums():
    random = np.random.default_rng(0)
    n, m, d = 9, 3, 5
    patch, maps = random.normal(size=(m, m, d)).astype(np.float32), random.normal(size=(n, n, d)).astype(np.float32)
    inside = np.ones((m, m), bool)
    inside[0, 0] = False
    fast = gm.pairs_similarity(patch, inside, maps)
    for r in range(n):
        for c in range(n):
            around = maps[max(0, r - 1) : r + 2, max(0, c - 1) : c + 2].reshape(-1, d)
            slow = np.mean(patch[inside] @ around.T)
            assert fast[r, c] == pytest.approx(slow, abs=1e-5)


def test_aligned_is_one_where_the_patch_came_from():
    random = np.random.default_rng(1)
    maps = random.normal(size=(11, 11, 8)).astype(np.float32)
    maps /= np.linalg.norm(maps, axis=-1, keepdims=True)
    scores = gm.aligned_similarity(maps[None, 3:8, 4:9], np.ones((1, 5, 5), bool), maps)[0]
    assert np.unravel_index(np.argmax(scores), scores.shape) == (5, 6)
    assert scores[5, 6] == pytest.approx(1.0, abs=1e-5)


def test_joint_pca_is_that_of_all_tokens():
    random = np.random.default_rng(2)
    a, b = random.normal(size=(40, 6)).astype(np.float32), (random.normal(size=(30, 6)) * [3, 1, 1, 1, 1, 1] + 2).astype(np.float32)
    mean, scatter, count = gm._moments(a)
    prepared = gm.PreparedGlobal(np.zeros((1, 1, 1, 6), np.float32), np.ones((1, 1, 1), bool), mean, scatter, count, gm.Views.all(1, False))
    centre, w = gm.joint_pca(prepared, b, 3)
    tokens = np.concatenate([a, b]).astype(float)
    _values, vectors = np.linalg.eigh(np.cov(tokens.T, bias=True))
    assert centre == pytest.approx(tokens.mean(axis=0), abs=1e-4)
    assert np.abs(np.sum(w * vectors[:, ::-1][:, :3], axis=0)) == pytest.approx(np.ones(3), abs=1e-3)


def test_suppression_gives_different_places():
    points = np.array([[0, 0], [1, 0], [50, 0], [51, 0], [100, 0]], float)
    assert global_stage.suppress(points, np.array([5.0, 4.9, 4.0, 4.8, 1.0]), 10, 3) == [0, 3, 4]
    assert global_stage.suppress(points, np.array([5.0, np.nan, -np.inf, 1.0, -np.inf]), 10, 9) == [0, 3]


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch = pytest.importorskip("torch")
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("dinov2")
    config = transformers.Dinov2Config(hidden_size=32, num_hidden_layers=2, num_attention_heads=4, image_size=224, patch_size=14)
    transformers.Dinov2Model(config).save_pretrained(folder)
    return str(folder)


@pytest.fixture(scope="module")
def backend(weights):
    return features.load("dinov2", weights, tokens=14)


@pytest.fixture(scope="module")
def prepared(backend, reference):
    return backend.prepare(reference)


@pytest.mark.parametrize(("quarter", "flipped"), [(0, False), (1, True), (3, False)])
def test_fast_way_agrees_with_the_literal_24_views(backend, reference, prepared, quarter, flipped):
    view, matrix = turned(reference.view, quarter * np.pi / 2, flipped)
    fast = gm.propose(prepared, view, backend.extract, backend.size, 1).proposals[0]
    slow = gm.propose(prepared, view, backend.extract, backend.size, 1, literal=reference.view, literal_pixel=reference.pixel).proposals[0]
    truth = matrix[:, :2] @ reference.pixel + matrix[:, 2]
    token = reference.contour.size / 14
    for found in (fast, slow):
        assert np.hypot(*(found.pixel - truth)) < 2 * token
        assert (found.rotation - quarter * np.pi / 2 + 0.1) % (2 * np.pi) < 0.2 and found.flipped == flipped
    assert fast.similarity == pytest.approx(slow.similarity, abs=0.03)


def test_background_is_never_chosen(backend, prepared):
    mug = shapes.make("mug", 1).view()
    found = backend.propose(prepared, mug, None, None, 6, heatmap=True)
    for proposal in found.proposals:
        v, u = np.nonzero(mug.mask)
        assert np.hypot(u - proposal.pixel[0], v - proposal.pixel[1]).min() < 384 / 14
    assert found.heatmap.shape == mug.mask.shape and found.heatmap[~mug.mask].max() == 0 and found.heatmap.max() > 0.9


def test_every_aggregation_and_no_pca_run(backend, reference, prepared):
    for aggregation in gm.AGGREGATIONS:
        for components in (None, 8):
            assert gm.propose(prepared, reference.view, backend.extract, backend.size, 2, aggregation, components).proposals
    with pytest.raises(MagicError) as caught:
        gm.propose(prepared, reference.view, backend.extract, backend.size, 2, "mean")
    assert caught.value.code == Code.BAD_REQUEST


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_half_precision_finds_the_same_place(weights, reference, precision):
    torch = pytest.importorskip("torch")
    half = features.load("dinov2", weights, "cpu", tokens=14, rotations=4, precision=precision)
    assert half._dtype == getattr(torch, precision) and next(half._model.parameters()).dtype == half._dtype
    full = features.load("dinov2", weights, "cpu", tokens=14, rotations=4)
    assert full._dtype == torch.float32 and full.key() != half.key()
    found, exact = (b.propose(b.prepare(reference), reference.view, None, None, 1).proposals[0] for b in (half, full))
    assert found.pixel == pytest.approx(exact.pixel) and found.similarity == pytest.approx(exact.similarity, abs=0.02)
    assert half.extract(np.zeros((1, half.size, half.size, 3), np.uint8)).dtype == np.float32
    with pytest.raises(MagicError) as caught:
        features.load("dinov2", weights, precision="int8")
    assert caught.value.code == Code.BAD_REQUEST


def test_a_gpu_is_taken_where_there_is_one_and_finds_what_the_processor_finds(weights, reference):
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("no GPU here")
    there, here = (features.load("dinov2", weights, device, tokens=14, rotations=4) for device in ("auto", "cpu"))
    assert next(there._model.parameters()).is_cuda and there._dtype == torch.float16 and there.key() != here.key()
    found, exact = (b.propose(b.prepare(reference), reference.view, None, None, 1).proposals[0] for b in (there, here))
    assert found.pixel == pytest.approx(exact.pixel) and found.similarity == pytest.approx(exact.similarity, abs=0.02)
    assert (found.rotation, found.flipped) == (exact.rotation, exact.flipped)


@pytest.mark.parametrize("kind", ["Dinov2WithRegisters", "DINOv3ViT"])
def test_other_models_of_the_family_load(tmp_path, reference, kind):
    transformers = pytest.importorskip("transformers")
    if not hasattr(transformers, f"{kind}Model"):
        pytest.skip(f"transformers {transformers.__version__} has no {kind}")
    settings = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "image_size": 224, "num_register_tokens": 4}
    config = getattr(transformers, f"{kind}Config")(**settings, patch_size=14 if kind.startswith("Dinov2") else 16, intermediate_size=64)
    getattr(transformers, f"{kind}Model")(config).save_pretrained(tmp_path)
    backend = features.load("dinov2", str(tmp_path), tokens=12, rotations=2)
    found = backend.propose(backend.prepare(reference), reference.view, reference.contour, None, 2).proposals
    token = reference.contour.size / 12
    assert np.hypot(*(found[0].pixel - reference.pixel)) < 1.5 * token and not found[0].flipped


def test_damaged_weights_and_absent_devices_have_codes(weights, tmp_path):
    damaged = tmp_path / "damaged"
    shutil.copytree(weights, damaged)
    (damaged / "model.safetensors").write_bytes(b"not this")
    torch = pytest.importorskip("torch")
    cases = [(str(damaged), "cpu"), (weights, "nonsense")] + ([] if torch.cuda.is_available() else [(weights, "cuda")])
    for name, device in cases:
        with pytest.raises(MagicError) as caught:
            features.load("dinov2", name, device)
        assert caught.value.code == Code.FEATURE_WEIGHTS and device in caught.value.message


def test_key_names_the_weights(weights, backend):
    assert backend.key() == features.load("dinov2", weights, tokens=14).key()
    assert backend.key() != features.load("dinov2", weights, tokens=12).key()


def test_bad_weights_and_names_have_codes(tmp_path):
    for arguments, code in (
        (("dinov2", str(tmp_path)), Code.FEATURE_WEIGHTS),
        (("dinov2", ""), Code.FEATURE_WEIGHTS),
        (("dinov2", str(tmp_path / "nothing")), Code.FEATURE_WEIGHTS),
        (("dinov2", "./nothing"), Code.FEATURE_WEIGHTS),
        (("resnet", ""), Code.UNKNOWN_FEATURES),
    ):
        with pytest.raises(MagicError) as caught:
            features.load(*arguments)
        assert caught.value.code == code
    assert features.load("auto").name == "embedded"
