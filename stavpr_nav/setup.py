# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Package description for ``colcon build``; the setup.py of stavpr_ros has that for pip."""

from xml.etree import ElementTree

from setuptools import find_packages, setup

MANIFEST = ElementTree.parse('package.xml')
NAME = 'stavpr_nav'

setup(
    name=NAME,
    version=MANIFEST.findtext('version'),
    description='Teach and repeat with one camera, on stavpr_ros.',
    license='Apache-2.0',
    author='The stavpr_ros authors',
    maintainer=MANIFEST.findtext('maintainer'),
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', ['launch/teach.launch.py', 'launch/repeat.launch.py']),
        (f'lib/{NAME}', ['scripts/teach', 'scripts/repeat']),
    ],
    python_requires='>=3.11',
    install_requires=['numpy>=1.26', 'opencv-python-headless>=4.6', 'stavpr_ros'],
    zip_safe=False,
)
