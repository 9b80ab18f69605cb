# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``evaluate --protocol``: a table of recalls by method, tolerance and sequence length."""

import argparse
from dataclasses import asdict
import json

from stavpr_lab.commands.evaluate_sequences import (
    load_sequences,
    recognizer_settings,
    settings_json,
)
from stavpr_lab.evaluation.protocol import evaluate_protocol, text, TOLERANCES
from stavpr_lab.evaluation.report import jsonable
from stavpr_ros.commands.program import say
from stavpr_ros.output_file import JSON, require_replaceable, write_output

OF_REPORTS = (
    *('loop_closure', 'tolerance', 'unknown', 'odometry', 'output', 'export', 'window'),
    'calibrate',
)


def run_protocol(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """
    Print the table, and write it with --json.

    :param parser: for errors of options that contradict the table.
    :raises StavprError: an input cannot be read, or they do not fit together.
    """
    for name in OF_REPORTS:
        if getattr(arguments, name) not in (None, False):
            parser.error(f'--protocol: leave --{name.replace("_", "-")} out')
    if not (arguments.dataset or arguments.truth):
        parser.error('--protocol needs --truth identity|poses|FILE')
    arguments.tolerance = 0  # the tolerances of the table are added to it
    if arguments.json:
        require_replaceable(arguments.json, JSON, arguments.force)
    settings = recognizer_settings(arguments)
    sequences = load_sequences(arguments)
    drive, query, reference = sequences.drive, sequences.query.features, sequences.reference
    assert reference is not None  # without --loop-closure
    truths = {t: drive.recorded.widened(t).on_places(drive.places) for t in TOLERANCES}
    backend = arguments.backend, arguments.precision
    rows = list(evaluate_protocol(reference, query, truths, settings, backend=backend))
    say(f'{sequences.title}, with 95 % intervals')
    for t in TOLERANCES:
        print(f'\n+- {t:<9}{"images":>6}{"F1":>7}  {"recall@1":21}  at 100 % precision')
        for row in rows:
            if row.tolerance == t:
                columns = f'{text(row.recall_at_1)}  {text(row.recall_at_100_precision)}'
                print(f'{row.method:12}{row.length:6}{row.f1:7.3f}  {columns}')
    if arguments.json:
        table = [asdict(row) for row in rows]
        document = {'settings': settings_json(arguments, sequences), 'protocol': table}
        numbers = json.dumps(jsonable(document), indent=2) + '\n'
        write_output(arguments.json, numbers, JSON, arguments.force)
        say(f'numbers: {arguments.json}')
