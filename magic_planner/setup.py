from glob import glob

from setuptools import find_packages, setup

PACKAGE = "magic_planner"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", glob("config/*.yaml")),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="From a matched contact to the motion of the tool and of the arm that holds it.",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"planner = {PACKAGE}.programs:planner"]},
)
