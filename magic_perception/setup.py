import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_perception"
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
    package_data={PACKAGE: ["*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["config/perception.param.yaml"]),
    ],
    install_requires=[
        "numpy<2",
        "scipy",
        "opencv-python-headless",
        "open3d",
        "trimesh",
        "shapely",
        "mapbox_earcut",
        "contourpy",
        "manifold3d",
        beside("magic_core"),
    ],
    extras_require={"sam": ["torch", "transformers"], "learn": ["scikit-learn"]},
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="RGB-D frames of a table-top to objects: masks, clouds, watertight meshes with convex pieces, canonical views.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "perception = magic_perception.programs:perception",
            "perceive_images = magic_perception.programs:perceive_images",
            "evaluate = magic_perception.programs:evaluate",
            "learn_seams = magic_perception.programs:learn_seams",
            "learn_confidence = magic_perception.programs:learn_confidence",
            "learn_surface_error = magic_perception.programs:learn_surface_error",
        ]
    },
)
