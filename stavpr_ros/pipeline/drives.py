# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recorded drives on their way into the map of localization: on the disk until they are in it.

``route.stavpr.history/drives`` has each drive as a map of its images, whose name is the drive's.
It is written at once, before the map is updated, which takes long; whatever ends the program, the
next one finds the drive there, or in a version of the map.
"""

from collections.abc import Callable
from contextlib import suppress
import fcntl
from logging import Logger
from pathlib import Path
import time
from typing import Any

from stavpr_ros.errors import InputError, MapFileError, OutputTakenError
from stavpr_ros.maintenance.upkeep import update_file
from stavpr_ros.mapping import load_map, Map, open_map, save_map
from stavpr_ros.mapping.journal_map import DAMAGED
from stavpr_ros.mapping.versions import history_of, versions
from stavpr_ros.output_file import explain, FileVersion, numbered_names
from stavpr_ros.pipeline.operations import Operation
from stavpr_ros.units import DATED, SECOND

LOCK = '.lock'
OnWorker = Callable[[Callable[[], Any]], Any]


def write_drives(operation: Operation, on_worker: OnWorker) -> None:
    """
    Move the recorded drives of an operation from memory to files, on this thread.

    :param on_worker: calls a function on the thread of the operation.
    :raises OutputError: a drive cannot be written; it stays in memory, as all later ones.
    """
    drives = on_worker(operation.take_drives)
    try:
        while drives:
            _write(operation.save_state.path, drives[0].snapshot())
            del drives[0]
    finally:
        if drives:
            on_worker(lambda: operation.return_drives(drives))


def take_up_drives(path: str, log: 'Logger | Any', on_update: Callable[[], object]) -> int:
    """
    Let the drives that were written update the file of their map, oldest first; delete them.

    :param on_update: called after each update.
    :returns: places of the last version; 0 = there is none, the log has the reasons.
    :raises StavprError: a file that cannot be read or written; map and drives stay as they are.
    """
    places, folder = 0, _folder(path)
    if not folder.is_dir():
        return places
    with explain(folder), (folder / LOCK).open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until no other program, or thread, updates the map
        files = sorted(folder.glob('*.stavpr'), key=lambda file: file.stem)
        if files:
            log.info(f'updating {path} with {len(files)} drives, which are in {folder} until then')
        for file in files:
            name, opened, place_map = file.stem, FileVersion.of(path), load_map(path)
            try:
                drive = load_map(file)
            except MapFileError as error:
                damaged = file.rename(file.with_name(file.name + DAMAGED))
                log.error(f'{name} does not update {path}: {error}; {damaged} is kept')
                continue
            try:
                if name not in (version.drive for version in versions(path)):
                    version = update_file(path, opened, place_map, drive, name)
                    on_update()
                    places = len(open_map(path))
                    changes = '; '.join(version.changes)
                    log.info(f'{name} updates {path}, {places} places: {changes}')
            except InputError as error:
                log.warning(f'{name} does not update {path}: {error}')
            file.unlink()
    return places


def _folder(path: str) -> Path:
    return history_of(path) / 'drives'


def _write(path: str, drive: Map) -> None:
    """Write a drive under a name that no other drive of the map has."""
    folder, names = _folder(path), set()
    with explain(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with suppress(MapFileError):
        names = {version.drive for version in versions(path)}
    start = int(drive.stamps[0])  # the drive of a simulation is named by the present time
    seconds = start / SECOND if start >= DATED else time.time()
    name = time.strftime('drive %Y-%m-%d %H-%M-%S.stavpr', time.gmtime(seconds))
    for file in numbered_names(folder / name):
        if file.stem not in names:
            with suppress(OutputTakenError):
                save_map(drive, file)
                return
