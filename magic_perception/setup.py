from setuptools import find_packages, setup

PACKAGE = "magic_perception"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["config/perception.param.yaml"]),
    ],
    install_requires=["setuptools"],
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
        ]
    },
)
