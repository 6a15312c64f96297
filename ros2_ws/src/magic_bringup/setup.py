import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_bringup"
HERE = Path(__file__).resolve().parent
VERSION = ElementTree.parse(HERE / "package.xml").getroot().findtext("version")


def beside(name: str) -> str:
    """A package of this repository as pip is told where it lies; by its name alone where it does not lie beside this one."""
    for folder in (HERE.parent / name, HERE.parent / "ros2_ws" / "src" / name):
        if (folder / "setup.py").is_file():
            return f"{name} @ {folder.resolve().as_uri()}"
    return name


def tree(*folders: str) -> list[tuple[str, list[str]]]:
    """Every file below the folders, to be installed under the package's share at the same relative place."""
    found: dict[str, list[str]] = {}
    for folder in folders:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                found.setdefault(f"share/{PACKAGE}/{path.parent.as_posix()}", []).append(path.as_posix())
    return sorted(found.items())


setup(
    name=PACKAGE,
    version=VERSION,
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *tree("launch", "config", "strategies", "rviz", "foxglove"),
    ],
    install_requires=[
        "numpy<2",
        "opencv-python-headless",
        "matplotlib",
        "Pillow",
        "Jinja2",
        "PyYAML",
        beside("magic_core"),
        beside("magic_bags"),
        beside("magic_perception"),
        beside("magic_server"),
    ],
    extras_require={"rerun": ["rerun-sdk"]},
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="Launch files, parameters, strategies, the demo, its report and the command line of MAGIC.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "strategy_server = magic_bringup.programs:strategy_server",
            "magic = magic_bringup.programs:magic",
            "report = magic_bringup.programs:report",
            "calibrate_cameras = magic_bringup.programs:calibrate_cameras",
            "reference = magic_bringup.programs:reference",
            "goal_times = magic_bringup.programs:goal_times",
            "rgbd_to_bag = magic_bringup.programs:rgbd_to_bag",
            "bag_player = magic_bringup.programs:bag_player",
            "bridge = magic_bringup.programs:bridge",
            "detected_objects = magic_bringup.programs:detected_objects",
            "robot_model = magic_bringup.programs:robot_model",
            "bag_recorder = magic_bringup.programs:bag_recorder",
            "trials = magic_bringup.programs:trials",
        ],
    },
)
