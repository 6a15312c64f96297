from setuptools import find_packages, setup

PACKAGE = "magic_verifier"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={PACKAGE: ["*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", ["config/verifier.param.yaml", "config/reality.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="Runs a planned motion in physics and judges it by the strategy's goal test.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"verifier = {PACKAGE}.programs:verifier",
            f"evaluate = {PACKAGE}.programs:evaluate",
            f"learn = {PACKAGE}.programs:learn",
            f"reality = {PACKAGE}.programs:reality",
            f"benchmark = {PACKAGE}.programs:benchmark",
        ]
    },
)
