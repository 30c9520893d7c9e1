"""Installs the package, for colcon (ament_python) and for pip."""

import logging
import os
from pathlib import Path
import re
import subprocess
import sys

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.develop import develop

NAME = 'rs_relpose_ros'
# Module -> call in it that compiles the kernels of a node with its default parameters.
WARM_UPS = {
    'pipeline.warm_up': 'cache_is_filled() or module.fill_cache()',
    'calibrate.procedure': 'warm_up_fit()',
    'pipeline.global_shutter': 'warm_up_unroller(module.Parameters())',
    'odometry.pair': 'warm_up_odometry()',
}


def version() -> str:
    """Version in package.xml, the only source of it."""
    manifest = Path('package.xml').read_text(encoding='utf-8')
    found = re.search(r'<version>([0-9]+\.[0-9]+\.[0-9]+)</version>', manifest)
    if found is None:
        sys.exit('package.xml has no <version> of three numbers, such as 0.4.0')
    return found[1]


def files_in(folder: str) -> list[str]:
    """Files directly in `folder`, relative to the package root, as data_files takes them."""
    return sorted(str(path) for path in Path(folder).glob('[!.]*') if path.is_file())


def libraries() -> list[str]:
    """Run-time dependencies from PyPI: requirements/base.txt without ROS and the build tool."""
    lines = Path('requirements', 'base.txt').read_text().splitlines()
    return [line for line in lines if not line.startswith(('#', 'ros-', 'setuptools'))]


def laboratory() -> str:
    """Requirement of the extra `lab`: the folder in this checkout.

    A distribution for others has no path of the machine that built it: its laboratory is a
    distribution of the same version.
    """
    folder = Path(__file__).resolve().with_name('rs_relpose_lab')
    if 'sdist' not in sys.argv and (folder / 'pyproject.toml').exists():
        return f'rs_relpose_lab @ {folder.as_uri()}'
    return f'rs_relpose_lab=={version()}'


def compile_kernels(folder: str) -> None:
    """Fill the kernel cache of the package in `folder`, so that no start of the node has to.

    In a process of its own that sees what the installed package will see: build environments (pip
    without its option --no-build-isolation, colcon) put a sitecustomize.py in front.
    """
    paths = [
        path
        for path in os.environ.get('PYTHONPATH', '').split(os.pathsep)
        if path and not (Path(path) / 'sitecustomize.py').exists()
    ]
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(paths)}
    commands = [
        [sys.executable, '-c', f'import {NAME}.{module} as module; module.{call}']
        for module, call in WARM_UPS.items()
    ]
    # The first one uses two cores, and has most of what the others need.
    for group in (commands[:1], commands[1:]):
        for process in [
            subprocess.Popen(
                command, cwd=folder, env=environment, text=True, stderr=subprocess.PIPE
            )
            for command in group
        ]:
            _, errors = process.communicate()
            if process.returncode:
                reason = (errors.splitlines() or ['no reason given'])[-1]
                logging.getLogger(NAME).warning(
                    'kernels will be compiled by the first start of the node: %s', reason
                )


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
    version=version(),
    description='Relative pose of two rolling-shutter images, aided by an IMU',
    long_description=Path('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    maintainer='rs_relpose_ros maintainers',
    license='Apache-2.0',
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, NAME + '.*']),
    package_data={NAME: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + NAME]),
        ('share/' + NAME, ['package.xml']),
        ('share/' + NAME + '/config', files_in('config')),
        ('share/' + NAME + '/launch', files_in('launch')),
    ],
    # For pip. On a ROS machine colcon resolves none of them: rosdep installs those in package.xml.
    # Use pip with --no-deps there. It does not recognise Ubuntu's OpenCV as opencv-python-headless
    # and would install that, and perhaps another NumPy, over Ubuntu's.
    install_requires=['setuptools', *libraries()],
    extras_require={
        # Simulator, live measurements, experiments: simulate, benchmark and evaluate.
        'lab': [laboratory()],
        'test': ['pytest'],
        'docs': ['sphinx>=7.2,<10', 'myst-parser>=3,<6', 'numpydoc>=1.6,<2'],
        'odometry': ['gtsam>=4.3,<4.4'],
        'video': ['av>=13,<19', 'telemetry-parser>=0.3,<0.4'],
        'ncore': ['nvidia-ncore>=19.8'],
        'batch': ['dask[distributed]>=2024.5'],
    },
    zip_safe=False,
    cmdclass={'build_py': BuildWithKernels, 'develop': DevelopWithKernels},
    entry_points={
        'console_scripts': [
            'relpose_node = rs_relpose_ros.nodes.start:relpose_node',
            'global_shutter_node = rs_relpose_ros.nodes.start:global_shutter_node',
            'odometry_node = rs_relpose_ros.nodes.start:odometry_node',
            'rs_relpose = rs_relpose_ros.cli.main:main',
        ],
    },
)
