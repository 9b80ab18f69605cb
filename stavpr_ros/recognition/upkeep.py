# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a drive teaches a map: the upkeep of a map of a route that is driven for years.

An update has four steps; docs/upkeep.md describes them.

1. The drive is recognized on the map. It teaches nothing unless it is certain where it is.
2. Between two certain images, images that are not recognized are a stretch to be learned: an
   experience of places that look otherwise today, or a detour.
3. A stretch that is not recognized by ``max_age`` drives in a row, where the places beside it
   were, gets the images of a drive that is certain of it by other sessions.
4. Above ``max_places``, the places that helped least to recognize are removed.

Where the budget has room for two sessions of the route or more, a drive over half of it or more
is kept whole, beside the first one, and the oldest ones go. Every stretch is a session of the
map, so that no path leads from one into the other.
The root of a place is the place of an earlier session that shows the same, or itself.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
import re
from typing import Any

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.filter.model import MODEL
from stavpr_ros.mapping import merge_maps, PlaceMap, select_places, Session
from stavpr_ros.mapping.merging import keep_places
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.mapping.versions import current_version, KEPT, save_version, Version
from stavpr_ros.output_file import FileVersion
from stavpr_ros.prepare.prepared_map import statistics_of_map
from stavpr_ros.recognition.error_rate import least_probability
from stavpr_ros.recognition.recognizer import PlaceRecognizer
from stavpr_ros.recognition.same_drive import earlier_drive, rows_of
from stavpr_ros.recognition.same_places import recognized, SamePlaces
from stavpr_ros.recognition.settings import RecognizerSettings
from stavpr_ros.recognition.verification import GeometricSettings, PlaceVerifier

MAX_ERROR = 0.01  # rate of wrong matches that a certain image keeps
MIN_CERTAIN = 0.3  # share of the images of a drive
FASTEST = max(MODEL.speeds)  # places an image, of a drive on the map
SLACK = 4  # places by which two certain images may disagree
MIN_HARD = 20  # images without a match, between two certain ones
MARGIN = 10  # certain images beside a stretch that are part of it
MIN_SESSION = 40  # places: fewer say little about the distances of others
NEAR = 40  # places beside a missed one: their session fits the light of the drive; 20 finds none
WIDER = 30  # places on both sides of a vanished stretch that are renewed with it; 20, 40 alike
MIN_MISSED = 10  # places in a row that are renewed as one stretch
PIECE = 20  # places that are removed together
DECAY = 0.9  # of the use, a drive
PROBES, FAR = 24, 25  # images of the geometric check; places to where another one is
SESSIONS = {'float32': 1.5, 'int8': 6.0}  # in the memory of one and a half in float32
SAME_ROAD = 0.05  # rank of the straight path among shifted ones, of the same road


@dataclass(frozen=True)
class UpkeepSettings:
    """
    Settings of the upkeep.

    :param max_places: of the map; 0 = the memory of one and a half sessions in float32: half more
        than before the first update, in int8 six times as many.
    :param max_age: drives in a row that pass a stretch unrecognized until it is renewed.
    :param precision: in which the map is loaded, ``float32`` or ``int8``.
    """

    max_places: int = 0
    max_age: int = 5
    precision: str = 'float32'


@dataclass(frozen=True)
class _Stretch:
    """
    Images of a drive to be learned.

    :param images: numbers in the drive, ascending, (m,).
    :param places: of the map that they show, (m,); -1 = none.
    :param is_detour: it may show places that the map does not have.
    """

    images: np.ndarray
    places: np.ndarray
    is_detour: bool


def update_map(
    place_map: PlaceMap, drive: PlaceMap, name: str, version: Version, settings: UpkeepSettings
) -> tuple[PlaceMap, Version]:
    """
    Return a map after a drive, and its version, without id and parent.

    A map that neither learns nor loses places is returned as it is.

    :param drive: all its images, as a map with the features of this one.
    :param name: of the drive, for the sessions.
    :param version: of the map.
    :raises InputError: the drive is not certain where it is; it teaches nothing.
    """
    before, n = place_map, len(place_map)
    # identifiers that stay when places come and go: their numbers where there is none
    ids = tuple(each or str(i) for i, each in enumerate(place_map.ids))
    place_map = replace(place_map, ids=ids)
    roots = np.arange(n) if place_map.same_as is None else place_map.same_as.astype(np.int64)
    driven = _drive(place_map, drive)
    _require_certain(place_map, drive, driven, roots)
    base, changes = version.base_places or n, []
    limit = settings.max_places or round(SESSIONS[settings.precision] * base)
    is_long = np.ptp(roots[driven.of_windows[driven.of_windows >= 0]]) >= base / 2
    keeps_drives = limit >= 2 * base
    if is_long and keeps_drives and len(drive) <= 2 * base:
        images = np.flatnonzero(driven.moves)
        stretches = [_Stretch(images, _on_first_drive(place_map, drive, images), True)]
        changes.append(f'added the drive, {len(images)} images')
    else:
        stretches = _stretches(place_map, drive, driven, roots)
        for stretch in stretches:
            kind = 'a detour' if stretch.is_detour else 'an experience'
            first, last = (ids[stretch.places[i]] for i in (0, -1))
            text = f'added {kind} of {len(stretch.images)} images, from place {first} to {last}'
            changes.append(text)
    use, missed = _used(place_map, driven, roots, version, stretches)
    images = _renewing(place_map, driven, roots, missed >= settings.max_age)
    if renewed := int((images >= 0).sum()):
        place_map, missed = _with_images(place_map, drive, images), np.where(images < 0, missed, 0)
        changes.append(f'renewed {renewed} places where {settings.max_age} drives matched nothing')
    grown = _with_stretches(place_map, drive, name, stretches)
    use = np.concatenate([use, np.ones(len(grown) - n)])
    missed = np.concatenate([missed, np.zeros(len(grown) - n, np.int64)])
    value = _newness(grown) if keeps_drives else use
    kept = np.flatnonzero(_within(grown, value, limit))
    if removed := len(grown) - len(kept):
        which = 'of the oldest drives' if keeps_drives else 'that helped least'
        changes.append(f'removed {removed} places {which}, above {limit} places')
    certain = (driven.of_windows >= 0).mean()
    after = keep_places(grown, kept) if changes else before
    changes.insert(0, f'certain of {certain:.0%} of {len(drive)} images')
    if after is before:
        changes.append('nothing is added, the map stays as it is')
    return after, replace(
        version,
        drive=name,
        changes=tuple(changes),
        use=tuple(np.round(use[kept], 3).tolist()),
        missed=tuple(missed[kept].tolist()),
    )


def update_file(
    path: str | Path,
    opened: FileVersion | None,
    place_map: PlaceMap,
    drive: PlaceMap,
    settings: UpkeepSettings,
    name: str,
) -> Version:
    """
    Let a drive update the map of a file, and return its new version.

    :param opened: the file when it was read; place_map: its content.
    A drive that the map or its last versions have learned from changes nothing; ``changes`` of the
    present version, which is returned, then names it.

    :raises InputError: the drive is not certain where it is, or has other features.
    :raises OutputError: the version cannot be written; the map stays as it is.
    """
    drive.features.require_same_settings(place_map.settings, 'the map')
    before = current_version(path)
    row = (name, *rows_of(drive, name)[0][1:])
    if one := earlier_drive(row, [*before.drives, *rows_of(place_map, 'the map')]):
        text = f'{name} has the images of {one}, taken already: the map stays as it is'
        return replace(before, changes=(text,))
    updated, version = update_map(place_map, drive, name, before, settings)
    version = replace(version, drives=(*before.drives[1 - KEPT :], row))
    return save_version(path, opened, updated, before, version, statistics_of_map(updated))


@dataclass(frozen=True)
class _Driven:
    """
    A drive on the map.

    :param places: that its images, in the middle of a window, are certain of, (N,); -1 = none.
    :param of_windows: that images are certain of in any part of a window, (N,); -1 = none.
    :param is_matched: whether the middle ones are matched, certain or not, (N,).
    :param driven: number of images in motion up to each, (N,).
    """

    places: np.ndarray
    of_windows: np.ndarray
    is_matched: np.ndarray
    driven: np.ndarray
    recognizer: PlaceRecognizer

    @cached_property
    def certain(self) -> np.ndarray:
        """Return the images that are certain where they are, ascending."""
        return np.flatnonzero(self.places >= 0)

    @cached_property
    def moves(self) -> np.ndarray:
        """Return whether the camera has moved since the image before, (N,)."""
        return np.diff(self.driven, prepend=0) > 0


def _drive(place_map: PlaceMap, drive: PlaceMap) -> _Driven:
    """Recognize a drive on the map."""
    settings, n = RecognizerSettings(), len(drive)
    recognizer, least = PlaceRecognizer(place_map, settings), least_probability(MAX_ERROR)
    matched, certain, moves = SamePlaces(n), SamePlaces(n), np.ones(n, bool)
    for i in range(n):
        match = recognizer.update(drive.features[i : i + 1], int(drive.stamps[i]))
        matched.add(match, i, settings.sequence.length)
        if match.probability > least:
            certain.add(match, i, settings.sequence.length)
        moves[i] = not recognizer.is_standstill
    is_matched, driven = matched.middles >= 0, np.cumsum(moves)
    return _Driven(certain.middles, certain.places, is_matched, driven, recognizer)


def _on_first_drive(place_map: PlaceMap, drive: PlaceMap, images: np.ndarray) -> np.ndarray:
    """
    Return the place of the map that each image of a drive shows, (m,); -1 = none.

    It is one of the first drive where that is recognized: errors would add up over the drives.
    """
    own = np.flatnonzero(_drives(place_map) == 0)
    first = recognized(select_places(place_map, own), drive, images)
    return np.where(first >= 0, own[first], recognized(place_map, drive, images))


def _newness(place_map: PlaceMap) -> np.ndarray:
    """Return a number of each place, (n,), the lower the older, of the first drive the highest."""
    drives, runs = _drives(place_map), _runs(place_map)
    return np.where(drives == 0, len(place_map), runs)


def _require_certain(
    place_map: PlaceMap, drive: PlaceMap, driven: _Driven, roots: np.ndarray
) -> None:
    """
    Reject a drive that may be wrong about where it is.

    :raises InputError: too few images are certain, later ones disagree, or the thumbnails do.
    """
    certain, places = driven.certain, driven.places
    if len(certain) < max(MIN_SESSION, MIN_CERTAIN * driven.driven[-1]):
        raise InputError(
            f'{len(certain)} of {len(drive)} images are certain where they are: expected '
            f'{MIN_SESSION}, and {MIN_CERTAIN:.0%} of those in motion; the map stays as it is'
        )
    drives, lap = _drives(place_map), _lap(place_map, roots)
    for a, b in pairwise(certain):
        p, q = roots[places[a]], roots[places[b]]
        allowed = FASTEST * (b - a) + SLACK
        if drives[p] == drives[q] and not -SLACK <= _ahead(p, q, lap) <= allowed:
            raise InputError(
                f'images {a} and {b} are certain of places {p} and {q}, which they cannot both '
                'be right about; the map stays as it is'
            )
    if not (len(place_map.thumbnails) and len(drive.thumbnails)):
        return
    verifier, signs = PlaceVerifier(GeometricSettings('orb')), []
    for image in certain[np.linspace(0, len(certain) - 1, PROBES).astype(int)].tolist():
        query, place = drive.thumbnail(image), int(places[image])
        if query is None:
            continue
        other = (place + max(FAR, len(place_map) // 2)) % len(place_map)
        flipped = np.ascontiguousarray(np.fliplr(query))
        views = (query, place), (query, other), (flipped, place)
        right, *wrong = (verifier.inliers(image, place_map, each) or 0 for image, each in views)
        signs.append(np.sign(right - np.array(wrong)))
    if (np.sum(signs, axis=0) < -2 * np.abs(signs).sum(axis=0) ** 0.5).any():
        raise InputError(
            'the thumbnails of the certain images fit other places, or mirrored, better; the map '
            'stays as it is'
        )


def _runs(place_map: PlaceMap) -> np.ndarray:
    """Return the session of each place, (n,)."""
    index = place_map.session_index
    return np.zeros(len(place_map), np.int32) if index is None else index


def _drives(place_map: PlaceMap) -> np.ndarray:
    """
    Return a number of the drive of each place, (n,), the same in all parts of a split session.

    :func:`keep_places` numbers their ids; they have one start, and other drives, whose ids may be
    numbered as well, have another.
    """
    runs = _runs(place_map)
    keys = []
    for session in place_map.sessions or (Session('first'),):
        base = re.sub(r'-\d+$', '', session.id)
        keys.append((base if session.start or base == 'first' else session.id, session.start))
    return np.array([keys.index(key) for key in keys])[runs]


def _again(place_map: PlaceMap, roots: np.ndarray) -> np.ndarray:
    """Return which places, at the end of a closed route, show places of its start, (n,)."""
    drives = _drives(place_map)
    is_again: np.ndarray = (drives[roots] == drives) & (
        np.arange(len(roots)) - roots > MIN_SESSION
    )
    return is_again


def _lap(place_map: PlaceMap, roots: np.ndarray) -> int:
    """Return the number of places of a closed route's lap, 0 of another route."""
    again = np.flatnonzero(_again(place_map, roots))
    return int(np.median(again - roots[again])) if len(again) else 0


def _ahead(p: int | np.ndarray, q: int | np.ndarray, lap: int) -> Any:
    """Return how far place q is ahead of p, on a closed route over its seam."""
    return (q - p + SLACK) % lap - SLACK if lap else q - p


def _unrolled(places: np.ndarray, lap: int) -> np.ndarray:
    """Return places of a path, (m,), such that they go on behind the seam of a closed route."""
    steps = _ahead(places[:-1], places[1:], lap)
    return places[0] + np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)


def _used(
    place_map: PlaceMap,
    driven: _Driven,
    roots: np.ndarray,
    version: Version,
    stretches: list[_Stretch],
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return use and missed drives of each place (:class:`Version`), after this drive.

    :param stretches: of the drive; where they are an experience of places, it passed these.
    """
    n, runs = len(place_map), _runs(place_map)
    use, missed = np.array(version.use), np.array(version.missed, np.int64)
    use = use * DECAY if len(use) == n else np.full(n, DECAY)
    missed = missed if len(missed) == n else np.zeros(n, np.int64)
    helped, passed = np.zeros(n, bool), np.zeros(n, bool)
    places, certain = driven.of_windows, np.flatnonzero(driven.of_windows >= 0)
    lap = _lap(place_map, roots)
    for a, b in pairwise(certain):
        p, q = places[a], places[b]
        if runs[p] == runs[q] and 0 <= q - p <= FASTEST * (b - a) + SLACK and b - a <= SLACK:
            helped[p : q + 1] = True
        p, q = roots[p], roots[q]
        if runs[p] == runs[q] and b - a < MIN_HARD:
            between = p + np.arange(_ahead(p, q, lap) + 1)
            passed[between % lap if p < lap else between] = True
    for stretch in stretches:
        if not stretch.is_detour:
            passed[roots[stretch.places]] = True
    helped[places[certain]] = True
    fits = np.zeros(n, bool)  # a place of the same session beside it was recognized
    for run in np.unique(runs):
        own = np.flatnonzero(runs == run)
        near = np.convolve(helped[own], np.ones(2 * NEAR + 1))[NEAR : NEAR + len(own)]
        fits[own] = near > 0.5
    missed = np.where(helped, 0, missed + (passed[roots] & fits))
    return use + helped, missed


def _stretches(
    place_map: PlaceMap, drive: PlaceMap, driven: _Driven, roots: np.ndarray
) -> list[_Stretch]:
    """Return the stretches of a drive that are not recognized, between images that are."""
    runs, stretches, certain = _runs(place_map), [], driven.certain
    places, moves, count = driven.places, driven.moves, driven.driven
    lap, is_root = _lap(place_map, roots), roots == np.arange(len(roots))
    for a, b in pairwise(certain.tolist()):
        inside = a + 1 + np.flatnonzero(moves[a + 1 : b])
        p, q = int(roots[places[a]]), int(roots[places[b]])
        if (~driven.is_matched[inside]).sum() < MIN_HARD:
            continue
        line = p + (count - count[a]) * _ahead(p, q, lap) / max(count[b] - count[a], 1)
        is_same = bool(runs[p] == runs[q]) and _is_same_road(
            driven, drive, roots, (a, b), line, is_root & (runs == runs[p])
        )
        of_gap = driven.of_windows[inside]
        if is_same:
            of_gap = np.rint(line[inside]).astype(np.int64)
            of_gap %= lap if p < lap else len(roots)
        margin = max(MARGIN, -(-(MIN_SESSION - len(inside)) // 2))
        before = certain[(certain <= a) & (certain > a - margin) & moves[certain]]
        after = certain[(certain >= b) & (certain < b + margin) & moves[certain]]
        stretches.append(
            _Stretch(
                np.concatenate([before, inside, after]),
                np.concatenate([places[before], of_gap, places[after]]),
                not is_same,
            )
        )
    return stretches


def _is_same_road(
    driven: _Driven,
    drive: PlaceMap,
    roots: np.ndarray,
    ends: tuple[int, int],
    line: np.ndarray,
    is_run: np.ndarray,
) -> bool:
    """
    Return whether the images between two certain ones show the places between theirs.

    They do if the camera moves as far as from place to place, or if they are nearer to these
    places than to places on paths beside.

    :param line: the places by even motion, (N,); is_run: whether a place is of the session, (n,).
    """
    a, b = ends
    inside, run = np.arange(a + 1, b), np.flatnonzero(is_run)
    d = driven.recognizer.distances(drive.features[inside])[:, run]
    z = (d - d.mean(axis=1, keepdims=True)) / d.std(axis=1, keepdims=True).clip(1e-9)
    path, rows, count = np.rint(line[inside] - run[0]).astype(int), np.arange(len(z)), len(run)
    near = [
        np.mean([z[rows, (path + shift + k) % count] for k in range(-2, 3)], axis=0).mean()
        for shift in range(count)
    ]
    others = np.array(near[FAR : count - FAR + 1])
    rank = float((others <= near[0]).mean()) if len(others) else 1.0
    speeds = []
    for low, high in ((a - NEAR, a), (b, b + NEAR)):
        beside = driven.certain[(driven.certain >= low) & (driven.certain <= high)]
        at, images = roots[driven.places[beside]], driven.driven[beside]
        if len(beside) > NEAR // 4 and images[-1] > images[0]:
            speeds.append(_ahead(at[0], at[-1], count) / (images[-1] - images[0]))
    even = np.mean(speeds) * (driven.driven[b] - driven.driven[a]) if speeds else np.inf
    ratio = (line[b] - line[a]) / max(even, 1e-9)
    return 0.8 <= ratio <= 1.25 or (rank <= SAME_ROAD and 0.5 <= ratio <= 2)


def _with_stretches(
    place_map: PlaceMap, drive: PlaceMap, name: str, stretches: list[_Stretch]
) -> PlaceMap:
    """Return the map with stretches as sessions, related where they show its places."""
    roots = np.arange(len(place_map)) if place_map.same_as is None else place_map.same_as
    parts, same_as = [place_map], [roots]
    first = len(place_map)
    for stretch in stretches:
        images, places = stretch.images, stretch.places
        has = places >= 0
        own = np.arange(first, first + len(images))
        same_as.append(np.where(has, roots[places], own))
        ids = [
            place_map.ids[place] if place >= 0 else f'{name}/{drive.ids[image] or image}'
            for image, place in zip(images.tolist(), places.tolist(), strict=True)
        ]
        thumbnails = drive.thumbnails or [b''] * len(drive)
        parts.append(
            PlaceMap(
                drive.features[images],
                place_map.projection,
                drive.stamps[images],
                tuple(ids),
                _poses(place_map, drive, stretch),
                tuple(thumbnails[i] for i in images.tolist()) if place_map.thumbnails else (),
                camera=place_map.camera,
            )
        )
        first += len(images)
    merged = merge_maps(parts, ['first', *[name] * len(stretches)])
    return replace(
        merged,
        threshold=place_map.threshold,
        same_as=np.concatenate(same_as).astype(np.int32),
    )


def _poses(place_map: PlaceMap, drive: PlaceMap, stretch: _Stretch) -> np.ndarray | None:
    """Return the poses of a stretch in the frame of the map: of its places, else by odometry."""
    if place_map.poses is None:
        return None
    poses = np.full((len(stretch.images), 7), np.nan)
    has = stretch.places >= 0
    poses[has] = place_map.poses[stretch.places[has]]
    with_pose = np.flatnonzero(np.isfinite(poses).all(axis=1))
    if drive.poses is None or not len(with_pose):
        return poses
    own = drive.poses[stretch.images]
    for i in np.flatnonzero(~has & np.isfinite(own).all(axis=1)).tolist():
        # the last one that it passed
        at = with_pose[max(int(np.searchsorted(with_pose, i)) - 1, 0)]
        if np.isfinite(own[at]).all():
            moved = inverse(matrices(own[at])) @ matrices(own[i])
            poses[i] = to_poses(matrices(poses[at]) @ moved)
    return poses


def _renewing(
    place_map: PlaceMap, driven: _Driven, roots: np.ndarray, is_missed: np.ndarray
) -> np.ndarray:
    """
    Return the images of a drive that take the places of vanished ones, (n,); -1 = none.

    The drive is certain of the session beside the stretch, whose light is the one of today
    therefore, and within it, by other sessions, of all places.
    """
    runs, of_windows, n = _runs(place_map), driven.of_windows, len(place_map)
    images, certain = np.full(n, -1), np.flatnonzero(driven.of_windows >= 0)
    # of a closed route, its lap from a place that is not missed; its end gets what its start gets
    lap, once = _lap(place_map, roots), np.where(_again(place_map, roots), roots, np.arange(n))
    is_missed = is_missed & (once == np.arange(n))
    turn = int(np.argmin(is_missed[:lap])) if lap else 0
    order = np.r_[turn:lap, :turn, lap:n]
    begins = np.diff(is_missed[order], prepend=False) != 0
    begins |= np.diff(runs[order], prepend=runs[order[0]]) != 0
    for gone in np.split(order, np.flatnonzero(begins)):
        if not len(gone) or not is_missed[gone[0]] or len(gone) < MIN_MISSED:
            continue
        low, high, run = gone[0], gone[-1], runs[gone[0]]
        own = once[of_windows[certain]]
        until, since = (
            np.where(runs[own] == run, _ahead(*pair, lap), 0) for pair in ((own, low), (high, own))
        )
        before = certain[(until > 0) & (until <= NEAR)]
        after = certain[(since > 0) & (since <= NEAR)]
        after = after[after > before[-1:].sum()]
        if not len(before) or not len(after):
            continue
        reach = FASTEST * (NEAR + WIDER)
        passing = certain[(certain > before[-1] - reach) & (certain < after[0] + reach)]
        is_route = runs[roots[of_windows[passing]]] == runs[roots[low]]
        if not is_route[(passing >= before[-1]) & (passing <= after[0])].all():
            continue  # it went around
        passing = passing[is_route]
        places = np.arange(low - WIDER, low + len(gone) + WIDER)
        places = places % lap if low < lap else places[(places >= 0) & (places < n)]
        places = places[runs[places] == run]
        passed, sought = (_unrolled(roots[each], lap) for each in (of_windows[passing], places))
        at = passed[np.searchsorted(passing, before[-1])]
        sought += round((at - sought[np.argmax(places == low)]) / (lap or 1)) * lap
        passed = np.maximum.accumulate(passed)
        if np.abs(passed[:, None] - sought).min(axis=0).max() <= SLACK:
            images[places] = np.rint(np.interp(sought, passed, passing))
    return images[once]


def _with_images(place_map: PlaceMap, drive: PlaceMap, images: np.ndarray) -> PlaceMap:
    """Return a map with images of a drive at places with an image, (n,); -1 = as it is."""
    n = len(place_map)
    order = np.where(images < 0, np.arange(n), n + images)
    thumbnails = [*place_map.thumbnails, *(drive.thumbnails or [b''] * len(drive))]
    return replace(
        place_map,
        features=LocalFeatures.concatenate([place_map.features, drive.features])[order],
        stamps=np.concatenate([place_map.stamps, drive.stamps])[order],
        thumbnails=tuple(thumbnails[i] for i in order) if place_map.thumbnails else (),
    )


def _within(grown: PlaceMap, value: np.ndarray, limit: int) -> np.ndarray:
    """Return which places stay, (n,): whole pieces of least value go, the only ones last."""
    is_kept, runs = np.ones(len(grown), bool), _runs(grown)
    roots = np.arange(len(grown)) if grown.same_as is None else grown.same_as
    pieces = [
        piece
        for run in np.unique(runs)
        for own in [np.flatnonzero(runs == run)]
        for piece in np.array_split(own, max(1, round(len(own) / PIECE)))
    ]
    order = sorted(pieces, key=lambda piece: float(value[piece].mean()))
    for spares_the_only_ones in (True, False):
        for piece in order:
            if is_kept.sum() <= limit:
                return is_kept
            others = is_kept.copy()
            others[piece] = False
            covered = np.isin(roots[piece], roots[others]).mean() > 0.5
            if covered or not spares_the_only_ones:
                is_kept[piece] = False
    return is_kept
