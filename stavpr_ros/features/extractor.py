"""Images to local features: backbone, strips, projection; and the record of how they were made."""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from stavpr_ros.errors import FeatureMismatchError, ImageError, SettingsError
from stavpr_ros.features.projection import Projection
from stavpr_ros.features.registry import backbone_class, settings_class
from stavpr_ros.features.strips import cut_strips, normalize


@dataclass(frozen=True)
class FeatureSettings:
    """
    Everything that decides what the features of an image are; equal settings give comparable features.

    :param kind: row of the table of kinds, such as ``gradient``.
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
        """Return the settings as one line of JSON."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> 'FeatureSettings':
        """
        Read what :meth:`to_json` wrote.

        :raises SettingsError: no such kind, or settings that it does not have.
        """
        try:
            fields = json.loads(text)
            fields['backbone'] = settings_class(fields['kind'])(**fields['backbone'])
            return cls(**fields)
        except (ValueError, TypeError, KeyError) as error:
            raise SettingsError(f'feature settings cannot be read ({error}): {text[:200]}') from error


@dataclass(frozen=True)
class LocalFeatures:
    """
    The local features of n images, strip-major.

    :param strips: unit-norm features, shape (W, n, d), float32, a zero feature all zeros.
    :param weights: norm of each strip over the norm of its image's strips, shape (W, n), float32.
    :param settings: how they were made.
    :param cells: rows H and columns of a strip's cells: strips are (channels, H, columns), flattened; None
        where that is not known, or no more so (random projection).
    """

    strips: torch.Tensor
    weights: torch.Tensor
    settings: FeatureSettings
    cells: tuple[int, int] | None = None

    def __len__(self) -> int:
        return self.strips.shape[1]

    @property
    def dimension(self) -> int:
        """Number d of dimensions of a strip."""
        return self.strips.shape[2]

    def __getitem__(self, images: slice) -> 'LocalFeatures':
        return dataclasses.replace(self, strips=self.strips[:, images], weights=self.weights[:, images])

    def to(self, device: str | torch.device) -> 'LocalFeatures':
        """Return the features on a device."""
        return dataclasses.replace(self, strips=self.strips.to(device), weights=self.weights.to(device))

    def require_same_settings(self, other: FeatureSettings, where: str) -> None:
        """
        Refuse features that were made otherwise.

        :raises FeatureMismatchError: names both settings.
        """
        if self.settings != other:
            raise FeatureMismatchError(
                f'query features were made with {self.settings.to_json()}, those of {where} with '
                f'{other.to_json()}: describe the query with the settings of the map'
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

    :param kind: ``gradient`` or ``onnx``.
    :param backbone: settings of that kind; None for its defaults.
    :param strips: number of vertical strips W.
    :param projection: the number of dimensions to project to (a new seeded Gaussian matrix), a
        :class:`Projection`, or None.
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
        self._backbone = backbone_class(kind)(backbone, device)
        self._projection: Projection | None = None
        plain = FeatureSettings(kind, self._backbone.settings, strips)
        self.settings = plain
        if isinstance(projection, int):
            dimension = self.extract([np.zeros((64, 64, 3), np.uint8)]).strips.shape[2]
            projection = Projection.gaussian(dimension, projection, seed)
        if projection is not None:
            self._projection = projection
            self.settings = dataclasses.replace(plain, projection=projection.identity)

    @classmethod
    def from_settings(
        cls, settings: FeatureSettings, projection: Projection | None, device: str = 'cpu', **changes: Any
    ) -> 'FeatureExtractor':
        """
        Make the extractor that a map's features were made with.

        :param changes: settings of the backbone to replace, such as the place of a model file.
        :raises FeatureMismatchError: the projection, or what was changed, gives other features.
        """
        known = {field.name for field in dataclasses.fields(settings.backbone)}
        changes = {name: value for name, value in changes.items() if value and name in known}
        backbone = dataclasses.replace(settings.backbone, **changes)
        extractor = cls(settings.kind, backbone, settings.strips, projection, device=device)
        if extractor.settings != settings:
            raise FeatureMismatchError(
                f'this extractor makes {extractor.settings.to_json()}, the map asks for {settings.to_json()}'
            )
        return extractor

    @property
    def projection(self) -> Projection | None:
        """The random projection that is applied, if any."""
        return self._projection

    def extract(self, images: Sequence[np.ndarray]) -> LocalFeatures:
        """
        Describe images.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: local features of shape (W, len(images), d).
        :raises ImageError: the features are not finite.
        """
        maps = self._backbone.feature_maps(images)
        strips = cut_strips(maps, self.settings.strips)
        cells: tuple[int, int] | None = (maps.shape[2], maps.shape[3] // self.settings.strips)
        if not bool(torch.isfinite(strips).all()):
            raise ImageError(
                'the features of an image are not finite: the network or its input is out of range',
                kind='features',
            )
        if self._projection is not None:
            strips, cells = self._projection.apply(strips), None
        return LocalFeatures(*normalize(strips), self.settings, cells)
