"""Installs the package, for colcon (ament_python) and for pip."""

import logging
import os
from pathlib import Path
import subprocess
import sys

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.develop import develop

NAME = 'rs_relpose_ros'
LABORATORY = 'rs_relpose_lab'


def files_in(folder: str) -> list[str]:
    """Files directly in `folder`, relative to the package root, as data_files takes them."""
    return sorted(str(path) for path in Path(folder).glob('[!.]*') if path.is_file())


def compile_kernels(folder: str) -> None:
    """Fill the kernel cache of the package in `folder`, so that no start of the node has to.

    In a process of its own that sees what the installed package will see: build environments (pip
    without its option --no-build-isolation, colcon) put a sitecustomize.py in front.
    """
    paths = [path for path in os.environ.get('PYTHONPATH', '').split(os.pathsep)
             if path and not (Path(path) / 'sitecustomize.py').exists()]
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(paths)}
    for module in ('front_end', 'global_shutter', 'odometry'):
        filled = subprocess.run([sys.executable, '-m', f'{NAME}.{module}.warm_up'], cwd=folder,
                                env=environment, stderr=subprocess.PIPE, text=True, check=False)
        if filled.returncode:
            reason = (filled.stderr.splitlines() or ['no reason given'])[-1]
            logging.getLogger(NAME).warning(
                'kernels will be compiled by the first start of the node: %s', reason)


class BuildWithKernels(build_py):
    """What pip and colcon run; editable (pip), the package is used where its source lies."""

    def run(self) -> None:
        """Copy the modules and compile their kernels."""
        super().run()
        compile_kernels('.' if self.editable_mode else self.build_lib)


class DevelopWithKernels(develop):
    """What ``colcon build --symlink-install`` runs."""

    def run(self) -> None:
        """Link the modules and compile their kernels."""
        super().run()
        if not self.uninstall:
            compile_kernels('.')


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
    extras_require={
        'test': ['pytest'],
        'odometry': ['gtsam>=4.3,<4.4'],
        'video': ['av>=13,<19', 'telemetry-parser>=0.3,<0.4'],
        'batch': ['dask[distributed]>=2024.5'],
    },
    zip_safe=False,
    cmdclass={'build_py': BuildWithKernels, 'develop': DevelopWithKernels},
    entry_points={
        'console_scripts': [
            'relpose_node = rs_relpose_ros.node.start:main',
            'global_shutter_node = rs_relpose_ros.global_shutter.start:main',
            'odometry_node = rs_relpose_ros.odometry.start:main',
            'rs_relpose = rs_relpose_ros.cli.main:main',
        ],
    },
)
