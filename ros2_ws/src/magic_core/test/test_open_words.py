"""Names in open words: a tiny network that the test teaches three words, and the rule by which a name is refused."""

from dataclasses import replace

import numpy as np
import pytest

from magic_core import open_words
from magic_core.errors import Code, MagicError
from magic_core.open_words import OpenWords, fits, picture
from magic_core.shapes import make

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

#: What the network is taught: the word for each colour of picture, and for pictures of no such colour.
TAUGHT = {"wrench": (200, 30, 30), "ladle": (30, 200, 30), "ruler": (30, 30, 200)}
WORDS = ["a", "photo", "of", "the", "an", "object", "thing", "on", "table", "something"]


def flat(color, shape=(40, 24), seed=0):
    """A noisy picture of one colour."""
    noise = np.random.default_rng(seed).integers(-25, 26, (*shape, 3))
    return np.clip(np.array(color) + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A CLIP of some thousand weights that has learned three words."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    folder = tmp_path_factory.mktemp("clip")
    vocabulary = {word: i for i, word in enumerate(["<pad>", "<s>", "</s>", "<unk>", *WORDS, *TAUGHT])}
    reader = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    reader.pre_tokenizer = pre_tokenizers.Whitespace()
    reader.post_processor = processors.TemplateProcessing(single="<s> $A </s>", special_tokens=[("<s>", 1), ("</s>", 2)])
    names = {"pad_token": "<pad>", "unk_token": "<unk>", "bos_token": "<s>", "eos_token": "</s>"}
    transformers.PreTrainedTokenizerFast(tokenizer_object=reader, model_max_length=16, **names).save_pretrained(folder)
    side = {"height": 32, "width": 32}
    transformers.CLIPImageProcessor(size={"shortest_edge": 32}, crop_size=side).save_pretrained(folder)
    size = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    text = {**size, "vocab_size": len(vocabulary), "max_position_embeddings": 16, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
    config = transformers.CLIPConfig(text_config=text, vision_config={**size, "image_size": 32, "patch_size": 8}, projection_dim=16)
    torch.manual_seed(0)
    transformers.CLIPModel(config).save_pretrained(folder)
    network = OpenWords(str(folder), "cpu")
    model = network._model.train()
    steps = torch.optim.Adam(model.parameters(), 0.01)
    captions = [open_words.CAPTION.format(f"the {word}") for word in TAUGHT] + [open_words.CAPTION.format(open_words.ANYTHING[0])]
    tokens = network._tokens(captions, padding=True, return_tensors="pt")
    for seed in range(60):
        shown = [flat(c, seed=seed) for c in (*TAUGHT.values(), (128, 128, 128))]
        pixels = network._images(images=shown, input_data_format="channels_last", return_tensors="pt")
        logits = model(**tokens, **pixels).logits_per_image
        right = torch.arange(4)
        loss = torch.nn.functional.cross_entropy(logits, right) + torch.nn.functional.cross_entropy(logits.T, right)
        steps.zero_grad()
        loss.backward()
        steps.step()
    model.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def network(weights):
    return OpenWords(str(weights), "cpu")


def scene(**colors):
    item = make("l_hook", 0).as_object("item", np.eye(4))
    return [replace(item, id=name, picture=flat(color, seed=9)) for name, color in colors.items()]


@pytest.mark.parametrize("word", TAUGHT)
def test_a_word_that_the_network_knows_finds_its_object_wherever_it_is_in_the_list(network, word):
    objects = scene(**{f"object_{i}": color for i, color in enumerate(TAUGHT.values())})
    wanted = f"object_{list(TAUGHT).index(word)}"
    for order in (objects, objects[::-1]):
        reading = network.resolve(f"the {word}", order)
        assert reading.id == wanted
        assert wanted in reading.sentence and f"the {word}" in reading.sentence and "%" in reading.sentence


def test_a_word_for_nothing_that_is_there_is_refused_with_what_there_is(network):
    objects = scene(object_1=TAUGHT["ladle"], object_2=(128, 128, 128))
    with pytest.raises(MagicError) as caught:
        network.resolve("the wrench", objects)
    assert caught.value.code == Code.UNKNOWN_OBJECT
    assert all(part in caught.value.message for part in ("the wrench", "object_1", "object_2"))


def test_two_that_look_alike_are_not_guessed_between(network):
    with pytest.raises(MagicError) as caught:
        network.resolve("the wrench", scene(object_1=TAUGHT["wrench"], object_2=TAUGHT["wrench"], object_3=TAUGHT["ruler"]))
    assert caught.value.code == Code.AMBIGUOUS_OBJECT
    assert "object_1" in caught.value.message and "object_2" in caught.value.message


def test_no_objects_is_an_answer(network):
    with pytest.raises(MagicError) as caught:
        network.resolve("the wrench", [])
    assert caught.value.code == Code.UNKNOWN_OBJECT


def test_logits_are_by_picture_and_text_and_do_not_depend_on_the_company(network):
    shown = [flat(color, shape) for color, shape in zip(TAUGHT.values(), ((40, 24), (24, 64), (50, 50)), strict=True)]
    texts = ["a photo of the wrench", "a photo of an object", "something", "a photo of the ruler"]
    together = network.logits(texts, shown)
    assert together.shape == (3, 4)
    np.testing.assert_allclose(network.logits(texts, shown[1:2]), together[1:2], rtol=1e-3, atol=1e-3)


def test_a_gpu_reads_what_the_processor_reads(weights, network):
    if not torch.cuda.is_available():
        pytest.skip("no GPU here")
    shown, texts = [flat(color) for color in TAUGHT.values()], ["a photo of the wrench", "something"]
    there = OpenWords(str(weights))
    assert next(there._model.parameters()).is_cuda
    np.testing.assert_allclose(there.logits(texts, shown), network.logits(texts, shown), rtol=0.01, atol=0.01)


def test_nothing_of_a_long_thing_is_cut_away():
    long = np.zeros((10, 40, 3), np.uint8)
    long[:, :5] = 255
    square = open_words._square(long)
    assert square.shape == (40, 40, 3)
    assert (square[:, :5] == 255).all() and not square[:, 5:].any()


def test_the_rule_wants_more_than_to_be_liked_best():
    # Columns: the words, and what is true of anything.
    found = fits(["a", "b", "c"], np.array([[3.0, 4.0, 1.0], [5.0, 4.5, 2.0], [1.0, 0.0, 0.0]]))
    assert [f.id for f in found] == ["b", "a", "c"]
    assert found[0].above == pytest.approx(0.5) and found[1].above == pytest.approx(-1.0)
    assert sum(f.share for f in found) == pytest.approx(1.0)
    assert found[0].share == pytest.approx(1 / (1 + np.exp(-2) + np.exp(-4)))


def test_a_known_object_is_shown_by_its_canonical_view():
    item = make("l_hook", 0).as_object("item", np.eye(4))
    assert picture(item) is item.view.image
    shown = flat((1, 2, 3))
    assert picture(replace(item, picture=shown)) is shown


def test_a_siglip_is_read_as_well(tmp_path, weights):
    size = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    text = {**size, "vocab_size": 32, "max_position_embeddings": 16}
    config = transformers.SiglipConfig(text_config=text, vision_config={**size, "image_size": 32, "patch_size": 8})
    transformers.SiglipModel(config).save_pretrained(tmp_path)
    transformers.SiglipImageProcessor(size={"height": 32, "width": 32}).save_pretrained(tmp_path)
    for file in ("tokenizer.json", "tokenizer_config.json"):
        (tmp_path / file).write_bytes((weights / file).read_bytes())
    assert OpenWords(str(tmp_path), "cpu").logits(["a photo of the wrench", "something"], [flat((9, 9, 9))]).shape == (1, 2)


def test_weights_that_are_none_are_named(tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "dinov2"}')
    for folder, said in ((tmp_path, "dinov2"), (tmp_path / "nowhere", "nowhere")):
        with pytest.raises(MagicError) as caught:
            OpenWords(str(folder), "cpu")
        assert caught.value.code == Code.FEATURE_WEIGHTS and said in caught.value.message
