import xml.etree.ElementTree as ElementTree
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_planner"
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
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", glob("config/*.yaml")),
    ],
    install_requires=["numpy<2", "scipy", "mplib", "toppra", "trimesh", beside("magic_core")],
    extras_require={"xacro": ["xacro"], "alternatives": ["ssik"]},
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="From a matched contact to the motion of the tool and of the arm that holds it.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"planner = {PACKAGE}.programs:planner",
            f"describe_robot = {PACKAGE}.programs:describe_robot",
        ]
    },
)
