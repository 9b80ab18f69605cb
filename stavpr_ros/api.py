# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One image after the other to its place on a map."""

from dataclasses import fields, replace
from functools import cached_property
from typing import Any, TYPE_CHECKING

import numpy as np
from stavpr_ros.checks import require_choice, require_type, rgb_image
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import Map
from stavpr_ros.method import Match, PlaceRecognizer, RecognizerSettings
from stavpr_ros.sources.files import reduce, scale, upper_byte

if TYPE_CHECKING:
    import torch

OPTIONS = tuple(field.name for field in fields(RecognizerSettings))


class Localizer:
    """
    Recognizer of the places of a map, with features and :class:`PlaceRecognizer` in one.

    :param route: the map.
    :param settings: of recognition; None = the defaults.
    :param backend: of the matching: ``cpu``, ``cuda``, ``auto``, or any device of torch.
    :param device: of the network of the features: ``cpu``, ``cuda`` or ``auto``.
    :param precision: of the map's features: ``float32``, ``int8`` or ``auto``.
    :param options: fields of :class:`stavpr_ros.method.RecognizerSettings` that differ from
        ``settings``, such as ``min_probability=0.3``, ``max_error=0.01``, ``direction='both'``.
    :raises InputError: the map is no :class:`Map`, or damaged.
    :raises SettingsError: an unknown option, one out of range, or one that does not fit the map.
    :raises UnavailableError: no such backend or device here, or the network's file is missing; of
        device and file at the first image.
    """

    def __init__(
        self,
        route: Map,
        *,
        settings: RecognizerSettings | None = None,
        backend: 'str | torch.device' = 'cpu',
        device: str = 'cpu',
        precision: str = 'auto',
        **options: Any,
    ) -> None:
        for name in options:
            require_choice('option of Localizer', name, OPTIONS)
        settings = RecognizerSettings() if settings is None else settings
        require_type('settings', settings, RecognizerSettings, 'RecognizerSettings(...)')
        settings = replace(settings, **options)
        self.recognizer = PlaceRecognizer(route, settings, backend, precision)
        self.route, self._device = route, device
        self._to_bytes = scale(route.settings.value_range) or upper_byte

    @cached_property
    def extractor(self) -> FeatureExtractor:
        """Return the extractor of the map; a map of vectors from a file has none."""
        return self.route.extractor(self._device)

    def __call__(
        self, image: Any, stamp: int | None = None, pose: np.ndarray | None = None
    ) -> Match:
        """
        Match the images up to this one; an error changes nothing.

        :param image: RGB, shape (h, w, 3), uint8, or uint16, which is converted as the map's
            images were; or the features of one image.
        :param stamp: when it was taken, ns, 0 = unknown; None = as an image of
            :func:`stavpr_ros.images` carries it, else unknown.
        :param pose: by odometry, x y z [m] and quaternion x y z w, shape (7,); None = unknown.
        :returns: ``newest`` is the place of this image, ``place`` the place half a window ago.
        :raises InputError: another image, stamp or pose, and how to convert it.
        :raises FeatureMismatchError: features of other settings than the map's.
        """
        stamp = getattr(image, 'stamp', 0) if stamp is None else stamp
        if not isinstance(image, LocalFeatures):
            image = self._features(rgb_image(image, 'image', 'uint8', 'uint16'))
        whole = 'whole nanoseconds, as time.time_ns(); 0 = unknown'
        require_type('stamp', stamp, (int, np.integer), whole)
        return self.recognizer.update(image, int(stamp), pose)

    def reset(self) -> None:
        """Begin another drive: the next images do not continue those before."""
        self.recognizer.reset()

    def _features(self, image: np.ndarray) -> LocalFeatures:
        """Return the features of an image, reduced where it is large, as the node does."""
        if image.dtype == np.uint16:
            image = self._to_bytes(image)
        return self.extractor.extract([reduce(image, self.extractor.needed_size(0))])
