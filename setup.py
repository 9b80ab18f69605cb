"""Installs the Python package the way that colcon and ``ros2 run`` expect it."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'stavpr_ros'
EXECUTABLES = ('node', 'build_map', 'replay', 'demo', 'record', 'evaluate', 'experiments')


def files_in(folder: str) -> list[str]:
    """List the files of a folder, as paths relative to this one."""
    return sorted(path for path in glob(f'{folder}/*') if Path(path).is_file())


setup(
    name=NAME,
    version='0.1.0',
    description='STA-VPR place recognition: spatio-temporal alignment of image sequences, as a ROS 2 node.',
    license='Apache-2.0',
    author='The stavpr_ros authors',
    maintainer='The stavpr_ros maintainers',
    maintainer_email='maintainers@stavpr-ros.org',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', files_in('config')),
        (f'share/{NAME}/launch', files_in('launch')),
    ],
    python_requires='>=3.11',
    install_requires=['setuptools'],
    extras_require={
        'cuda': ['numba-cuda>=0.30'],
        'evaluation': ['scikit-learn'],
        'onnx': ['onnx', 'onnxruntime'],
        'test': ['pytest'],
    },
    zip_safe=True,
    entry_points={
        'console_scripts': [f'{name} = {NAME}.commands.{name}:main' for name in EXECUTABLES],
    },
)
