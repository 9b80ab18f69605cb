# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images to local features: backbone, strips, projection; and the record of their settings."""

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import json
from typing import Any

import cv2
import numpy as np
from stavpr_ros.errors import FeatureMismatchError, ImageError, InputError, SettingsError
from stavpr_ros.features.projection import Projection
from stavpr_ros.features.registry import Backbone, backbone_class, settings_class
import torch


@dataclass(frozen=True)
class FeatureSettings:
    """
    All settings with an effect on the features; equal settings give comparable features.

    :param kind: name in the table of kinds, such as ``gradient``.
    :param backbone: the settings of that kind, its frozen dataclass.
    :param strips: number of vertical strips W.
    :param projection: identity of the random projection, None without one.
    """

    kind: str
    backbone: Any
    strips: int = 7
    projection: str | None = None

    def __post_init__(self) -> None:
        if self.strips < 1:
            raise SettingsError(f'strips W = {self.strips} must be at least 1')

    def to_json(self) -> str:
        """Return the settings as one line of JSON; map files keep it, so its keys are fixed."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> 'FeatureSettings':
        """
        Read the settings from the JSON of :meth:`to_json`.

        :raises SettingsError: no such kind, or no such setting of that kind.
        """
        try:
            fields = json.loads(text)
            kind = settings_class(fields['kind'])
            before = getattr(kind, 'BEFORE', {})
            fields['backbone'] = kind(**(before | fields['backbone']))
            return cls(**fields)
        except (ValueError, TypeError, KeyError) as error:
            raise SettingsError(
                f'feature settings cannot be read ({error}): {text[:200]}'
            ) from error


@dataclass(frozen=True)
class LocalFeatures:
    """
    The local features of n images, strip-major.

    :param strips: unit-norm features, shape (W, n, d), float32, a zero feature all zeros.
    :param weights: norm of each strip over the norm of its image's strips, shape (W, n), float32.
    :param settings: the settings of the extractor.
    :param cells: rows H and columns of a strip's cells: strips are (channels, H, columns),
        flattened; None if unknown, and after a random projection.
    """

    strips: torch.Tensor
    weights: torch.Tensor
    settings: FeatureSettings
    cells: tuple[int, int] | None = None

    def __len__(self) -> int:
        return self.strips.shape[1]

    @property
    def dimension(self) -> int:
        """Return the number d of dimensions of a strip."""
        return self.strips.shape[2]

    def __getitem__(self, images: slice | np.ndarray) -> 'LocalFeatures':
        strips, weights = self.strips[:, images], self.weights[:, images]
        return dataclasses.replace(self, strips=strips, weights=weights)

    def to(self, device: str | torch.device) -> 'LocalFeatures':
        """Return the features on a device."""
        strips, weights = self.strips.to(device), self.weights.to(device)
        return dataclasses.replace(self, strips=strips, weights=weights)

    def require_same_settings(self, other: FeatureSettings, where: str) -> None:
        """
        Reject features with other settings.

        :raises FeatureMismatchError: names both settings.
        """
        if self.settings != other:
            raise FeatureMismatchError(
                f'query features have the settings {self.settings.to_json()}, those of {where} '
                f'have {other.to_json()}: extract the query with the settings of the map'
            )

    @staticmethod
    def concatenate(parts: 'Sequence[LocalFeatures]') -> 'LocalFeatures':
        """Join the features of several batches of images."""
        return LocalFeatures(
            torch.cat([part.strips for part in parts], dim=1).contiguous(),
            torch.cat([part.weights for part in parts], dim=1).contiguous(),
            parts[0].settings,
            parts[0].cells,
        )


class FeatureExtractor:
    """
    Turns images into local features.

    :param kind: name in :data:`stavpr_ros.features.registry.KINDS`.
    :param backbone: settings of that kind; None for its defaults.
    :param strips: number of vertical strips W.
    :param projection: number of dimensions of a new Gaussian projection, a :class:`Projection`,
        or None.
    :param seed: of a new projection.
    :param device: ``cpu`` or ``cuda``.
    """

    def __init__(
        self,
        kind: str = 'gradient',
        backbone: Any = None,
        strips: int = 7,
        projection: int | Projection | None = None,
        seed: int = 0,
        device: str = 'cpu',
    ) -> None:
        if backbone is None:
            backbone = settings_class(kind)()
        self._backbone: Backbone = backbone_class(kind)(backbone, device)
        self.projection: Projection | None = None
        plain = FeatureSettings(kind, self._backbone.settings, strips)
        self.settings = plain
        if isinstance(projection, int):
            dimension = self.extract([np.zeros((64, 64, 3), np.uint8)]).strips.shape[2]
            projection = Projection.gaussian(dimension, projection, seed)
        if projection is not None:
            self.projection = projection
            self.settings = dataclasses.replace(plain, projection=projection.identity)

    @classmethod
    def from_settings(
        cls,
        settings: FeatureSettings,
        projection: Projection | None,
        device: str = 'cpu',
        **changes: Any,
    ) -> 'FeatureExtractor':
        """
        Make the extractor with the settings of a map.

        :param changes: settings of the backbone to replace, such as the path of a model file.
        :raises FeatureMismatchError: the projection or a change gives other features.
        """
        known = {field.name for field in dataclasses.fields(settings.backbone)}
        changes = {name: value for name, value in changes.items() if value and name in known}
        backbone = dataclasses.replace(settings.backbone, **changes)
        extractor = cls(settings.kind, backbone, settings.strips, projection, device=device)
        if extractor.settings != settings:
            raise FeatureMismatchError(
                f'this extractor has the settings {extractor.settings.to_json()}, the map '
                'requires '
                f'{settings.to_json()}'
            )
        return extractor

    def extract(self, images: Sequence[np.ndarray]) -> LocalFeatures:
        """
        Extract the local features of images.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: local features of shape (W, len(images), d).
        :raises ImageError: the features are not finite.
        """
        maps = self._backbone.feature_maps(images)
        strips = cut_strips(maps, self.settings.strips)
        cells: tuple[int, int] | None = (maps.shape[2], maps.shape[3] // self.settings.strips)
        if not bool(torch.isfinite(strips).all()):
            raise ImageError(
                'the features of an image are not finite: the network or its input is out of '
                'range',
                kind='features',
            )
        if self.projection is not None:
            strips, cells = self.projection.apply(strips), None
        return LocalFeatures(*normalize(strips), self.settings, cells)


def resize_square(image: np.ndarray, size: int, method: str) -> np.ndarray:
    """
    Resize without keeping the aspect and without cropping.

    :param image: shape (h, w) or (h, w, 3), uint8.
    :param method: ``bilinear``, as for the paper's networks; ``area`` averages where it shrinks,
        so that fine texture does not alias.
    :returns: shape (size, size) or (size, size, 3), uint8.
    """
    shrinks = image.shape[0] >= size and image.shape[1] >= size
    averages = method == 'area' and shrinks
    interpolation = cv2.INTER_AREA if averages else cv2.INTER_LINEAR
    return cv2.resize(image, (size, size), interpolation=interpolation)


def cut_strips(feature_maps: torch.Tensor, W: int) -> torch.Tensor:
    """
    Cut feature maps into W vertical strips and flatten each (section 1 of the method).

    Of the r = Wf mod W surplus columns, floor(r / 2) are dropped on the left, the others on the
    right; every strip is floor(Wf / W) columns wide.

    :param feature_maps: shape (n, C, H, Wf).
    :returns: local features, shape (W, n, C * H * floor(Wf / W)), float32, not normalized.
    :raises InputError: fewer columns than strips, or not four axes.
    """
    if feature_maps.ndim != 4:
        raise InputError(
            f'feature maps have shape {tuple(feature_maps.shape)}: expected (n, C, H, Wf)'
        )
    n, channels, height, Wf = feature_maps.shape
    if not 1 <= W <= Wf:
        raise InputError(
            f'feature maps are Wf = {Wf} columns wide: they cannot be cut into W = {W} strips'
        )
    width = Wf // W
    left = (Wf % W) // 2
    kept = feature_maps[..., left : left + W * width].float()
    strips = kept.reshape(n, channels, height, W, width).permute(3, 0, 1, 2, 4)
    return strips.reshape(W, n, channels * height * width)


def normalize(strips: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Split strips into directions and shares of the image's norm.

    :param strips: shape (W, n, d), float32.
    :returns: unit-norm strips (W, n, d), a zero strip stays zero (distance 1 to everything), and
        weights (W, n): norm of the strip / norm of all strips of its image, 0 for a black image.
    """
    norms = torch.linalg.vector_norm(strips, dim=2)
    whole = torch.linalg.vector_norm(norms, dim=0)
    unit = strips / torch.where(norms > 0, norms, 1)[:, :, None]
    return unit, norms / torch.where(whole > 0, whole, 1)
