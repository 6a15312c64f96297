"""Every package.xml and setup.py names what its package imports, and there is one version."""

import ast
import importlib
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

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
    "jinja2": "python3-jinja2",
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
            name, name if name.startswith("magic_") or name.endswith(("_msgs", "_srvs", "_interfaces")) or name == "rosgraph_msgs" else None
        )
        if key is not None and key not in dependencies:
            missing[key] = file
    assert not missing, f"{package}/package.xml does not name {missing}"


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_what_is_named_is_imported(package):
    """Nothing is dragged in that is not used: the messages and packages of ROS and of this project."""
    folder = PACKAGES[package]
    used = set(imported(folder / package))
    ros = {d for d in named(folder / "package.xml") if d.startswith("magic_") or d.endswith(("_msgs", "_srvs")) or d == "rclpy"}
    unused = ros - used - {"magic_ros2cli"}
    # Launch files start other packages' nodes.
    text = "".join(p.read_text() for p in folder.rglob("*.xml") if "launch" in p.name)
    assert not {u for u in unused if f'pkg="{u}"' not in text and f"find-pkg-share {u})" not in text}


#: Imported name -> what pip calls it, where they differ.
WHEELS = {
    "cv2": "opencv-python-headless",
    "yaml": "PyYAML",
    "PIL": "Pillow",
    "jinja2": "Jinja2",
    "sklearn": "scikit-learn",
    "mani_skill": "mani-skill",
    "rerun": "rerun-sdk",
}
#: What comes with ROS, or with the workspace's build, and not from PyPI.
OF_ROS = {"rclpy", "launch", "ament_index_python", "magic_interfaces", "rcl_interfaces", "builtin_interfaces"}


def asked_of_pip(package, monkeypatch):
    """The requirements of a package's setup.py, and those of its extras: names without versions."""
    monkeypatch.chdir(PACKAGES[package])
    importlib.import_module("setuptools")  # it brings the distutils that Python 3.12 has no more
    distribution = importlib.import_module("distutils.core").run_setup("setup.py", stop_after="init")
    assert distribution.get_version() == versions()[f"{package}/package.xml"]
    plain, extra = distribution.install_requires, [r for group in distribution.extras_require.values() for r in group]
    return [{re.split(r"[<>=!~ @]", r)[0] for r in group} for group in (plain, extra)]


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_pip_is_asked_for_what_is_imported(package, monkeypatch):
    """`pip install ./PACKAGE` brings what its modules import; what only a network needs is an extra."""
    plain, extra = asked_of_pip(package, monkeypatch)
    folder = PACKAGES[package]
    for name, file in imported(folder / package).items():
        if name == package or name in sys.stdlib_module_names or name in OF_ROS or name.endswith(("_msgs", "_srvs")):
            continue
        assert WHEELS.get(name, name) in plain | extra, f"{package}/setup.py does not ask for {name}, which {file} imports"
    pinned = {line.partition("==")[0] for line in (ROOT / "ros2_ws/requirements.txt").read_text().splitlines() if "==" in line}
    here = {r for r in plain if not r.startswith("magic_")}
    assert here <= pinned, f"not pinned in requirements.txt: {here - pinned}"


def versions():
    """Where a version is written -> the version."""
    found = {f"{p.parent.name}/package.xml": ElementTree.parse(p).getroot().findtext("version") for p in MANIFESTS}
    found["CITATION.cff"] = str(yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"])
    found["CHANGELOG.md"] = re.search(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    return found


def test_there_is_one_version():
    assert len(set(versions().values())) == 1, versions()
