import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_core"
HERE = Path(__file__).resolve().parent
VERSION = ElementTree.parse(HERE / "package.xml").getroot().findtext("version")

setup(
    name=PACKAGE,
    version=VERSION,
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["goals/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=[
        "numpy<2",
        "scipy",
        "opencv-python-headless",
        "open3d",
        "trimesh",
        "shapely",
        "manifold3d",
        "matplotlib",
        "Pillow",
        "PyYAML",
        "threadpoolctl",
        "example-robot-data",
    ],
    extras_require={"networks": ["torch", "transformers"]},
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="Geometry, errors, strategies, procedural objects and message conversions that the MAGIC packages share.",
    license="Apache-2.0",
)
