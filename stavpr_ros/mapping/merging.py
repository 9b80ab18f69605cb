# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several maps in one: each drive is a session of it."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

import numpy as np
from stavpr_ros.errors import FeatureMismatchError, InputError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping.camera import yaw_of
from stavpr_ros.mapping.place_map import Map, Session


def merge_maps(
    maps: Sequence[Map],
    names: Sequence[str],
    cameras: Sequence[tuple[str, float | None]] = (),
) -> Map:
    """
    Return one map with the places of all, in their order; without threshold and error risks.

    :param names: id and name of the session that a map without sessions becomes; one each.
    :param cameras: name of each map's camera, and the yaw of the optical axis in the
        base, radians to the left; None = of its intrinsics, else unknown. Empty = not stated.
    :raises FeatureMismatchError: features of different settings.
    :raises InputError: no map.
    """
    if not maps:
        raise InputError('no maps to merge: give at least one')
    if len(cameras) not in (0, len(maps)):
        raise InputError(f'{len(cameras)} cameras of {len(maps)} maps: expected one each')
    # one section for the whole map
    camera = maps[0].camera if len({part.camera for part in maps}) == 1 else None
    sessions: list[Session] = []
    index = []
    for number, (place_map, name) in enumerate(zip(maps, names, strict=True)):
        place_map.features.require_same_settings(maps[0].settings, 'the first map')
        if place_map.dimension != maps[0].dimension:
            raise FeatureMismatchError(
                f'strips of {place_map.dimension} dimensions, the first map has '
                f'{maps[0].dimension}'
            )
        start = int(place_map.stamps[0]) if len(place_map) else 0
        map_sessions = place_map.sessions or (Session(name[:64], name[:128], start=max(start, 0)),)
        numbers = place_map.session_index
        if numbers is None:
            numbers = np.zeros(len(place_map), np.int32)
        index.append(numbers + np.int32(len(sessions)))
        for session in map_sessions:
            intrinsics = session.intrinsics or (place_map.camera if camera is None else None)
            added = replace(session, id=_free_id(session.id, sessions), intrinsics=intrinsics)
            if cameras:
                calibration, (label, yaw) = added.intrinsics or camera, cameras[number]
                if yaw is None and calibration is not None:
                    yaw = yaw_of(calibration.mount)
                added = replace(added, camera=label, yaw=yaw)
            sessions.append(added)
    poses = [
        np.full((len(part), 7), np.nan) if part.poses is None else part.poses for part in maps
    ]
    thumbnails = [content for part in maps for content in part.thumbnails or [b''] * len(part)]
    return Map(
        features=LocalFeatures.concatenate([part.features for part in maps]),
        projection=maps[0].projection,
        stamps=np.concatenate([part.stamps for part in maps]),
        ids=tuple(identifier for part in maps for identifier in part.ids),
        poses=np.concatenate(poses) if any(part.has_poses for part in maps) else None,
        thumbnails=tuple(thumbnails) if any(len(part.thumbnails) for part in maps) else (),
        sessions=tuple(sessions),
        session_index=np.concatenate(index),
        camera=camera,
        same_as=_join_same_as(maps),
    )


def select_session(place_map: Map, session_id: str, keep: bool = True) -> Map:
    """
    Return the places of one session only, or of all others.

    :raises InputError: no such session, or nothing is left.
    """
    ids = [session.id for session in place_map.sessions]
    if session_id not in ids:
        raise InputError(f'session {session_id!r} is not in the map: it has {ids}')
    number = ids.index(session_id)
    assert place_map.session_index is not None
    is_selected = (place_map.session_index == number) == keep
    if not is_selected.any():
        raise InputError(f'without session {session_id!r} no place is left')
    chosen_map = select_places(place_map, np.flatnonzero(is_selected))
    return replace(chosen_map, error_risks=None)  # they are of drives on all sessions


def select_places(place_map: Map, places: np.ndarray) -> Map:
    """
    Return a map of selected places.

    Places that are the same stay so. Threshold and error risks stay: they are of drives on this
    route.

    :param places: ascending, (m,), int64.
    """
    indices, index, same_as = places.tolist(), place_map.session_index, place_map.same_as
    sessions = place_map.sessions
    if index is not None:
        numbers, index = np.unique(index[places], return_inverse=True)
        sessions, index = tuple(sessions[i] for i in numbers), index.astype(np.int32)
    if same_as is not None:  # of places that show the same, all name the earliest
        _, first, group = np.unique(same_as[places], return_index=True, return_inverse=True)
        same_as = first[group].astype(np.int32)
    return replace(
        place_map,
        features=place_map.features[places],
        stamps=place_map.stamps[places],
        ids=tuple(place_map.ids[i] for i in indices),
        poses=None if place_map.poses is None else place_map.poses[places],
        thumbnails=tuple(place_map.thumbnails[i] for i in indices) if place_map.thumbnails else (),
        sessions=sessions,
        session_index=index,
        same_as=same_as,
        map_id='',
    )


def _free_id(base: str, sessions: list[Session]) -> str:
    """Return the id, or the first numbered one that no other session has."""
    others = {session.id for session in sessions}
    names = (base if number == 1 else f'{base[:60]}-{number}' for number in count(1))
    return next(name for name in names if name not in others)


def along_route(places: Map) -> tuple[np.ndarray, int]:
    """
    Return the position of each place along the route, (n,), and the places of a closed lap.

    A place that an earlier session shows as well has the position of the place there, and the
    places after it follow, up to the next such place.
    """
    numbers = np.arange(len(places))
    if places.same_as is None:
        return numbers, 0
    related = np.where(places.same_as < numbers, numbers, -1)
    session = np.zeros(len(places), int) if places.session_index is None else places.session_index
    for run in np.split(numbers, np.flatnonzero(np.diff(session)) + 1):
        related[run] = np.maximum.accumulate(related[run])
    positions = np.where(related < 0, numbers, places.same_as[related] + numbers - related)
    seam = places.seam
    return positions, 0 if seam is None else len(places) - 1 - seam


def _join_same_as(maps: Sequence[Map]) -> np.ndarray | None:
    if all(part.same_as is None for part in maps):
        return None
    parts, first = [], 0
    for place_map in maps:
        roots = np.arange(len(place_map)) if place_map.same_as is None else place_map.same_as
        parts.append(roots + first)
        first += len(place_map)
    return np.concatenate(parts).astype(np.int32)
