"""How colcon and pip install the package."""

from setuptools import setup

NAME = "handmap_ros2"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/handmap.launch.py"]),
        (f"share/{NAME}/config", ["config/handmap.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    license="Apache-2.0",
    # ROS brings what the node needs; `handmap ros2` needs no ROS.
    extras_require={
        "dds": [
            "cyclonedds>=11,<12",
            "handmap-qp[service]>=0.2,<0.3",
            "rosbags>=0.11.6,<0.12",
        ]
    },
    entry_points={
        "console_scripts": [f"{NAME}_node = {NAME}.node:main"],
        "handmap_qp.commands": [f"ros2 = {NAME}.cli:Ros2"],
    },
)
