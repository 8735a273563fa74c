"""How colcon builds the node; `pip install 'tactomo[ros2]'` brings what it imports."""

from setuptools import setup

NAME = "tactomo_node"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/tactomo.launch.py"]),
    ],
    entry_points={"console_scripts": [f"tactomo_node = {NAME}:main"]},
)
