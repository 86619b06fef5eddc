"""The ROS package as colcon (ament_python) and pip install it."""

from setuptools import setup

NAME = "holdfast_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="holdfast in ROS 1 and ROS 2",
    license="Apache-2.0",
    maintainer="The holdfast developers",
    maintainer_email="holdfast@example.org",
    python_requires=">=3.11",
    install_requires=["holdfast-sensing==0.1.0", "ros1_master_guard==0.1.0", "rosbags>=0.11"],
    extras_require={"test": ["pytest"]},  # so that colcon test takes pytest
    package_dir={"": "."},
    packages=[NAME, f"{NAME}.ros2"],
    package_data={NAME: ["interfaces/*/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        # For ros2 run holdfast_ros node. pip would put a console script of that name on the path.
        (f"lib/{NAME}", ["scripts/node"]),
    ],
    entry_points={
        "holdfast.commands": [f"ros1-guard = {NAME}.ros1_guard", f"ros1-serve = {NAME}.ros1_serve"]
    },
    zip_safe=False,
)
