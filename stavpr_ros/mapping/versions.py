# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Versions of a map that is updated by drives: its history, and the return to one.

``route.stavpr.history`` has each version as ``ID.stavpr``, and in ``ID.json`` how it came about.
Both are complete before the version replaces the map, which is one step: whatever ends the
program, the map is the version before or the new one.
"""

from contextlib import suppress
from dataclasses import asdict, dataclass, replace
import json
from pathlib import Path
import shutil
import time
from typing import Any

from stavpr_ros.errors import InputError, MapFileError, OutputError
from stavpr_ros.mapping.map_container import read_json
from stavpr_ros.mapping.map_file import load_map, open_map, save_map
from stavpr_ros.mapping.map_schema import integer, list_of, record, text
from stavpr_ros.mapping.place_map import Map
from stavpr_ros.mapping.stored_features import MapStatistics, StoredFeatures
from stavpr_ros.output_file import atomic_output, FileVersion, Force, JSON, MAP, write_output

SUFFIX = '.history'
MAX_VERSIONS = 10  # older ones, and a branch that a return has left, are deleted


@dataclass(frozen=True)
class Version:
    """
    A version of a map.

    :param map_id: id of its file.
    :param parent: id of the version before it, '' = none.
    :param number: number of updates up to it.
    :param drive: name of the drive of the last update.
    :param time: when it was made, seconds since 1970.
    :param base_places: number of places before the first update.
    :param changes: what the update added and removed, and why: sentences.
    :param drives: the last ones, see :data:`stavpr_ros.maintenance.same_drive.Row`.
    """

    map_id: str
    parent: str = ''
    number: int = 0
    drive: str = ''
    time: int = 0
    base_places: int = 0
    changes: tuple[str, ...] = ()
    drives: tuple[tuple[str, int, str], ...] = ()


def _drive(value: Any, where: str) -> None:
    if not (isinstance(value, list) and [type(item) for item in value] == [str, int, str]):
        raise ValueError(f'{where} is {value!r:.80}: expected name, stamp and bits of a drive')
    bytes.fromhex(value[2])


_check = record(
    {
        **dict.fromkeys(('map_id', 'parent'), text(16)),
        **dict.fromkeys(('number', 'time', 'base_places'), integer(0, 2**40)),
        'drive': text(4096),
        'changes': list_of(text(4096), 0, 4096),
        'drives': list_of(_drive, 0, MAX_VERSIONS),
    }
)


def history_of(path: str | Path) -> Path:
    """Return the folder with the versions of a map."""
    return Path(f'{path}{SUFFIX}')


def current_version(path: str | Path) -> Version:
    """
    Return the version that a map is now; without a record, the first one.

    :raises MapFileError: no map, or a damaged record.
    """
    place_map = open_map(path)
    version = _read(history_of(path), place_map.map_id)
    return version or Version(place_map.map_id, base_places=len(place_map))


def versions(path: str | Path) -> list[Version]:
    """
    Return the versions of a map, the present one first.

    :raises MapFileError: as :func:`current_version`.
    """
    chain = [current_version(path)]
    while (parent := chain[-1].parent) and parent not in {version.map_id for version in chain}:
        chain.append(_read(history_of(path), parent) or Version(parent))
    return chain


def save_version(
    path: str | Path,
    opened: FileVersion | None,
    place_map: Map,
    before: Version,
    version: Version,
    statistics: MapStatistics | None,
) -> Version:
    """
    Replace a map by its next version.

    :param opened: the file when it was read; another one is not replaced.
    :param before: the present version; version: the next one, whose id and parent are filled in.
    :raises OutputError: it cannot be written, or the file has changed; the map stays as it is.
    """
    folder = history_of(path)
    try:
        folder.mkdir(exist_ok=True)
        map_id = _write_version(path, place_map, before, statistics)
    except OSError as error:
        raise OutputError(f'{folder} cannot be written ({error}): {path} is untouched') from error
    version = replace(
        version,
        map_id=map_id,
        parent=before.map_id,
        number=before.number + 1,
        base_places=before.base_places,
        time=int(time.time()),
    )
    content = json.dumps(asdict(version), allow_nan=False)
    write_output(folder / f'{map_id}.json', content, JSON, True)
    _copy(folder / f'{map_id}.stavpr', Path(path), opened or False)
    _clean(folder, [version.map_id for version in versions(path)])
    return version


def _clean(folder: Path, chain: list[str]) -> None:
    """Delete old versions, and all of a branch that was left by a return to an earlier one."""
    for suffix, ids in (('.stavpr', chain[:MAX_VERSIONS]), ('.json', chain)):
        for file in folder.glob(f'{"[0-9a-f]" * 16}{suffix}'):
            if file.stem not in ids:
                file.unlink(missing_ok=True)


def roll_back(path: str | Path, map_id: str = '') -> Version:
    """
    Make an earlier version the map again.

    :param map_id: id of the version; '' = the previous one.
    :raises InputError: there is no such version.
    :raises StavprError: its file is damaged, or the map cannot be written.
    """
    opened, chain = FileVersion.of(path), versions(path)
    target = map_id or chain[0].parent
    file = history_of(path) / f'{target}.stavpr'
    earlier = [version.map_id for version in chain[1:] if _file(path, version).exists()]
    if target not in earlier:
        raise InputError(f'{target or "an earlier one"} is no version of {path}: it has {earlier}')
    if load_map(file).map_id != target:
        raise MapFileError(f'{file} is another map than its name states')
    _copy(file, Path(path), opened or False)
    return current_version(path)


def _write_version(
    path: str | Path, place_map: Map, before: Version, statistics: MapStatistics | None
) -> str:
    """Write a version, beside the present one, into the history; return its id."""
    folder, old = history_of(path), _file(path, before)
    is_sound = False
    with suppress(MapFileError):
        is_sound = load_map(old).map_id == before.map_id
    if not is_sound:
        old.unlink(missing_ok=True)
        _copy(Path(path), old, False)
    features = open_map(path).features
    storage = features.storage if isinstance(features, StoredFeatures) else ''
    new = folder / 'new.stavpr'
    map_id = save_map(place_map, new, storage, force=True, statistics=statistics)
    new.replace(folder / f'{map_id}.stavpr')
    return map_id


def _file(path: str | Path, version: Version) -> Path:
    return history_of(path) / f'{version.map_id}.stavpr'


def _copy(source: Path, target: Path, force: Force) -> None:
    with source.open('rb') as file, atomic_output(target, MAP, force) as output:
        shutil.copyfileobj(file, output)


def _read(folder: Path, map_id: str) -> Version | None:
    """Return the record of a version; None = there is none."""
    file = folder / f'{map_id}.json'
    try:
        data = read_json(file.read_bytes(), file.name)
        if isinstance(data, dict):
            data.setdefault('drives', [])  # records without it are older
            for name in ('use', 'missed'):  # and these had numbers of each place
                data.pop(name, None)
        _check(data, file.name)
        if data['map_id'] != map_id:
            raise ValueError('it is of another version')
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise MapFileError(f'{file} is damaged ({error}): move it elsewhere') from error
    drives = tuple(map(tuple, data['drives']))
    return Version(**data | {'changes': tuple(data['changes']), 'drives': drives})
