# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The upkeep of a map of a route that is driven for years; docs/upkeep.md describes it.

A drive that is certain where it is, on half of the route or more, becomes a session of the map,
whole: another light is recognized from its first image on. The map as it was before its first
update stays, beside the latest ``DRIVES`` drives. Any other drive changes nothing.

The root of a place is the place of an earlier session that shows the same, or itself.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.maintenance.same_drive import earlier_drive, rows_of
from stavpr_ros.maintenance.same_places import fill_gaps, recognize_places, SamePlaces
from stavpr_ros.mapping import Map, merge_maps, select_places
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.mapping.versions import current_version, MAX_VERSIONS, save_version, Version
from stavpr_ros.method.error_rate import least_probability
from stavpr_ros.method.localizer import PlaceRecognizer
from stavpr_ros.method.model import MODEL
from stavpr_ros.method.settings import RecognizerSettings
from stavpr_ros.method.verification import GeometricSettings, PlaceVerifier
from stavpr_ros.output_file import FileVersion
from stavpr_ros.prepare.prepared_map import statistics_of_map

DRIVES = 3  # latest ones, which are kept beside the map before its first update
MAX_ERROR = 0.005  # rate of wrong matches that a certain image keeps
MIN_IMAGES, MIN_CERTAIN = 40, 0.3  # certain images, and their share of those in motion
MIN_SHARE = 0.5  # part of a session's places that a drive passes
MAX_LAPS = 2  # images of a drive in motion that are kept, times the places before the first update
MAX_SPEED = max(MODEL.speeds)  # places an image, of a drive on the map
SLACK = 4  # places by which two certain images may disagree
LAP = 40  # places of a closed route at least
PROBES, FAR = 24, 25  # images of the geometric check; places to where another one is


def update_map(place_map: Map, drive: Map, name: str, version: Version) -> tuple[Map, Version]:
    """
    Return a map after a drive, and its version, without id and parent.

    :param drive: all its images, as a map with the features of this one.
    :param name: name of the drive, for its session.
    :param version: present version of the map.
    :raises InputError: the drive is not certain where it is, or passes too little of the route; it
        changes nothing.
    """
    base = min(version.base_places or len(place_map), len(place_map))
    on_map = _recognize(place_map, drive)
    _require_certain(drive, on_map)
    _require_fitting_thumbnails(place_map, drive, on_map)
    if (share := _share(on_map)) < MIN_SHARE:
        raise InputError(
            f'the drive passes {share:.0%} of a session of the map: expected {MIN_SHARE:.0%}; '
            'the map stays as it is'
        )
    images = _most_certain(on_map, MAX_LAPS * base)
    # by the places before the first update: errors would add up from drive to drive
    places = recognize_places(select_places(place_map, np.arange(base)), drive, images)
    places = np.where(places >= 0, places, on_map.of_windows[images])
    places = fill_gaps(places, on_map.sessions)
    updated = _with_drive(place_map, drive, name, images, places)
    assert updated.session_index is not None
    begins = np.searchsorted(updated.session_index, np.arange(len(updated.sessions)))
    old_sessions = np.flatnonzero(begins >= base)[:-DRIVES]
    others = np.flatnonzero(~np.isin(updated.session_index, old_sessions))
    certain = (on_map.of_windows >= 0).mean()
    changes = [f'certain of {certain:.0%} of {len(drive)} images']
    changes.append(f'added the drive, {len(images)} images')
    if count := len(updated) - len(others):
        names = ', '.join(updated.sessions[number].id for number in old_sessions)
        changes.append(f'removed the {count} places of {names}: {DRIVES} drives are kept')
        updated = select_places(updated, others)
    return updated, replace(version, drive=name, changes=tuple(changes))


def update_file(
    path: str | Path, opened: FileVersion | None, place_map: Map, drive: Map, name: str
) -> Version:
    """
    Let a drive update the map of a file, and return its new version.

    A drive that the map or its last versions have learned from changes nothing; ``changes`` of the
    present version, which is returned, then names it.

    :param opened: the file when it was read; place_map: its content.
    :raises InputError: as by :func:`update_map`, or the drive has other features.
    :raises OutputError: the version cannot be written; the map stays as it is.
    """
    drive.features.require_same_settings(place_map.settings, 'the map')
    before = current_version(path)
    row = (name, *rows_of(drive, name)[0][1:])
    if earlier := earlier_drive(row, [*before.drives, *rows_of(place_map, 'the map')]):
        text = f'{name} has the same images as {earlier}: the map stays as it is'
        return replace(before, changes=(text,))
    updated, version = update_map(place_map, drive, name, before)
    version = replace(version, drives=(*before.drives[1 - MAX_VERSIONS :], row))
    return save_version(path, opened, updated, before, version, statistics_of_map(updated))


@dataclass(frozen=True)
class _OnMap:
    """
    A drive on the map.

    :param places: places of its images, certain in the middle of a window, (N,); -1 = none.
    :param of_windows: places of its images, certain in any part of a window, (N,); -1 = none.
    :param moves: whether the camera has moved since the image before, (N,).
    :param roots: root of each place of the map, (n,); sessions: number of its session, (n,).
    """

    places: np.ndarray
    of_windows: np.ndarray
    moves: np.ndarray
    roots: np.ndarray
    sessions: np.ndarray

    @property
    def certain(self) -> np.ndarray:
        """Return the images that are certain where they are, ascending."""
        return np.flatnonzero(self.places >= 0)

    def ahead(self, p: int, q: int) -> int:
        """Return how far place q is ahead of p, on a closed route over its seam."""
        return (q - p + SLACK) % self.lap - SLACK if self.lap else q - p

    @cached_property
    def lap(self) -> int:
        """Return the number of places of a closed route's lap, 0 of another route."""
        back = np.arange(len(self.roots)) - self.roots
        is_again = (self.sessions[self.roots] == self.sessions) & (back > LAP)
        return int(np.median(back[is_again])) if is_again.any() else 0


def _recognize(place_map: Map, drive: Map) -> _OnMap:
    settings, n = RecognizerSettings(min_probability=least_probability(MAX_ERROR)), len(drive)
    recognizer, certain, moves = PlaceRecognizer(place_map, settings), SamePlaces(n), []
    for i in range(n):
        match = recognizer.update(drive.features[i : i + 1], int(drive.stamps[i]))
        certain.add(match, i, settings.sequence.length)
        moves.append(not recognizer.is_standstill)
    numbers, index = np.arange(len(place_map)), place_map.session_index
    roots = numbers if place_map.same_as is None else place_map.same_as.astype(np.int64)
    sessions = np.zeros_like(numbers) if index is None else index
    return _OnMap(certain.middles, certain.places, np.array(moves), roots, sessions)


def _require_certain(drive: Map, on_map: _OnMap) -> None:
    """Reject a drive of which too few images are certain, or later ones disagree."""
    certain, roots, sessions = on_map.certain, on_map.roots, on_map.sessions
    if len(certain) < max(MIN_IMAGES, MIN_CERTAIN * on_map.moves.sum()):
        raise InputError(
            f'{len(certain)} of {len(drive)} images are certain where they are: expected '
            f'{MIN_IMAGES}, and {MIN_CERTAIN:.0%} of those in motion; the map stays as it is'
        )
    for a, b in pairwise(certain.tolist()):
        p, q = (int(roots[on_map.places[image]]) for image in (a, b))
        is_possible = -SLACK <= on_map.ahead(p, q) <= MAX_SPEED * (b - a) + SLACK
        if sessions[p] == sessions[q] and not is_possible:
            raise InputError(
                f'images {a} and {b} are certain of places {p} and {q}, which they cannot both '
                'be right about; the map stays as it is'
            )


def _require_fitting_thumbnails(place_map: Map, drive: Map, on_map: _OnMap) -> None:
    """Reject a drive whose thumbnails fit other places better, or mirrored ones."""
    if not (len(place_map.thumbnails) and len(drive.thumbnails)):
        return
    verifier, signs, certain = PlaceVerifier(GeometricSettings('orb')), [], on_map.certain
    for image in certain[np.linspace(0, len(certain) - 1, PROBES).astype(int)].tolist():
        query, place = drive.thumbnail(image), int(on_map.places[image])
        if query is None:
            continue
        other = (place + max(FAR, len(place_map) // 2)) % len(place_map)
        flipped = np.ascontiguousarray(np.fliplr(query))
        pairs = (query, place), (query, other), (flipped, place)
        right, *wrong = (verifier.inliers(view, place_map, i) or 0 for view, i in pairs)
        signs.append(np.sign(right - np.array(wrong)))
    if (np.sum(signs, axis=0) < -2 * np.abs(signs).sum(axis=0) ** 0.5).any():
        raise InputError(
            'the thumbnails of the certain images fit other places, or mirrored, better; the map '
            'stays as it is'
        )


def _share(on_map: _OnMap) -> float:
    """Return the share of the places of a session that a drive passes, of the one it is most."""
    places, roots, sessions, lap = on_map.of_windows, on_map.roots, on_map.sessions, on_map.lap
    is_passed = np.zeros(len(roots), bool)
    for a, b in pairwise(np.flatnonzero(places >= 0).tolist()):
        p, q = int(roots[places[a]]), int(roots[places[b]])
        steps = on_map.ahead(p, q)
        if sessions[p] == sessions[q] and 0 <= steps <= MAX_SPEED * (b - a) + SLACK:
            between = p + np.arange(steps + 1)
            is_passed[between % lap if p < lap else between] = True
    counts = np.bincount(sessions[is_passed], minlength=1)
    number = int(counts.argmax())
    return float(counts[number] / (sessions == number).sum())


def _most_certain(on_map: _OnMap, limit: int) -> np.ndarray:
    """Return the last run of images in motion, of so many at most, with most certain ones."""
    images = np.flatnonzero(on_map.moves)
    limit = min(limit, len(images))
    count = np.cumsum(np.append(0, on_map.of_windows[images] >= 0))
    inside = (count[limit:] - count[: len(count) - limit])[::-1]
    first = len(inside) - 1 - int(inside.argmax())
    return images[first : first + limit]


def _with_drive(
    place_map: Map, drive: Map, name: str, images: np.ndarray, places: np.ndarray
) -> Map:
    """
    Return the map with images of a drive as a session.

    :param images: numbers in the drive, (m,).
    :param places: places of the map that they show, (m,), whose identifiers and poses they get;
        -1 = none.
    """
    n, is_hit = len(place_map), places >= 0
    # identifiers that stay when places come and go: their numbers where there is none
    ids = tuple(identifier or str(i) for i, identifier in enumerate(place_map.ids))
    identifiers = tuple(
        ids[place] if place >= 0 else f'{name}/{drive.ids[image] or image}'
        for image, place in zip(images.tolist(), places.tolist(), strict=True)
    )
    session = replace(
        select_places(drive, images),
        ids=identifiers,
        poses=_poses(place_map, drive, images, places),
        sessions=(),
        session_index=None,
        camera=drive.camera or place_map.camera,
    )
    if not place_map.thumbnails:
        session = replace(session, thumbnails=())
    both = merge_maps([replace(place_map, ids=ids), session], ['first', name])
    roots = np.arange(n) if place_map.same_as is None else place_map.same_as
    alone = n + np.arange(len(images))
    same_as = np.concatenate([roots, np.where(is_hit, roots[places], alone)])
    return replace(both, threshold=place_map.threshold, same_as=same_as.astype(np.int32))


def _poses(
    place_map: Map, drive: Map, images: np.ndarray, places: np.ndarray
) -> np.ndarray | None:
    """Return the poses of images in the frame of the map: of their places, else by odometry."""
    if place_map.poses is None:
        return None
    poses = np.where(places[:, None] >= 0, place_map.poses[places], np.nan)
    with_pose = np.flatnonzero(np.isfinite(poses).all(axis=1))
    if drive.poses is None or not len(with_pose):
        return poses
    odometry = drive.poses[images]
    for i in np.flatnonzero((places < 0) & np.isfinite(odometry).all(axis=1)).tolist():
        # the last one that it passed
        at = with_pose[max(int(np.searchsorted(with_pose, i)) - 1, 0)]
        if np.isfinite(odometry[at]).all():
            moved = inverse(matrices(odometry[at])) @ matrices(odometry[i])
            poses[i] = to_poses(matrices(poses[at]) @ moved)
    return poses
