import xml.etree.ElementTree as ElementTree
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_matcher"
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
        (f"share/{PACKAGE}/config", glob("config/*.yaml")),
    ],
    install_requires=["numpy<2", "scipy", "opencv-python-headless", "open3d", "shapely", "contourpy", "trimesh", beside("magic_core")],
    extras_require={"dinov2": ["torch", "transformers"], "diffusion": ["torch", "transformers", "diffusers"]},
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="Finds the contact on a new tool that corresponds to the contact of one demonstration.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "matcher = magic_matcher.programs:matcher",
            "match_images = magic_matcher.programs:match_images",
            "match_meshes = magic_matcher.programs:match_meshes",
            "bench = magic_matcher.programs:bench",
        ],
    },
)
