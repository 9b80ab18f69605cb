# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Saving a recorded map while images are processed; files of other maps are never overwritten."""

from contextlib import suppress
from logging import Logger
from pathlib import Path
from typing import Any

from stavpr_ros.errors import JournalError, OutputTakenError, StavprError
from stavpr_ros.maintenance.same_places import with_last_related, with_repeats
from stavpr_ros.mapping import Map, save_map
from stavpr_ros.mapping.journal import Base
from stavpr_ros.mapping.journal_map import journals, recover
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.output_file import FileVersion, Force, MAP, numbered_names, require_replaceable
from stavpr_ros.pipeline.drives import OnWorker, take_up_drives, write_drives
from stavpr_ros.pipeline.pipeline import Pipeline
from stavpr_ros.prepare.prepared_map import statistics_of_map


def write_map(pipeline: Pipeline, on_worker: OnWorker, path: str, overwrite: Force) -> int:
    """
    Write the map of the pipeline to a file, on this thread; return its number of places.

    A recording that repeats its route is written once more, with its laps divided or its seam,
    which takes long to find: what ends the program meanwhile leaves the map of one session.

    :param on_worker: calls a function on the thread of the pipeline.
    :raises StavprError: no places, an existing file, or a file that cannot be written.
    """
    require_replaceable(path, MAP, overwrite)  # before places are copied
    snapshot = on_worker(pipeline.snapshot)
    places = snapshot.places
    save_map(places, path, force=overwrite, statistics=statistics_of_map(places))
    written = FileVersion.of(path)
    on_worker(lambda: snapshot.mark_saved(path))
    if snapshot.recorded and (repeats := with_repeats(places)) is not places:
        with suppress(OutputTakenError):  # a later save was faster
            save_map(repeats, path, force=written or False, statistics=statistics_of_map(repeats))
            on_worker(lambda: snapshot.state.own(path))
    return len(places)


def update_own_map(pipeline: Pipeline, on_worker: OnWorker, log: 'Logger | Any') -> int:
    """
    Let the drives of localization update the file of its map (docs/upkeep.md), on this thread.

    They are on the disk before, where the next call or start finds them after an error.

    :returns: places of the last version; 0 = there is none, the log has the reasons.
    :raises StavprError: a file that cannot be read or written; it stays as it is.
    """
    operation, state = pipeline.operation, pipeline.save_state
    if not operation.drives:
        return 0
    write_drives(operation, on_worker)
    return take_up_drives(state.path, log, lambda: state.own(state.path))


def take_up_earlier_drives(path: str, log: 'Logger | Any') -> None:
    """Let the drives of an earlier run update the file of its map, before it is loaded."""
    try:
        take_up_drives(path, log, lambda: None)
    except Exception as error:  # any error: the node must start
        cause = str(error) if isinstance(error, StavprError) else repr(error)
        log.error(f'the drives of an earlier run are not in {path}: {cause}')


def save_recorded_map(
    pipeline: Pipeline, on_worker: OnWorker, path: str, log: 'Logger | Any'
) -> bool:
    """
    Write unsaved places to ``path``, or update the map of localization; log errors.

    A file of another map is not overwritten, a numbered name beside it is used.

    :param path: '' = nowhere; that is logged.
    :returns: whether nothing failed.
    """
    try:
        update_own_map(pipeline, on_worker, log)
        unsaved = on_worker(lambda: pipeline.unsaved)  # includes the image being processed
        if unsaved and path:
            log.info(f'writing the map to {path}')
            places, target = _write_beside(pipeline, on_worker, path)
            log.info(f'{places} places written to {target}')
        elif unsaved and pipeline.operation.name != 'loop_closure':
            log.warning(f'recorded places not saved: {unsaved}; set save_path, or call ~/save_map')
        return True
    except TimeoutError:
        if not (pipeline.unsaved or any(map(len, pipeline.operation.drives))):
            return True
        log.error('the map is not saved: the worker is still busy at the end of the node')
    except Exception as error:  # any error: the node must end, and the loss must be logged
        cause = str(error) if isinstance(error, StavprError) else repr(error)
        log.error(f'the map is not saved: {cause}')
    return False


def recover_maps(target: str | Path, log: 'Logger | Any', is_own: bool = True) -> str:
    """
    Make maps of the journals that a killed node, or a failed save, has left; log each.

    :param target: file that maps are saved to; journals of numbered names count too.
    :param is_own: whether they are of this node; others are only logged.
    :returns: the file of the latest map; '' = there were no journals.
    """
    latest = ''
    for journal in journals(target):
        if not is_own:
            log.warning(
                f'{journal} has places of another recording: a node in mapping, or `stavpr map '
                'recover`, makes a map of them'
            )
            continue
        try:
            recovery = recover(journal, relate=with_last_related)
        except Exception as error:  # any error: the node must start
            cause = str(error) if isinstance(error, StavprError) else repr(error)
            log.warning(f'the journal {journal} was left as it is: {cause}')
            continue
        latest = recovery.path
        log.warning(
            f'{recovery.recorded} places of an earlier recording were recovered from {journal}: '
            f'{recovery.path} has {recovery.places} places'
        )
        for problem in recovery.problems:
            log.error(problem)
    return latest


def open_journal(
    target: Path, base: Base, template: Map, log: 'Logger | Any'
) -> JournalWriter | None:
    """Open the journal of the first unsaved place; None, and an error in the log, if it fails."""
    try:
        return JournalWriter.create(target, base, template, log.error)
    except JournalError as error:
        log.error(f'recorded places are in memory only: {error}')
        return None


def _write_beside(pipeline: Pipeline, on_worker: OnWorker, path: str) -> tuple[int, str]:
    """Write the map to the path, or the first numbered name that is free or of this map."""
    for name in map(str, numbered_names(path)):
        try:
            overwrite = pipeline.save_state.own_version(name)
            return write_map(pipeline, on_worker, name, overwrite), name
        except OutputTakenError:
            continue
    raise AssertionError
