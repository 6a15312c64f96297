import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_lab"
HERE = Path(__file__).resolve().parent
VERSION = ElementTree.parse(HERE / "package.xml").getroot().findtext("version")


def beside(name: str) -> str:
    """A package of this repository as pip is told where it lies; by its name alone where it does not lie beside this one."""
    for folder in (HERE.parent / name, HERE.parents[2] / name):
        if (folder / "setup.py").is_file():
            return f"{name} @ {folder.resolve().as_uri()}"
    return name


setup(
    name=PACKAGE,
    version=VERSION,
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["config/lab.param.yaml", "config/strategy_server.param.yaml"]),
    ],
    install_requires=[
        "numpy<2",
        "opencv-python-headless",
        "shapely",
        "trimesh",
        beside("magic_core"),
        beside("magic_bringup"),
        beside("magic_server"),
        beside("magic_verifier"),
    ],
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="A laboratory in simulation behind the topics and actions of a real one, and trials in it.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"lab = {PACKAGE}.programs:lab",
            f"trials = {PACKAGE}.programs:trials",
        ]
    },
)
