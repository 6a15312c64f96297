from setuptools import find_packages, setup

PACKAGE = "magic_ros2cli"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        # A file of its own instead of a console script: it starts faster, and bin is put on PATH by colcon.
        ("bin", ["scripts/ros2"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="MAGIC developers",
    maintainer_email="maintainers@magic-robotics.org",
    description="A small ros2 command for environments that have rclpy but no ros2cli.",
    license="Apache-2.0",
)
