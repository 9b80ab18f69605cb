# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps made of journals: after an interrupted recording, and of what build_map has read."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
import io
from pathlib import Path
import re
import tempfile

import numpy as np
from stavpr_ros.errors import JournalError, OutputTakenError, StavprError
from stavpr_ros.mapping.growing_map import GrowingMap
from stavpr_ros.mapping.journal import Base, JournalReader, row_of, SUFFIX
from stavpr_ros.mapping.map_container import MapFile, Part
from stavpr_ros.mapping.map_file import load_map, open_map, save_map
from stavpr_ros.mapping.place_map import Map, Session
from stavpr_ros.mapping.stored_features import StoredFeatures, StoredThumbnails
from stavpr_ros.output_file import explain, FileVersion, numbered_names, write_at

DAMAGED = '.damaged'  # suffix of journals that were not read to their end


def journal_map(path: Path) -> Map:
    """
    Return the places of a journal as a map, whose features and thumbnails take no memory.

    They are in a temporary file without a name, in the same folder.

    :raises JournalError: no journal, one without places, or a damaged one.
    :raises OutputError: there is no room.
    """
    with explain(path), JournalReader(path) as reader:
        place_map = _read_places(reader, path.parent)
    if reader.problem:
        raise JournalError(f'{path} is damaged: {reader.problem}')
    return place_map


def _read_places(reader: JournalReader, folder: Path) -> Map:
    """Return the places of a journal, at least one, with a temporary file in a folder."""
    template = reader.template
    row = row_of(template.features)
    W, d = row['strips'].shape
    places, weights, records, ends = [], [], [], [0]
    for _, place, features, thumbnail in reader.places():
        places.append(place)
        weights.append(features.weights)
        start = reader.start + row.itemsize - row['strips'].itemsize
        records.append((start, reader.end - start))  # strips, ..., identifier, thumbnail
        ends.append(ends[-1] + len(thumbnail))
    if not places:
        raise JournalError(f'{reader.path} has no places: {reader.problem or "delete it"}')
    n = len(places)
    strips = Part('F32', (W, n, d))
    first = strips.size
    raw = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
    assert isinstance(raw, io.FileIO)
    for i, (start, size) in enumerate(records):
        content = reader.read(start, size)
        if len(content) < size:
            raise JournalError(f'{reader.path} is shorter than before, or its disk has an error')
        for j in range(W):
            strip = content[4 * j * d : 4 * (j + 1) * d]
            write_at(raw.fileno(), strip, 4 * (j * n + i) * d)
        write_at(raw.fileno(), content[size - (ends[i + 1] - ends[i]) :], first + ends[i])
    file = MapFile(raw, reader.path)
    file.parts = {'strips': strips, 'thumbnails': Part('U8', (ends[-1],), first)}
    unknown = np.full(7, np.nan)
    poses = np.array([unknown if place.pose is None else place.pose for place in places])
    cells = template.features.cells
    return Map(
        features=StoredFeatures(file, np.concatenate(weights, axis=1), template.settings, cells),
        projection=template.projection,
        stamps=np.array([place.stamp for place in places], np.int64),
        ids=tuple(place.identifier for place in places),
        poses=None if np.isnan(poses).all() else poses,
        camera=template.camera,
        thumbnails=StoredThumbnails(file, np.array(ends[1:])) if ends[-1] else (),
    )


@dataclass(frozen=True)
class Recovered:
    """
    A map made of a journal.

    :param path: the map's file.
    :param places: all of its places; ``recorded`` of them are from the journal.
    :param problems: sentences on missing places, and on the damaged journal that is kept.
    """

    path: str
    places: int
    recorded: int
    problems: tuple[str, ...] = ()


def journals(target: str | Path) -> list[Path]:
    """Return the journals of a map and of its numbered names, oldest first."""
    target = Path(target)
    name = re.compile(rf'{re.escape(target.stem)}(-\d+)*{re.escape(target.suffix + SUFFIX)}')
    try:
        paths = [path for path in target.parent.iterdir() if name.fullmatch(path.name)]
        return sorted(paths, key=lambda path: path.stat().st_mtime)
    except OSError:
        return []


def recover(
    journal: str | Path,
    output: str | Path | None = None,
    relate: Callable[[Map], Map] = lambda place_map: place_map,
) -> Recovered:
    """
    Make a map of the places in a journal and of the map that they continue; delete the journal.

    A journal that was not read to its end is kept, under a name with the suffix ``DAMAGED``.

    :param output: file of the map, which must not exist; None = the journal's name without its
        suffix. That may be the map that is continued, which is replaced then; beside another map,
        a numbered name is taken.
    :param relate: relates places of the last session to places of the map, see
        :func:`stavpr_ros.maintenance.same_places.with_last_related`.
    :raises JournalError: no journal, one without places, or one that is being written.
    :raises OutputError: the map cannot be written; the journal stays.
    """
    journal, problems = Path(journal), []
    target = Path(output or journal.with_name(journal.name.removesuffix(SUFFIX)))
    with explain(target), JournalReader(journal) as reader:
        place_map = _read_places(reader, target.parent)
        base, problem = _base_map(reader.base)
        if base is not None:
            sessions = reader.template.sessions
            place_map = _append(base, place_map, reader.base, sessions)
        place_map = relate(place_map)
        if output is None:
            target = _save_beside(place_map, target)
        else:
            save_map(place_map, target)
        if problem:
            problems.append(f'{target} lacks the map that the recording continued: {problem}')
        if reader.problem:
            names = numbered_names(journal.with_name(journal.name + DAMAGED))
            damaged = journal.rename(next(path for path in names if not path.exists()))
            problems.append(f'{target} may lack places: {reader.problem}; {damaged} is kept')
        else:
            journal.unlink()
    places = len(place_map)
    return Recovered(str(target), places, places - len(base or ()), tuple(problems))


def _base_map(base: Base) -> tuple[Map | None, str]:
    """Return the map that a journal continues, or None and why it is missing."""
    if not base.places:
        return None, ''
    try:
        place_map = load_map(base.path)
    except StavprError as error:
        return None, str(error)
    if Base.of(base.path, place_map.stamps[: base.places]) != base:
        return None, f'{base.path} is another map than the one that was continued'
    return place_map, ''


def _append(base: Map, recorded: Map, opened: Base, sessions: tuple[Session, ...]) -> Map:
    """Return a map with the recorded places behind it; opened: the map when they began."""
    growing, n = GrowingMap.from_map(base, 2**31), len(recorded)
    # a recording that had no sessions goes on in the last lap of what was saved of it
    if sessions := sessions or base.sessions[-1:]:
        growing.begin_session(Path(opened.path).stem, sessions[0].id)
    # a map that was saved just before the end has the first places of its journal already
    stamps = base.stamps[opened.places : opened.places + n]
    first = int(np.cumprod(stamps == recorded.stamps[: len(stamps)]).sum())
    thumbnails = recorded.thumbnails or [b''] * n
    for i in range(first, n):
        place = recorded.place(i)
        growing.add(
            recorded.features[i : i + 1], place.stamp, place.identifier, place.pose, thumbnails[i]
        )
    return growing.snapshot()


def _save_beside(place_map: Map, target: Path) -> Path:
    """Save a map under a name that is free, or that is of an earlier state of it."""
    for path in numbered_names(target):
        version = FileVersion.of(path)
        force = version if version and _begins(path, place_map) else False
        with suppress(OutputTakenError):
            save_map(place_map, path, force=force)
            return path
    raise AssertionError


def _begins(path: Path, place_map: Map) -> bool:
    """Return whether a file is a map of the first places of this one."""
    try:
        stamps = open_map(path).stamps
    except StavprError:
        return False
    return np.array_equal(stamps, place_map.stamps[: len(stamps)])
