from glob import glob

from setuptools import find_packages, setup

PACKAGE = "magic_matcher"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", glob("config/*.yaml")),
    ],
    install_requires=["setuptools"],
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
