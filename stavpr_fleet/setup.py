# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Package description for ``colcon build``; the setup.py of stavpr_ros has that for pip."""

from xml.etree import ElementTree

from setuptools import find_packages, setup

MANIFEST = ElementTree.parse('package.xml')
NAME = 'stavpr_fleet'

setup(
    name=NAME,
    version=MANIFEST.findtext('version'),
    description='Maps of stavpr_ros for a fleet of robots, in FAISS or Qdrant.',
    license='Apache-2.0',
    author='The stavpr_ros authors',
    maintainer=MANIFEST.findtext('maintainer'),
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
    ],
    python_requires='>=3.11',
    install_requires=['numpy>=1.26', 'stavpr_ros'],
    extras_require={
        'faiss': ['faiss-cpu>=1.8'],
        'fleet': ['faiss-cpu>=1.8', 'qdrant-client>=1.15', 'qdrant-edge-py>=0.5'],
    },
    zip_safe=False,
)
