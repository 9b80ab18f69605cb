# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands of this package, one in each module, and their table."""

from stavpr_ros.commands import Command

TEXTS = {
    'weights': 'get the published weights of a network',
    'export_model': 'make one ONNX file of a network of vectors and maps',
    'build_descriptor_map': 'make a map of descriptors that another program computed',
    'evaluate': 'evaluate the recognition of one traverse on the map of another',
    'experiments': "reproduce the paper's tables on local data sets",
    'monitor': 'show the node in a web browser',
    'demo': 'build, run and evaluate everything on a synthetic street',
}
WITH_ROS = {'monitor', 'demo'}
COMMANDS = {
    name: Command(f'stavpr_lab.commands.{name}', text, name in WITH_ROS)
    for name, text in TEXTS.items()
}
