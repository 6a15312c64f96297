"""Every package.xml names what its package imports."""

import ast
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MANIFESTS = sorted([*ROOT.glob("magic_*/package.xml"), *(ROOT / "ros2_ws/src").glob("magic_*/package.xml")])
PACKAGES = {p.parent.name: p.parent for p in MANIFESTS if (p.parent / p.parent.name).is_dir()}
#: Imported name -> rosdep key, where they differ; what has no key comes from requirements.txt.
KEYS = {
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "cv2": "python3-opencv",
    "yaml": "python3-yaml",
    "matplotlib": "python3-matplotlib",
    "PIL": "python3-pil",
    "contourpy": "python3-contourpy",
    "shapely": "python3-shapely",
    "skimage": "python3-skimage",
    "joblib": "python3-joblib",
    "networkx": "python3-networkx",
    "ament_index_python": "ament_index_python",
    "rclpy": "rclpy",
    "launch": "launch",
}


def imported(folder: Path) -> dict[str, str]:
    """Top-level names that the modules below a folder import, each with one of the files that do."""
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [a.name for a in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names = [node.module]
            for name in names:
                found.setdefault(name.partition(".")[0], path.name)
    return found


def named(manifest: Path) -> set[str]:
    root = ElementTree.parse(manifest).getroot()
    return {e.text for kind in ("depend", "exec_depend") for e in root.iter(kind)}


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_what_is_imported_is_named(package):
    folder = PACKAGES[package]
    dependencies = named(folder / "package.xml")
    missing = {}
    for name, file in imported(folder / package).items():
        if name == package or name in sys.stdlib_module_names:
            continue
        key = KEYS.get(
            name, name if name.startswith("magic_") or name.endswith(("_msgs", "_interfaces")) or name == "rosgraph_msgs" else None
        )
        if key is not None and key not in dependencies:
            missing[key] = file
    assert not missing, f"{package}/package.xml does not name {missing}"


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_what_is_named_is_imported(package):
    """Nothing is dragged in that is not used: the messages and packages of ROS and of this project."""
    folder = PACKAGES[package]
    used = set(imported(folder / package))
    ros = {d for d in named(folder / "package.xml") if d.startswith("magic_") or d.endswith("_msgs") or d == "rclpy"}
    unused = ros - used - {"magic_ros2cli"}
    # Launch files start other packages' nodes.
    text = "".join(p.read_text() for p in folder.rglob("*.xml") if "launch" in p.name)
    assert not {u for u in unused if f'pkg="{u}"' not in text and f"find-pkg-share {u})" not in text}
