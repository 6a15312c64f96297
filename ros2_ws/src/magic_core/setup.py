from setuptools import find_packages, setup

PACKAGE = "magic_core"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="Geometry, errors, strategies, procedural objects and message conversions that the MAGIC packages share.",
    license="Apache-2.0",
)
