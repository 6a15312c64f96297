"""The recorded bags: topics, types, QoS and content; the same seed gives the same bytes."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections import defaultdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml

from magic_bags import bag_messages
from magic_bags.bag_file import info as read_info
from magic_core import conversions as convert
from magic_core import transforms
from magic_core.shapes import make
from magic_core.shapes.fixtures import pose_from_data

BAGS = Path(__file__).resolve().parents[4] / "bags"
SCENES = ("hooking", "hanging", "scooping")
DEMONSTRATIONS = tuple(f"{name}_demonstration" for name in SCENES)
IMAGES = {
    "color/image_raw": "sensor_msgs/msg/Image",
    "color/camera_info": "sensor_msgs/msg/CameraInfo",
    "aligned_depth_to_color/image_raw": "sensor_msgs/msg/Image",
    "aligned_depth_to_color/camera_info": "sensor_msgs/msg/CameraInfo",
}


@pytest.fixture(scope="module")
def recorder() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bags_record", BAGS / "record.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["bags_record"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """(stamp in ns, message) by topic."""
    result = defaultdict(list)
    for topic, stamp, message in bag_messages.messages(path):
        result[topic].append((stamp, message))
    return result


@pytest.mark.parametrize("name", [*SCENES, *DEMONSTRATIONS])
def test_topics_types_and_qos_are_those_of_the_drivers(name: str) -> None:
    from rosbags.interfaces import QosDurability, QosReliability

    info = read_info(BAGS / name)
    topics = {t.name: t for t in info.topics}
    for camera in ("left", "right"):
        for topic, kind in IMAGES.items():
            entry = topics[f"/camera/{camera}/{topic}"]
            assert entry.type_name == kind and entry.count >= 3
            assert entry.qos[0].reliability == QosReliability.RELIABLE and entry.qos[0].durability == QosDurability.VOLATILE
    latched = ["/tf_static", *(["/known_objects"] if not name.startswith("hooking") else [])]
    for topic in latched:
        assert topics[topic].count == 1 and topics[topic].qos[0].durability == QosDurability.TRANSIENT_LOCAL
    assert topics["/tf_static"].type_name == "tf2_msgs/msg/TFMessage"
    assert topics["/joint_states"].type_name == "sensor_msgs/msg/JointState" and topics["/joint_states"].count > 5
    assert ("/demonstration/tool_pose" in topics) == (name in DEMONSTRATIONS)
    assert info.storage == "mcap"


def test_all_bags_together_are_small() -> None:
    assert sum(f.stat().st_size for f in BAGS.rglob("*") if f.is_file()) < 20e6


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_shows_what_its_truth_says(name: str) -> None:
    content = messages(BAGS / name)
    truth = yaml.safe_load((BAGS / name / "truth.yaml").read_text())
    world_from = {t.child_frame_id: convert.transform_from_msg(t.transform) for t in content["/tf_static"][0][1].transforms}
    assert {t.header.frame_id for t in content["/tf_static"][0][1].transforms} == {"panda_link0"}
    assert set(world_from) == {"left_color_optical_frame", "right_color_optical_frame"}
    clouds = []
    for camera in ("left", "right"):
        (stamp, image), *_ = content[f"/camera/{camera}/aligned_depth_to_color/image_raw"]
        info = content[f"/camera/{camera}/aligned_depth_to_color/camera_info"][0][1]
        assert image.encoding == "16UC1" and image.header.frame_id == info.header.frame_id == f"{camera}_color_optical_frame"
        assert image.header.stamp == info.header.stamp and abs(convert.time_from_msg(image.header.stamp) - stamp * 1e-9) < 1e-6
        color = content[f"/camera/{camera}/color/image_raw"][0][1]
        assert color.encoding == "rgb8" and (color.width, color.height) == (640, 480) and color.header.stamp == image.header.stamp
        points = convert.intrinsics_from_msg(info).unproject(convert.depth_from_msg(image))
        clouds.append(transforms.apply(world_from[image.header.frame_id], points).reshape(-1, 3))
    cloud = np.concatenate(clouds)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    assert np.median(np.abs(cloud[:, 2])) < 0.004  # most of it is table, at z = 0
    for entry in truth["objects"]:
        shape = make(entry["family"], entry["seed"], **entry["parameters"])
        local = transforms.apply(transforms.inverse(pose_from_data(entry["world_from_object"])), cloud)
        low, high = shape.mesh.bounds
        world_height = cloud[:, 2] > 0.008
        inside = world_height & np.all((local > low - 0.004) & (local < high + 0.004), axis=1)
        assert inside.sum() > 250, entry["name"]
        assert transforms.apply(pose_from_data(entry["world_from_object"]), shape.mesh.vertices)[:, 2].min() == pytest.approx(
            0, abs=0.002
        ), entry["name"]
        if entry["known"]:
            continue
        x, y, _ = entry["world_from_object"]["position"]
        assert 0.35 <= x <= 0.72 and abs(y) < 0.35, entry["name"]


@pytest.mark.parametrize("name", ["hanging", "scooping"])
def test_fixtures_are_announced_complete(name: str) -> None:
    scene = convert.scene_from_msg(messages(BAGS / name)["/known_objects"][0][1])
    truth = [e for e in yaml.safe_load((BAGS / name / "truth.yaml").read_text())["objects"] if e["known"]]
    assert [o.id for o in scene.objects] == [e["name"] for e in truth] and scene.frame_id == "panda_link0"
    for item, entry in zip(scene.objects, truth, strict=True):
        assert item.source == "known" and item.pieces and item.view.mask.any()
        np.testing.assert_allclose(item.world_from_object, pose_from_data(entry["world_from_object"]), atol=1e-6)


@pytest.mark.parametrize("name", DEMONSTRATIONS)
def test_a_demonstration_does_what_its_strategy_says(name: str, recorder: ModuleType) -> None:
    from magic_core import strategy as strategies
    from magic_core.shapes.fixtures import demonstrated_pose

    task = name.removesuffix("_demonstration")
    strategy = strategies.load(Path(__file__).resolve().parents[1] / "strategies" / task)
    content = messages(BAGS / name)
    stamps = np.array([s for s, _ in content["/demonstration/tool_pose"]]) * 1e-9
    tool = np.stack([convert.pose_from_msg(m.pose) for _, m in content["/demonstration/tool_pose"]])
    target = np.stack([convert.pose_from_msg(m.pose) for _, m in content["/demonstration/target_pose"]])
    lying = stamps - stamps[0] <= recorder.REST
    assert np.abs(tool[lying] - tool[0]).max() < 1e-6 and tool[0][2, 3] < 0.05
    times = stamps - stamps[0] - recorder.REST - recorder.TAKE
    moving = (times >= 0) & (times <= strategy.times[-1])
    expected = transforms.interpolate(strategy.times, demonstrated_pose(strategy.environment) @ strategy.target_from_tool, times[moving])
    assert np.abs(tool[moving][:, :3, 3] - expected[:, :3, 3]).max() < 0.002
    if task == "hooking":
        assert target[0][0, 3] - target[:, 0, 3].min() > 0.2
    elif task == "scooping":
        assert target[-1][2, 3] > 0.2
    else:
        assert tool[-1][2, 3] > 0.2 and np.abs(tool[-1] - tool[-5]).max() < 0.01


def test_the_same_seed_gives_the_same_bytes(recorder: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "FRAMES", 1)
    monkeypatch.setattr(recorder, "D435", recorder.D435_SMALL)
    first, again = (recorder.record("hooking", tmp_path / folder, 5) for folder in ("a", "b"))
    for path in sorted(first.iterdir()):
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name
    other = recorder.record("hooking", tmp_path / "c", 6)
    assert (other / "hooking.mcap").read_bytes() != (first / "hooking.mcap").read_bytes()
    assert recorder.main(["--out", str(tmp_path / "d"), "hooking"]) == 0
    with pytest.raises(SystemExit):
        recorder.main(["--out", str(tmp_path), "juggling"])
