"""Bags that were recorded when a message type had other fields."""

from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

from magic_bags.bag_file import message_definition
from magic_bags.bag_types import Carrier
from magic_core.errors import Code, MagicError
from magic_interfaces.msg import SceneObject, SceneObjectArray

NAME = "magic_interfaces/msg/SceneObjectArray"


def connection(definition, digest="RIHS01_other"):
    return SimpleNamespace(topic="/known_objects", msgtype=NAME, digest=digest, msgdef=SimpleNamespace(data=definition))


def older(drop, rename=()):
    """The installed definition without some fields, or with one of another name, and a writer of messages so defined."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    definition, _ = message_definition(NAME)
    lines = [line for line in definition.splitlines() if not any(line.split("#")[0].split()[1:2] == [field] for field in drop)]
    text = "\n".join(lines)
    for before, after in rename:
        text = text.replace(before, after)
    store = get_typestore(Stores.EMPTY)
    store.register({k: v for k, v in get_types_from_msg(text, NAME).items() if k not in store.fielddefs})
    return text, store


def written(store, text, message):
    """The message as it was recorded: by the older definition, from the bytes of the installed one."""
    newest, _ = message_definition(NAME)
    # Carrying to the older definition is the same as carrying from it, with both sides exchanged.
    from magic_bags.bag_types import _Way

    return _Way(NAME, newest, text).carry("/known_objects", serialize_message(message))


def scene():
    item = SceneObject(id="rod", source="known", confidence=0.5, seen_share=0.75, cut_off=["picture"], camera="left")
    item.box_size.x = 0.3
    item.pose.position.y = -0.2
    item.cloud.data = b"\x01\x02\x03"
    return SceneObjectArray(objects=[item, SceneObject(id="second")], notes=["a note"])


def test_what_the_installed_definition_has_too_is_taken_over_and_what_is_new_is_empty():
    text, store = older(("seen_share", "cut_off", "notes", "camera_offset"))
    assert "seen_share" not in text
    data = written(store, text, scene())
    with pytest.raises(RuntimeError):
        deserialize_message(data, SceneObjectArray)  # as it stands it cannot be read
    read = deserialize_message(Carrier().carry(connection(text), data), SceneObjectArray)
    assert [o.id for o in read.objects] == ["rod", "second"]
    rod = read.objects[0]
    assert (rod.source, rod.confidence, rod.camera) == ("known", 0.5, "left")
    assert (rod.box_size.x, rod.pose.position.y, bytes(rod.cloud.data)) == (0.3, -0.2, b"\x01\x02\x03")
    assert (rod.seen_share, list(rod.cut_off), list(read.notes)) == (0.0, [], [])


def test_the_same_definition_is_passed_on_as_it_is():
    definition, digest = message_definition(NAME)
    data = serialize_message(scene())
    assert Carrier().carry(connection(definition, digest), data) == data
    assert Carrier().carry(connection("", "RIHS01_other"), data) == data  # nothing is known of it
    with_other_text = connection(definition, "RIHS01_other")
    assert np.array_equal(
        deserialize_message(Carrier().carry(with_other_text, data), SceneObjectArray).objects[0].cut_off, scene().objects[0].cut_off
    )


def test_bytes_that_their_own_definition_does_not_fit_are_a_bad_bag():
    text, _ = older(("notes",))
    with pytest.raises(MagicError) as error:
        Carrier().carry(connection(text), serialize_message(scene())[:40])
    assert error.value.code == Code.BAD_BAG
    assert "/known_objects" in error.value.message
