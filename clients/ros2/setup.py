"""The package of the node, as colcon's ament_python builds it; pip builds it too."""

from glob import glob

from setuptools import find_packages, setup

NAME = "placerec_ros"

setup(
    name=NAME,
    version="1.0.0",
    description="A lifecycle node of ROS 2 that localizes a robot by a placerec service.",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    python_requires=">=3.11",
    # rclpy and the messages come with ROS, or from the wheels that README.md names.
    install_requires=["numpy", "placerec-client"],
    extras_require={"test": ["pytest"]},  # by which colcon test knows how to run them
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*.yaml")),
    ],
    zip_safe=False,
    entry_points={"console_scripts": [f"placerec_node = {NAME}.node:main"]},
)
