# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Package description for ``colcon build``; the setup.py of stavpr_ros has that for pip."""

import subprocess
import sys
from xml.etree import ElementTree

from setuptools import find_packages, setup

MANIFEST = ElementTree.parse('package.xml')
NAME = 'stavpr_slam'

distribution = setup(
    name=NAME,
    version=MANIFEST.findtext('version'),
    description='SLAM with the loop closures of stavpr_ros: pose graph and bridges.',
    license='Apache-2.0',
    author='The stavpr_ros authors',
    maintainer=MANIFEST.findtext('maintainer'),
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={'': ['py.typed', '*.html', '*.jinja']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (
            f'lib/{NAME}',
            [f'scripts/{name}' for name in ('bridge', 'optimize_graph', 'pose_graph')],
        ),
    ],
    python_requires='>=3.11',
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'stavpr_ros',
    ],
    zip_safe=False,
)
by_colcon = not {'--build-base', '--build-directory'}.isdisjoint(sys.argv)
if by_colcon and '--uninstall' not in sys.argv:
    # fill the cache of compiled kernels, as the first start would; never fail
    install = distribution.get_command_obj('install').install_lib
    call = 'import sys; from stavpr_ros.commands.warm import main; sys.exit(main([]))'
    folder = '.' if 'develop' in sys.argv else install  # in which Python finds the package
    subprocess.run([sys.executable, '-c', call], cwd=folder, stderr=subprocess.STDOUT, check=False)
