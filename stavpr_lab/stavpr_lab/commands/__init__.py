# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands of this package, one in each module, and their table."""

from stavpr_ros.commands import Command

COMMANDS = {
    'weights': Command(
        'stavpr_lab.commands.weights', 'download the published weights of a network'
    ),
    'export_model': Command(
        'stavpr_lab.commands.export_model', 'make one ONNX file of a network of vectors and maps'
    ),
    'evaluate': Command(
        'stavpr_lab.commands.evaluate',
        'evaluate the recognition of one traverse on the map of another',
    ),
    'experiments': Command(
        'stavpr_lab.commands.experiments', "reproduce the paper's tables on local data sets"
    ),
    'monitor': Command('stavpr_lab.commands.monitor', 'show the node in a web browser', True),
    'demo': Command(
        'stavpr_lab.commands.demo',
        'build, run and evaluate everything on a synthetic street',
        True,
    ),
}
