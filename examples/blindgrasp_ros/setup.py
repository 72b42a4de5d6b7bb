from setuptools import setup

setup(
    name="blindgrasp_ros",
    version="0.1.0",
    packages=["blindgrasp_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/blindgrasp_ros"]),
        ("share/blindgrasp_ros", ["package.xml"]),
        ("share/blindgrasp_ros/launch", ["launch/gate.launch.py"]),
    ],
    install_requires=["setuptools"],
    entry_points={
        "console_scripts": [f"{node} = blindgrasp_ros.{node}:main" for node in ("hand", "decisions", "lift_gate", "gripper_gate")]
    },
)
