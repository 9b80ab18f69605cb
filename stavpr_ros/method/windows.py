# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window of a map, by mode and backend; the columns of its places, and what they cost."""

from typing import TYPE_CHECKING

import numpy as np
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import Map
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.filter import SPACING
from stavpr_ros.method.lm_dtw_window import LmDtwWindow
from stavpr_ros.method.model import MODEL
from stavpr_ros.method.settings import PAPER, RecognizerSettings
from stavpr_ros.method.window import FilterWindow, QueryWindow
from stavpr_ros.prepare.blocks import MAX_LAG
from stavpr_ros.prepare.centering import ONE_SESSION

if TYPE_CHECKING:
    import torch


def window_of(
    place_map: Map,
    settings: RecognizerSettings,
    backend: 'str | torch.device',
    constant: float,
) -> QueryWindow:
    """
    Return an empty window for a map.

    :param constant: of the evidence of its features.
    """
    options, n, sequence = settings.applied_options, len(place_map), settings.sequence
    length = sequence.length + SPACING if options.place_filter else 0
    layout = layout_of(place_map, settings.nms_radius, settings.moves_against, length)
    if options.place_filter:
        arguments = sequence, n, layout
        if isinstance(backend, str):
            return FilterWindow(*arguments, constant=constant)
        from stavpr_ros.method.device import DeviceFilterWindow

        return DeviceFilterWindow(*arguments, constant=constant, device=backend)
    if isinstance(backend, str):
        return LmDtwWindow(sequence, n, layout, options.query_znorm)
    if options != PAPER:
        raise SettingsError(
            f"options {options} with backend '{backend}': without the place filter, it runs mode "
            "paper only; take 'cpu'"
        )
    from stavpr_ros.method.device import DeviceLmDtwWindow

    return DeviceLmDtwWindow(sequence, n, layout, backend)


def layout_of(
    place_map: Map, nms_radius: int, against: bool = False, length: int = 0
) -> ColumnLayout:
    """
    Return the layout of a map.

    :param against: the camera may move against the map.
    :param length: l, of a window that goes on over the seam of a closed route.
    """
    index, n = place_map.session_index, len(place_map)
    same_as = np.arange(n) if place_map.same_as is None else place_map.same_as.astype(np.int64)
    firsts = np.flatnonzero(np.diff(index, prepend=-1)) if index is not None and n else ONE_SESSION
    repeated, seam = 0, place_map.seam
    if length and seam is not None:
        repeated = min(n - 1 - 2 * seam, int(length * max(MODEL.speeds)))
        repeated = repeated if repeated > MAX_LAG else 0
    return ColumnLayout(firsts, same_as, nms_radius, against and n > 0, repeated)


def time_note(place_map: Map) -> str:
    """Return what several sessions cost, for the log of a start, '' of a map of one."""
    n = len(place_map.sessions)
    return f'{n} sessions: an image takes up to {n} times the time of one' if n > 1 else ''
