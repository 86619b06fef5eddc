"""The guard as colcon (ament_python) and pip install it."""

from setuptools import setup

NAME = "ros1_master_guard"

setup(
    name=NAME,
    version="0.1.0",
    description="Keeps a ROS 1 master alive",
    license="Apache-2.0",
    maintainer="The holdfast developers",
    maintainer_email="holdfast@example.org",
    python_requires=">=3.11",
    package_dir={"": "."},
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    entry_points={"console_scripts": [f"{NAME} = {NAME}.command:main"]},
    zip_safe=False,
)
