import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "magic_server"
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
        (f"share/{PACKAGE}/config", ["config/strategy_server.param.yaml"]),
    ],
    install_requires=[
        "numpy<2",
        "scipy",
        "trimesh",
        beside("magic_core"),
    ],
    extras_require={"trees": ["py_trees"]},
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="MAGIC's strategy server: the stages of a run, the rule of what may move, and the arm.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"strategy_server = {PACKAGE}.programs:strategy_server",
        ]
    },
)
