# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images to local features: backbone, strips, projection; and the record of their settings."""

from collections.abc import Iterable, Sequence
import dataclasses
from dataclasses import dataclass
from functools import cached_property
import hashlib
from importlib import import_module
import json
import logging
from typing import Any

import cv2
import numpy as np
from stavpr_ros.checks import require_at_least, require_shape, rgb_image
from stavpr_ros.errors import (
    FeatureMismatchError,
    ImageError,
    InputError,
    SettingsError,
    StavprError,
)
from stavpr_ros.features.efficientnet_lite_file import find_file, find_file_of_map
from stavpr_ros.features.model_files import find_model
from stavpr_ros.features.registry import (
    AUTO,
    EfficientNetSettings,
    make_backbone,
    NetworkSettings,
    settings_class,
)

STRIPS = 7  # strips of a feature map, as in the paper; a vector is one strip
GEM_EXPONENT = 3
TEST_SIDE = 64  # pixels of the image that a network is tried on
COST = 'ms of processor time for an image of 640x480'
HYBRID_MS, GRADIENT_MS = 7, 0.5  # on an AMD EPYC


@dataclass(frozen=True, eq=False)
class Projection:
    """
    A fixed linear map of local features (section 3); map files store its matrix.

    :param matrix: shape (d, dimension), float32.
    :param name: description of its origin.
    :raises InputError: another shape or type.
    """

    matrix: np.ndarray
    name: str

    def __post_init__(self) -> None:
        require_shape('matrix of the projection', self.matrix, 'D Dimension', 'float32')

    @classmethod
    def gaussian(cls, dimension_in: int, dimension: int = 512, seed: int = 0) -> 'Projection':
        """
        Draw a Gaussian matrix, entries of variance 1 / dimension: norms are kept on average.

        :raises SettingsError: a dimension below 1, or a negative seed.
        """
        require_at_least('dimension of the features', dimension_in, 1)
        require_at_least('dimension of the projection', dimension, 1)
        require_at_least('seed of the projection', seed, 0)
        matrix = np.random.default_rng(seed).standard_normal((dimension_in, dimension))
        return cls(
            np.ascontiguousarray(matrix / np.sqrt(dimension), np.float32),
            f'gaussian {dimension_in} -> {dimension}, seed {seed}',
        )

    @cached_property
    def identity(self) -> str:
        """Name and hash of the matrix; equal for equal projections only."""
        digest = hashlib.sha256(np.ascontiguousarray(self.matrix).tobytes()).hexdigest()
        return f'{self.name}, sha256 {digest[:16]}'

    def apply(self, strips: np.ndarray) -> np.ndarray:
        """
        Project local features.

        :param strips: shape (W, n, d), float32.
        :returns: shape (W, n, dimension), float32.
        :raises InputError: another d than the matrix has rows.
        """
        require_shape('local features', strips, f'W n {len(self.matrix)}')
        return strips @ self.matrix


@dataclass(frozen=True)
class FeatureSettings:
    """
    All settings with an effect on the features; equal settings give comparable features.

    :param kind: name in the table of kinds, such as ``gradient``.
    :param backbone: the settings of that kind, its frozen dataclass.
    :param strips: number of vertical strips W; 1 for features that are one vector.
    :param projection: identity of the random projection, None without one.
    :param feature_version: version of the computation: another one gives other features.
    :param value_range: the values of 16 bits that become 0 and 255; None = the upper byte is
        taken.
    """

    kind: str
    backbone: Any
    strips: int = 7
    projection: str | None = None
    feature_version: int = 1
    value_range: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.feature_version != 1:
            raise SettingsError(
                f'features {self.kind} of version {self.feature_version} are unknown, expected '
                '1: update this program'
            )
        require_at_least('strips W', self.strips, 1)

    def to_json(self) -> str:
        """Return the settings as one line of JSON."""
        values = dataclasses.asdict(self)
        if self.value_range is None:
            del values['value_range']
        return json.dumps(values, sort_keys=True)


@dataclass(frozen=True)
class LocalFeatures:
    """
    The local features of n images, strip-major.

    :param strips: unit-norm features, shape (W, n, d), float32, a zero feature all zeros.
    :param weights: norm of each strip over the norm of its image's strips, shape (W, n), float32.
    :param settings: the settings of the extractor.
    :param cells: rows H and columns of a strip's cells: strips are (channels, H, columns),
        flattened; None if unknown, and after a random projection.
    :raises InputError: arrays of other shapes or types.
    """

    strips: np.ndarray
    weights: np.ndarray
    settings: FeatureSettings
    cells: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        W, n, _ = require_shape('strips', self.strips, 'W n d', 'float32')
        require_shape('weights', self.weights, f'{W} {n}', 'float32')

    def __len__(self) -> int:
        return self.strips.shape[1]

    def __repr__(self) -> str:
        strips, images, dimension = self.strips.shape
        return (
            f'LocalFeatures({self.settings.kind} of {images} images, {strips} strips of '
            f'{dimension} dimensions)'
        )

    @property
    def dimension(self) -> int:
        """Return the number d of dimensions of a strip."""
        return self.strips.shape[2]

    def __getitem__(self, images: slice | np.ndarray) -> 'LocalFeatures':
        strips, weights = self.strips[:, images], self.weights[:, images]
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

    def require_fit(self, settings: FeatureSettings, where: str, dimension: int) -> None:
        """
        Reject features that do not fit the places: kernels trust their shapes.

        :param settings, dimension: the places'; a dimension of 0 is unknown yet.
        :raises FeatureMismatchError: other settings, or another network.
        :raises InputError: strips or weights of another shape or type.
        """
        self.require_same_settings(settings, where)
        strips, n, d = require_shape('strips', self.strips, f'{settings.strips} n d', 'float32')
        require_shape('weights', self.weights, f'{strips} {n}')
        if dimension not in (0, d):
            raise FeatureMismatchError(
                f'strips of {d} dimensions, {where} has {dimension}: it was not made with this '
                'network; build it again'
            )

    @staticmethod
    def concatenate(parts: 'Sequence[LocalFeatures]') -> 'LocalFeatures':
        """Join the features of several batches of images."""
        return LocalFeatures(
            np.concatenate([part.strips for part in parts], axis=1),
            np.concatenate([part.weights for part in parts], axis=1),
            parts[0].settings,
            parts[0].cells,
        )


def choose_kind() -> tuple[str, str]:
    """Return ``hybrid`` where it can be computed, else ``gradient``; and why, for the log."""
    try:
        import_module('onnxruntime')
        path = find_file()
    except (ImportError, StavprError) as error:
        remedy = ': pip install onnxruntime' * isinstance(error, ImportError)
        return 'gradient', (
            f'features auto: gradient, {GRADIENT_MS} {COST}; hybrid, {HYBRID_MS} ms and more '
            f'matches in other light, is not available: {error}{remedy}'
        )
    return 'hybrid', (
        f'features auto: hybrid, {HYBRID_MS} {COST}, with onnxruntime and {path}; '
        f'gradient takes {GRADIENT_MS} ms'
    )


class FeatureExtractor:
    """
    Extractor of the local features of images.

    A network is tried on one image first, so that unusable ones fail before any work.

    :param kind: one of :func:`stavpr_ros.features.registry.kinds`; or ``auto``: ``hybrid`` where
        onnxruntime and the network's file are there or can be made, else ``gradient``.
    :param backbone: settings of that kind; None for its defaults, and with ``auto``.
    :param strips: number of vertical strips W; None = 7, or 1 if an image has one vector.
    :param projection: number of dimensions of a new Gaussian projection, a :class:`Projection`,
        or None.
    :param seed: seed of a new projection.
    :param device: ``cpu``, ``cuda`` or ``auto``: ``cuda`` where it is available.
    :raises SettingsError: the network's output cannot be used.
    :raises UnavailableError: the device or the network's file is not there.

    ``is_new`` until its first images have decided the range of values of 16 bits; ``choice`` is
    the line in the log that names what ``auto`` became, and why, '' = a kind was named.
    """

    is_new = True
    choice = ''

    def __init__(
        self,
        kind: str = AUTO,
        backbone: Any = None,
        strips: int | None = None,
        projection: int | Projection | None = None,
        seed: int = 0,
        device: str = 'cpu',
    ) -> None:
        if kind == AUTO and backbone is None:
            kind, self.choice = choose_kind()
            device = 'auto' if device == 'cuda' else device  # gradient computes on the CPU as well
            logging.getLogger(__name__).info('%s', self.choice)
        if backbone is None:
            backbone = settings_class(kind)()
        self._backbone = make_backbone(kind, backbone, device)
        self.projection: Projection | None = None
        test_maps = None
        if strips is None or isinstance(backbone, NetworkSettings) or isinstance(projection, int):
            image = np.random.default_rng(0).integers(0, 256, (TEST_SIDE, TEST_SIDE, 3), np.uint8)
            test_maps = self._backbone.feature_maps([image])
            if not np.isfinite(test_maps).all():
                raise SettingsError(
                    f'features {kind} of a test image are not finite: the network is damaged, or '
                    f'its input out of range; its settings are {self._backbone.settings}'
                )
        if strips is None:
            strips = 1 if test_maps is not None and test_maps.ndim == 2 else STRIPS
        plain = FeatureSettings(kind, self._backbone.settings, strips)
        self.settings = plain
        if test_maps is not None:
            dimension = self._cut(test_maps)[0].shape[2]
        if isinstance(projection, int):
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
        model: str = '',
    ) -> 'FeatureExtractor':
        """
        Make the extractor with the settings of a map.

        :param model: file of the network or a folder with it, for kinds that have one, see
            :func:`stavpr_ros.features.model_files.find_model`; '' = as the settings state.
        :raises FeatureMismatchError: the projection or the model gives other features.
        :raises UnavailableError: the model is not found.
        """
        backbone = settings.backbone
        if isinstance(backbone, NetworkSettings):
            model = model or backbone.model
            if backbone.sha256:
                is_lite = isinstance(backbone, EfficientNetSettings)
                model = str((find_file_of_map if is_lite else find_model)(backbone.sha256, model))
            backbone = dataclasses.replace(backbone, model=model)
        extractor = cls(settings.kind, backbone, settings.strips, projection, device=device)
        extractor.settings = dataclasses.replace(
            extractor.settings, value_range=settings.value_range
        )
        extractor.is_new = False
        if extractor.settings != settings:
            raise FeatureMismatchError(
                f'this extractor has the settings {extractor.settings.to_json()}, the map '
                f'requires {settings.to_json()}'
            )
        return extractor

    def set_value_range(self, value_range: tuple[int, int] | None) -> None:
        """Set the values of 16 bits that become 0 and 255, by the first images, and log them."""
        if value_range is not None:
            logging.getLogger(__name__).warning(
                'images of 16 bits: their values %d to %d become 0 to 255, on this map and in its '
                'queries',
                *value_range,
            )
        self.settings = dataclasses.replace(self.settings, value_range=value_range)
        self.is_new = False

    def needed_size(self, thumbnail_width: int) -> tuple[int, int] | None:
        """Return the rows and columns of an image that have an effect; None = all."""
        backbone = self.settings.backbone
        if getattr(backbone, 'resize', '') != 'area':  # bilinear features are of single pixels
            return None
        return backbone.size, max(backbone.size, thumbnail_width)

    def extract(self, images: Sequence[np.ndarray]) -> LocalFeatures:
        """
        Extract the local features of images.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: local features of shape (W, len(images), d).
        :raises ImageError: the features are not finite.
        :raises InputError: other images, or one that is not in a list.
        """
        if getattr(images, 'ndim', 1) in (0, 2, 3) or not isinstance(images, Iterable):
            raise InputError(
                f'images is one {type(images).__name__}: expected a list, extract([image])'
            )
        images = [rgb_image(image, f'image {i}') for i, image in enumerate(images)]
        strips, cells = self._cut(self._backbone.feature_maps(images))
        if not np.isfinite(strips).all():
            raise ImageError(
                'the features of an image are not finite: the network or its input is out of '
                'range',
                kind='features',
            )
        if self.projection is not None:
            strips, cells = self.projection.apply(strips), None
        return LocalFeatures(*normalize(strips), self.settings, cells)

    def _cut(self, maps: np.ndarray) -> tuple[np.ndarray, tuple[int, int] | None]:
        """Return strips (W, n, d), not normalized, and the cells of each."""
        W, pooling = self.settings.strips, getattr(self._backbone.settings, 'pooling', 'flatten')
        if maps.ndim == 2:
            if W != 1 or pooling != 'flatten':
                raise SettingsError(
                    f'features {self.settings.kind} are one vector of {maps.shape[1]} numbers an '
                    f'image: expected W = 1 strip and pooling flatten, not {W} and {pooling}; '
                    'leave both out (--strips)'
                )
            return np.asarray(maps, np.float32)[None], (1, 1)
        strips = cut_strips(maps, W, pooling)
        return strips, (maps.shape[2], maps.shape[3] // W) if pooling == 'flatten' else (1, 1)


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


def cut_strips(feature_maps: np.ndarray, W: int, pooling: str = 'flatten') -> np.ndarray:
    """
    Cut feature maps into W vertical strips and flatten each (section 1 of the method), or pool it.

    Of the r = Wf mod W surplus columns, floor(r / 2) are dropped on the left, the others on the
    right; every strip is floor(Wf / W) columns wide.

    :param feature_maps: shape (n, C, H, Wf).
    :param pooling: ``flatten``; or over the cells of a strip ``mean``, or ``gem``, the generalized
        mean with exponent 3 (Radenovic et al., "Fine-tuning CNN image retrieval with no human
        annotation", PAMI 2019), where values below 1e-6 count as that.
    :returns: local features, shape (W, n, d), float32, not normalized; d is C * H * floor(Wf / W),
        or C if they are pooled.
    :raises InputError: fewer columns than strips, or not four axes.
    """
    n, channels, height, Wf = require_shape('feature maps', feature_maps, 'n C H Wf')
    if not 1 <= W <= Wf:
        raise InputError(
            f'feature maps are Wf = {Wf} columns wide: they cannot be cut into W = {W} strips: '
            'take fewer (--strips)'
        )
    width = Wf // W
    margin = (Wf % W) // 2
    maps = np.asarray(feature_maps[..., margin : margin + W * width], np.float32)
    strips = maps.reshape(n, channels, height, W, width).transpose(3, 0, 1, 2, 4)
    if pooling == 'flatten':
        return strips.reshape(W, n, channels * height * width)
    cells = strips.reshape(W, n, channels, height * width)
    return (
        cells.mean(3)
        if pooling == 'mean'
        else np.cbrt((np.maximum(cells, 1e-6) ** GEM_EXPONENT).mean(3))
    )


def normalize(strips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Split strips into directions and shares of the image's norm.

    :param strips: shape (W, n, d), float32.
    :returns: unit-norm strips (W, n, d), a zero strip stays zero (distance 1 to everything), and
        weights (W, n): norm of the strip / norm of all strips of its image, 0 for a black image.
    """
    norms = np.linalg.norm(strips, axis=2)
    whole = np.linalg.norm(norms, axis=0)
    unit = strips / np.where(norms > 0, norms, np.float32(1))[:, :, None]
    return unit, norms / np.where(whole > 0, whole, np.float32(1))
