import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_verifier"
HERE = Path(__file__).resolve().parent
VERSION = ElementTree.parse(HERE / "package.xml").getroot().findtext("version")


def beside(name: str) -> str:
    """A package of this repository as pip is told where it lies; by its name alone where it does not lie beside this one."""
    for folder in (HERE.parent / name, HERE.parent / "ros2_ws" / "src" / name):
        if (folder / "setup.py").is_file():
            return f"{name} @ {folder.resolve().as_uri()}"
    return name


setup(
    name=PACKAGE,
    version=VERSION,
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["config/verifier.param.yaml", "config/reality.yaml"]),
    ],
    install_requires=[
        "numpy<2",
        "scipy",
        "opencv-python-headless",
        "open3d",
        "trimesh",
        "shapely",
        "sapien",
        "torch",
        "mplib",
        "joblib",
        "matplotlib",
        "PyYAML",
        beside("magic_core"),
        beside("magic_perception"),
        beside("magic_matcher"),
        beside("magic_planner"),
        beside("magic_bags"),
        beside("magic_server"),
    ],
    extras_require={"maniskill": ["mani-skill", "gymnasium"]},
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="Runs a planned motion in physics and judges it by the strategy's goal test.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"verifier = {PACKAGE}.programs:verifier",
            f"evaluate = {PACKAGE}.programs:evaluate",
            f"learn = {PACKAGE}.programs:learn",
            f"reality = {PACKAGE}.programs:reality",
            f"benchmark = {PACKAGE}.programs:benchmark",
            f"maniskill = {PACKAGE}.programs:maniskill",
        ]
    },
)
