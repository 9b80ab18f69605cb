# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_ros map``: show, check, compact, merge, update and recover maps."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, UTC
import math
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from stavpr_ros import plugins
from stavpr_ros.commands.program import add_camera, make_parser, run_program, say
from stavpr_ros.errors import (
    left_out,
    MapFileError,
    printable,
    SettingsError,
    SourceError,
    UnavailableError,
)
from stavpr_ros.output_file import MAP, PNG, require_replaceable
from stavpr_ros.units import DATED, SECOND

if TYPE_CHECKING:
    from stavpr_ros.mapping import Map

MAX_NAME = 64  # characters of the name of a camera
# Tools of other packages, and the packages that provide them.
TOOLS = {'align': 'stavpr_slam', 'colmap': 'stavpr_slam', 'plot': 'stavpr_lab'}

EPILOG = """
examples:
  map info route.stavpr --plot route.png
  map verify *.stavpr
  map compact route.stavpr small.stavpr --drop-duplicates
  map colmap route.stavpr hloc --images drive.bag
  map merge both.stavpr day.stavpr night.stavpr
  map merge both.stavpr front.stavpr rear.stavpr --cameras front:0 rear:180
  map close lap.stavpr closed.stavpr
  map sessions both.stavpr day.stavpr --keep day
  map recover route.stavpr.journal
  map upload route.stavpr qdrant://host:6333/city
  map update route.stavpr tuesday.bag
  map log route.stavpr
  map rollback route.stavpr

exit codes: 0 done, or all maps are sound; 1 not (the reason is printed); 2 usage
"""


def _parser() -> argparse.ArgumentParser:
    parser = make_parser('map', 'Show, check, compact, merge, update and recover maps.', EPILOG)
    actions = parser.add_subparsers(dest='action', required=True, metavar='ACTION')

    def add(
        name: str, work: Callable[..., int | None], text: str, *files: str, force: str = ''
    ) -> argparse.ArgumentParser:
        action = actions.add_parser(name, help=text, description=text)
        action.set_defaults(work=work)
        for file in files:
            action.add_argument(file, metavar=file.upper())
        if force:
            action.add_argument('--force', action='store_true', help=force)
        return action

    def add_storage(action: argparse.ArgumentParser, default: str, text: str) -> None:
        storages = ('float32', 'float16')
        action.add_argument('--storage', choices=storages, default=default, help=text)

    force = 'replace an existing output file'
    halves = 'type of the features; float16 halves the file (default: as in the maps)'
    action = add(
        'info', _info, 'Show the contents of a map.', 'map', force='replace an existing plot'
    )
    action.add_argument(
        '--plot',
        metavar='PNG',
        help='also draw the route with its poses, thumbnails, and the distances of places to '
        'each other',
    )
    action = add('verify', _verify, 'Check a map for damage: its hashes, and every value.')
    action.add_argument('maps', nargs='+', metavar='MAP')
    text = 'Write a smaller map, in the present format.'
    action = add('compact', _compact, text, 'map', 'output', force=force)
    text = 'type of the features; float16 is half of float32 (%(default)s)'
    add_storage(action, 'float16', text)
    action.add_argument(
        '--pca',
        type=int,
        metavar='D',
        help='reduce strips to D dimensions, by the principal components of the map',
    )
    action.add_argument(
        '--drop-duplicates',
        action='store_true',
        help='remove places where the camera had not moved since the place before; in a map '
        'without poses, also the places of a drive through the dark',
    )
    action.add_argument(
        '--drop-thumbnails',
        action='store_true',
        help='remove the images of the places, which the geometric check and viewers need',
    )
    action.add_argument(
        '--codes',
        action='store_true',
        help='add int8 codes, for the fastest start with precision int8; from 1,000 places on',
    )
    text = 'Write images, pairs and poses of a map to a folder for COLMAP and hloc.'
    action = add('colmap', _colmap, text, 'map', 'folder')
    action.add_argument(
        '--images',
        nargs='+',
        default=[],
        metavar='PATH',
        help='a folder of images or a bag for each session, in order (the thumbnails)',
    )
    action.add_argument('--topic', help="the bags' image topic, if there are several")
    add_camera(action)
    action.add_argument(
        '--closures',
        default='',
        metavar='FILE',
        help='add pairs from the loop closures that `record --loop-closures` wrote',
    )
    text = 'Join maps of one route: each becomes a session.'
    action = add('merge', _merge, text, 'output', force=force)
    action.add_argument('maps', nargs='+', metavar='MAP')
    action.add_argument(
        '--align',
        action='store_true',
        help='move the poses of each further map into the frame of the first, by the places that '
        'are recognized on it; requires the package stavpr_slam',
    )
    action.add_argument(
        '--different-routes',
        action='store_true',
        help='skip the search for places that several sessions show, which recognizes each '
        'session on the earlier ones',
    )
    action.add_argument(
        '--cameras',
        nargs='+',
        default=[],
        metavar='NAME[:DEG]',
        help='name the camera of each map, for maps that were recorded together, and its yaw in '
        'the base of the robot, to the left: front:0 left:90 rear:180; without degrees, by the '
        'intrinsics of the map',
    )
    add_storage(action, '', halves)
    _add_single(add, force)
    return parser


def _add_single(add: Callable[..., argparse.ArgumentParser], force: str) -> None:
    """Add the actions on one map, its sessions and its versions."""
    text = 'Write selected sessions of a map to another map.'
    action = add('sessions', _sessions, text, 'map', 'output', force=force)
    group = action.add_mutually_exclusive_group(required=True)
    group.add_argument('--keep', metavar='ID', help='only the places of this session')
    group.add_argument('--remove', metavar='ID', help="all places except this session's")
    text = 'Close the map of a round trip: recognition goes on from its end to its start.'
    add('close', _close, text, 'map', 'output', force=force)
    text = 'Upload a map to the store of a fleet, docs/fleet.md.'
    action = add('upload', _upload, text, 'map', force='replace the map that is there')
    action.add_argument(
        'address',
        metavar='ADDRESS',
        help='faiss:FILE, qdrant:FOLDER, or qdrant://HOST:PORT/COLLECTION',
    )
    text = 'Make a map from the journal of an interrupted recording.'
    action = add('recover', _recover, text)
    action.add_argument('journal', metavar='JOURNAL', help='such as route.stavpr.journal')
    action.add_argument(
        '--output',
        metavar='MAP',
        help="the file to write; by default the recording's, or a numbered name beside it",
    )
    text = 'Update a map by a new drive whose places are certain, docs/upkeep.md.'
    action = add('update', _update, text, 'map')
    action.add_argument(
        'drive', metavar='DRIVE', help='folder of images, bag or video, or the map of the drive'
    )
    action.add_argument('--topic', help="the bag's image topic, if there are several")
    add_camera(action)
    add('log', _log, 'Show the versions of a map, and what each update changed.', 'map')
    action = add('rollback', _rollback, 'Restore an earlier version of a map.', 'map')
    action.add_argument(
        '--to',
        metavar='ID',
        default='',
        help='identifier of the version, see log (the one before)',
    )


def _info(arguments: argparse.Namespace) -> None:
    from stavpr_ros.mapping import open_map

    place_map = open_map(arguments.map)
    print(describe(place_map, Path(arguments.map)))
    if arguments.plot:
        _tool('plot')(place_map, Path(arguments.plot))
        say(f'plot       {arguments.plot}')


def _tool(name: str) -> Callable[..., Any]:
    """Return a function that another package provides."""
    tool: Callable[..., Any] | None = plugins.one(plugins.MAP_TOOLS, name)
    if tool is None:
        raise UnavailableError(
            f'{name} needs the package {TOOLS[name]}, which is not installed: build it, or '
            '`pip install .` in the repository'
        )
    return tool


def describe(place_map: 'Map', path: Path) -> str:
    """Return the contents of an opened map, a line each."""
    import numpy as np
    from stavpr_ros.mapping.map_version2 import VERSION
    from stavpr_ros.mapping.stored_features import StoredFeatures

    features, settings, n = place_map.features, place_map.settings, len(place_map)
    risks = place_map.error_risks
    assert isinstance(features, StoredFeatures)
    count = sum(place_map.pose(place) is not None for place in range(n))
    stamps = place_map.stamps[place_map.stamps != 0]
    rows = {
        'file': f'{path}, {path.stat().st_size / 1e6:.1f} MB, format version {VERSION}',
        'id': place_map.map_id,
        'places': f'{n}, {count} with a pose, {sum(map(bool, place_map.ids))} with an identifier, '
        f'{"with" if len(place_map.thumbnails) else "without"} thumbnails',
        'features': f'{settings.kind}, version {settings.feature_version}: {settings.strips} '
        f'strips of {place_map.dimension} dimensions, {features.storage}',
        'settings': settings.to_json(),
        'max_error': 'not calibrated on this map (stavpr evaluate --calibrate)'
        if risks is None
        else f'from {risks.bounds[-1]:.3g} on, calibrated by {risks.units} blocks of images',
        'stamps': f'{_time(int(stamps.min()))} to {_time(int(stamps.max()))}'
        if len(stamps)
        else 'unknown',
    }
    if place_map.projection:
        rows['projection'] = place_map.projection.identity
    if features.statistics is not None:
        rows['statistics'] = 'stored for a fast start' + ', with int8 codes' * features.has_codes
    if count and place_map.poses is not None:
        positions = place_map.poses[~np.isnan(place_map.poses[:, 0]), :3]
        length = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
        rows['poses'] = f'a route of {length:.0f} m'
    if place_map.seam is not None:
        rows['route'] = f'closed: its last place shows place {place_map.seam}'
    lines = [f'{name:<11}{value}' for name, value in rows.items()]
    for number, session in enumerate(place_map.sessions):
        assert place_map.session_index is not None
        places = np.count_nonzero(place_map.session_index == number)
        texts = dict.fromkeys((session.id, session.name, session.robot))
        names = ', '.join(filter(None, texts))
        if session.camera:
            yaw = session.yaw
            names += f', camera {session.camera}' + (
                '' if yaw is None else f' at {math.degrees(yaw):.0f} degrees'
            )
        start = f', {_time(session.start)}' if session.start >= DATED else ''
        same = ''
        if place_map.same_as is not None and number:
            own = np.flatnonzero(place_map.session_index == number)
            shared = np.count_nonzero(place_map.same_as[own] != own)
            same = f', {shared} show places of earlier sessions'
        lines.append(f'session    {names}: {places} places{same}{start}')
    return '\n'.join(map(printable, lines))


def _time(stamp: int) -> str:
    if stamp < DATED:
        return f'{stamp / SECOND:.1f} s'
    return datetime.fromtimestamp(stamp // SECOND, UTC).strftime('%Y-%m-%d %H:%M:%S UTC')


def _verify(arguments: argparse.Namespace) -> int:
    from stavpr_ros.mapping import load_map

    bad = 0
    for path in arguments.maps:
        try:
            place_map = load_map(path)
            say(f'{path}: sound, {len(place_map)} places, id {place_map.map_id}')
        except MapFileError as error:
            bad += 1
            say(f'map: {error}', sys.stderr)
    return 1 if bad else 0


def _open_verified(path: str) -> 'Map':
    """Open a map, and compare all of it with its hashes."""
    from stavpr_ros.mapping import open_map, verify_map

    place_map = open_map(path)
    verify_map(place_map)
    return place_map


def _compact(arguments: argparse.Namespace) -> None:
    from dataclasses import replace

    from stavpr_ros.maintenance.near_duplicates import without_duplicates
    from stavpr_ros.mapping.reduction import with_principal_components
    from stavpr_ros.mapping.stored_features import StoredFeatures

    place_map = _open_verified(arguments.map)
    assert isinstance(place_map.features, StoredFeatures)
    storage, n = place_map.features.storage, len(place_map)
    if arguments.drop_duplicates:
        place_map = without_duplicates(place_map)
        say(f'{n - len(place_map)} of {n} places dropped: they show what the one before shows')
    if arguments.pca is not None:
        say(f'strips of {place_map.dimension} dimensions become {arguments.pca}')
        place_map = with_principal_components(place_map, arguments.pca)
    if arguments.drop_thumbnails:
        size = sum(map(len, place_map.thumbnails)) / 1e6
        place_map = replace(place_map, thumbnails=())
        say(f'thumbnails of {size:.1f} MB dropped')
    if arguments.storage != storage:
        say(f'features: {storage} becomes {arguments.storage}')
    _write(place_map, arguments)


def _merge(arguments: argparse.Namespace) -> None:
    from stavpr_ros.maintenance.same_places import with_same_places
    from stavpr_ros.mapping import merge_maps
    from stavpr_ros.sources.folder import text_of

    maps = [_open_verified(path) for path in arguments.maps]
    if arguments.align:
        align = _tool('align')
        maps[1:] = [align(place_map, maps[0]) for place_map in maps[1:]]
    cameras = [_camera(text) for text in arguments.cameras]
    merged = merge_maps(maps, [text_of(Path(path).stem) for path in arguments.maps], cameras)
    if not arguments.different_routes:
        merged = with_same_places(merged)
    _write(merged, arguments)


def _camera(text: str) -> tuple[str, float | None]:
    """Return name and yaw (radians) of a camera, given as NAME or NAME:DEGREES."""
    name, colon, degrees = text.partition(':')
    try:
        yaw = math.radians(float(degrees)) if colon else None
        if not 0 < len(name) <= MAX_NAME or (yaw is not None and not math.isfinite(yaw)):
            raise ValueError
    except ValueError:
        raise SettingsError(f'--cameras {text!r}: expected NAME or NAME:DEGREES') from None
    return name, yaw if yaw is None else math.remainder(yaw, 2 * math.pi)


def _sessions(arguments: argparse.Namespace) -> None:
    from stavpr_ros.mapping import select_session

    place_map, keep = _open_verified(arguments.map), arguments.keep is not None
    _write(select_session(place_map, arguments.keep or arguments.remove, keep), arguments)


def _close(arguments: argparse.Namespace) -> None:
    from stavpr_ros.maintenance.same_places import with_seam

    place_map = with_seam(_open_verified(arguments.map), is_closed=True)
    say(f'the last place shows place {place_map.seam}')
    _write(place_map, arguments)


def _write(place_map: 'Map', arguments: argparse.Namespace) -> None:
    from stavpr_ros.mapping import save_map
    from stavpr_ros.prepare.prepared_map import statistics_of_map, with_codes

    storage = getattr(arguments, 'storage', '')
    statistics = statistics_of_map(place_map, storage)
    if statistics is not None and getattr(arguments, 'codes', False):
        statistics = with_codes(statistics, place_map, storage)
    map_id = save_map(place_map, arguments.output, storage, arguments.force, statistics)
    size = Path(arguments.output).stat().st_size / 1e6
    say(f'{arguments.output}: {len(place_map)} places, {size:.1f} MB, id {map_id}')


def _colmap(arguments: argparse.Namespace) -> None:
    from stavpr_ros.mapping import load_map

    export, place_map = _tool('colmap'), load_map(arguments.map)
    options = arguments.images, arguments.topic, arguments.closures, arguments.camera
    say(export(place_map, arguments.folder, *options))


def _recover(arguments: argparse.Namespace) -> int:
    from stavpr_ros.maintenance.same_places import with_last_related
    from stavpr_ros.mapping.journal import SUFFIX
    from stavpr_ros.mapping.journal_map import recover

    journal = arguments.journal
    if arguments.output is None and not journal.endswith(SUFFIX):
        raise SourceError(f'{journal} does not end with {SUFFIX}: name the map, --output')
    recovery = recover(journal, arguments.output, with_last_related)
    say(f'{recovery.path}: {recovery.places} places, {recovery.recorded} of them from {journal}')
    for problem in recovery.problems:
        say(problem)
    return int(bool(recovery.problems))


def _update(arguments: argparse.Namespace) -> None:
    from stavpr_ros.maintenance.upkeep import update_file
    from stavpr_ros.mapping import open_map
    from stavpr_ros.output_file import FileVersion
    from stavpr_ros.sources.folder import text_of

    opened, place_map = FileVersion.of(arguments.map), _open_verified(arguments.map)
    name = text_of(Path(arguments.drive).stem)[:40]
    with _drive(arguments, place_map) as drive:
        version = update_file(arguments.map, opened, place_map, drive, name)
    for change in version.changes:
        say(change)
    places = len(open_map(arguments.map))
    say(f'{arguments.map}: {places} places, id {version.map_id}, was {place_map.map_id}')


@contextmanager
def _drive(arguments: argparse.Namespace, place_map: 'Map') -> 'Iterator[Map]':
    """Yield the images of a drive, with the features of a map; a journal keeps them meanwhile."""
    from stavpr_ros.mapping import is_map, load_map
    from stavpr_ros.mapping.builder import build_journal
    from stavpr_ros.mapping.journal_map import journal_map
    from stavpr_ros.mapping.versions import history_of
    from stavpr_ros.sources import open_source

    if is_map(arguments.drive):
        yield load_map(arguments.drive)
        return
    folder, extractor = history_of(arguments.map), place_map.extractor()
    folder.mkdir(exist_ok=True)
    source = f'{Path(arguments.drive).resolve()} {arguments.topic or arguments.camera or ""}'
    images = open_source(arguments.drive, arguments.topic, camera=arguments.camera)
    journal = build_journal(
        images, extractor, folder / 'drive', source, thumbnails=bool(len(place_map.thumbnails))
    )
    if unread := left_out(getattr(images, 'left_out', {})):
        say(unread, sys.stderr)
    try:
        yield journal_map(journal)
    finally:
        journal.unlink()


def _log(arguments: argparse.Namespace) -> None:
    from stavpr_ros.mapping.versions import versions

    for version in versions(arguments.map):
        when = _time(version.time * SECOND) if version.time else 'before the first update'
        drive = f', {version.drive}' if version.drive else ''
        lines = [f'{version.map_id}  {when}{drive}', *(f'    {text}' for text in version.changes)]
        print('\n'.join(map(printable, lines)))


def _rollback(arguments: argparse.Namespace) -> None:
    from stavpr_ros.mapping.versions import roll_back

    version = roll_back(arguments.map, arguments.to)
    say(f'{arguments.map} is version {version.map_id} again')


def _upload(arguments: argparse.Namespace) -> None:
    from stavpr_ros.mapping.stores import store_of

    store = store_of(arguments.address)
    place_map = _open_verified(arguments.map)
    store.upload(place_map, arguments.address, arguments.force)
    say(f'{arguments.address}: {len(place_map)} places')


def _check_output(arguments: argparse.Namespace) -> None:
    """Reject an output that must not be replaced, or that is one of the inputs."""
    if arguments.action == 'info' and arguments.plot:
        require_replaceable(arguments.plot, PNG, arguments.force)
    if 'output' not in arguments or arguments.action == 'recover':
        return
    require_replaceable(arguments.output, MAP, arguments.force)
    output = Path(arguments.output)
    inputs = [arguments.map] if 'map' in arguments else arguments.maps
    if output.exists() and any(Path(path).exists() and output.samefile(path) for path in inputs):
        raise SettingsError(f'{output} is also an input: give another name')


def main(args: list[str] | None = None) -> int:
    """Run the command."""

    def work() -> int | None:
        arguments = _parser().parse_args(args)
        _check_output(arguments)
        return arguments.work(arguments)

    return run_program('map', work)
