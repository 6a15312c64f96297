from setuptools import find_packages, setup

PACKAGE = "magic_lab"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["config/lab.param.yaml"]),
    ],
    install_requires=["setuptools"],
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
