"""Installs the package, for colcon (ament_python) and for pip."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = 'rs_relpose_ros'
LABORATORY = 'rs_relpose_lab'


def files_in(folder: str) -> list[str]:
    """Files directly in `folder`, relative to the package root, as data_files takes them."""
    return sorted(str(path) for path in Path(folder).glob('[!.]*') if path.is_file())


setup(
    name=NAME,
    version='0.1.0',
    description='Relative pose of two rolling-shutter images, aided by an IMU',
    maintainer='rs_relpose_ros maintainers',
    maintainer_email='maintainers@users.noreply.h-seed-7badc013.example',
    license='Apache-2.0',
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, NAME + '.*', LABORATORY, LABORATORY + '.*']),
    package_data={NAME: ['py.typed'], LABORATORY: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + NAME]),
        ('share/' + NAME, ['package.xml']),
        ('share/' + NAME + '/config', files_in('config')),
        ('share/' + NAME + '/launch', files_in('launch')),
    ],
    # Run-time dependencies are rosdep keys in package.xml and, for pip, requirements/base.txt.
    # Named here, pip would lay its own OpenCV and NumPy over those of a ROS machine.
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'relpose_node = rs_relpose_ros.node.start:main',
            'rs_relpose = rs_relpose_ros.cli.main:main',
        ],
    },
)
