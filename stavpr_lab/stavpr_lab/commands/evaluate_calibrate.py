# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``evaluate --calibrate``: the error rate of drives on a map, written into its file."""

import argparse
from dataclasses import replace
import hashlib
import math

import numpy as np
from stavpr_lab.commands.evaluate_sequences import (
    is_saved_map,
    load_sequences,
    recognizer_settings,
)
from stavpr_lab.evaluation.evaluate import recognize_all
from stavpr_lab.evaluation.metrics import published_matches
from stavpr_lab.evaluation.risk_control import add_risks, make_drives, measure_risks
from stavpr_ros.commands.program import say
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import open_map, select_places
from stavpr_ros.mapping.map_file import save_error_risks
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.method import PlaceRecognizer
from stavpr_ros.method.error_rate import ERRORS, least_probability
from stavpr_ros.output_file import FileVersion, MAP, require_replaceable
from stavpr_ros.progress import Progress

WINDOWS = 2  # of a block: as many images as a block of the bootstrap has
OTHERS = (
    *('loop_closure', 'dataset', 'unknown', 'odometry', 'json', 'output', 'export', 'window'),
    *('remove_from_map', 'reverse', 'speed', 'stop', 'drop', 'max_error'),
)


def run_calibrate(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """
    Drive the query on the map, write the error risks into its file, and print what they keep.

    :param parser: for errors of options that contradict this.
    :raises StavprError: an input cannot be read, they do not fit together, or the file of the map
        was replaced meanwhile or cannot be written; it stays as it was.
    """
    for name in OTHERS:
        if getattr(arguments, name):
            parser.error(f'--calibrate: leave --{name.replace("_", "-")} out')
    if arguments.truth is None or arguments.mode != 'robust':
        parser.error('--calibrate needs --truth identity|poses|FILE, and --mode robust')
    path = arguments.map
    if not is_saved_map(path):
        parser.error(f'--calibrate: --map {path} is no saved map; make one by build_map')
    require_replaceable(path, MAP, True)
    version = FileVersion.of(path)
    settings = recognizer_settings(arguments)
    sequences = load_sequences(arguments)
    reference, features = sequences.reference, sequences.query.features
    assert reference is not None  # without --loop-closure
    before = reference.error_risks if arguments.calibrate == 'add' else None
    key = settings.calibration_key
    if arguments.calibrate == 'add' and (before is None or before.method != key):
        raise SettingsError(
            f'--calibrate add: {path} has no calibration of these settings ({key}): leave add out'
        )
    recording = hashlib.sha256(np.ascontiguousarray(features.strips).data).hexdigest()[:16]
    if before is not None and recording in before.recordings:
        say(f'{sequences.title}: this recording is in the calibration already, which stays')
        return
    block, outcomes = WINDOWS * settings.sequence.length, []
    drives = list(make_drives(sequences.drive.truth, block))
    for drive in Progress(drives, desc='calibrating', unit='drive'):
        places = select_places(reference, drive.places) if drive.removed else reference
        recognizer = PlaceRecognizer(places, settings, arguments.backend, arguments.precision)
        matches = recognize_all(recognizer, features[drive.images])
        outcomes.append((drive, *published_matches(matches, settings.sequence.length)))
    risks = measure_risks(outcomes, block, key)
    risks = replace(risks, recordings=(recording,))
    say(
        f'{sequences.title}: {risks.units} blocks of {block} images, as recorded, at other speeds '
        'and with detours'
    )
    risks = risks if before is None else add_risks(risks, before)
    _print(risks)
    say(f'calibration in {path}, id {_store(path, version, reference.map_id, risks)}')


def _print(risks: ErrorRisks) -> None:
    """Print the probability that each error rate chooses, and where the map does not keep it."""
    print(f'{"max_error":>9}  matched above')
    bound = risks.bounds[-1]
    for rate in ERRORS.tolist():
        count = math.ceil(1 / rate - 1e-9) - 1
        why = f'{count} blocks are needed' if count > risks.units else 'too many wrong matches'
        note = '' if bound <= rate else f'not calibrated: {why}'
        print(f'{rate:9g}  {least_probability(rate, risks):<13.4g}  {note}'.rstrip())
    print(
        f'{risks.units} blocks in all keep {bound:.3g} at least; where not calibrated, the '
        'stricter of the built-in table and the mean of the blocks applies'
    )


def _store(path: str, version: FileVersion | None, map_id: str, risks: ErrorRisks) -> str:
    """Write the file of a map again, with risks; return its id."""
    if version is None or open_map(path).map_id != map_id:
        raise SettingsError(f'{path} was replaced meanwhile: start again')
    return save_error_risks(risks, path, version)
