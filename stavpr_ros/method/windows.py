# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window of a map, by mode and backend."""

from typing import TYPE_CHECKING

from stavpr_ros.errors import SettingsError
from stavpr_ros.features.registry import evidence_of
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.method.filter import SPACING
from stavpr_ros.method.lm_dtw_window import LmDtwWindow
from stavpr_ros.method.model import MODEL
from stavpr_ros.method.query_window import QueryWindow
from stavpr_ros.method.sessions import layout_of
from stavpr_ros.method.settings import PAPER, RecognizerSettings
from stavpr_ros.method.window import FilterWindow

if TYPE_CHECKING:
    import torch


def window_of(
    place_map: PlaceMap, settings: RecognizerSettings, backend: 'str | torch.device'
) -> QueryWindow:
    """Return an empty window for a map."""
    options, n, sequence = settings.applied_options, len(place_map), settings.sequence
    length = sequence.length + SPACING if options.place_filter else 0
    layout = layout_of(place_map, settings.nms_radius, MODEL, settings.moves_against, length)
    if options.place_filter:
        window: FilterWindow
        arguments = sequence, n, layout, True
        W = place_map.settings.strips
        constant, _ = evidence_of(place_map.settings.kind, W, place_map.features.dimension)
        if isinstance(backend, str):
            window = FilterWindow(*arguments, constant=constant)
        else:
            from stavpr_ros.method.device_windows import DeviceFilterWindow

            window = DeviceFilterWindow(*arguments, constant=constant, device=backend)
        return window
    if isinstance(backend, str):
        return LmDtwWindow(sequence, n, layout, options.query_znorm)
    if options != PAPER:
        raise SettingsError(
            f"options {options} with backend '{backend}': without the place filter, it runs mode "
            "paper only; take 'cpu'"
        )
    from stavpr_ros.method.device_windows import DeviceLmDtwWindow

    return DeviceLmDtwWindow(sequence, n, layout, backend)
