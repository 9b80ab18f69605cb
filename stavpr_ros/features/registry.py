"""What a kind of features must offer, and the table of the kinds there are."""

import dataclasses
import importlib
import json
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch

from stavpr_ros.errors import SettingsError

# One row a kind: its name and the class that makes it. Its settings, a frozen dataclass, give the
# command-line options and what a map remembers; see `setting` below.
KINDS = {
    'gradient': 'stavpr_ros.features.gradient:Gradient',
    'onnx': 'stavpr_ros.features.onnx:Onnx',
    'torchscript': 'stavpr_ros.features.torchscript:TorchScript',
    'densenet161_places365': 'stavpr_ros.features.densenet:DenseNet161Places365',
    'vgg16': 'stavpr_ros.features.vgg:VGG16Pool4',
}


class Backbone(Protocol):
    """
    Images to feature maps.

    A class with this shape has an attribute ``Settings``, the frozen dataclass of its settings, and is
    called with an instance of it and the device (``cpu``, ``cuda``).
    """

    settings: Any

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """Turn RGB images, each (h, w, 3) uint8 of any size, into feature maps (n, C, H, Wf), float."""
        ...


def setting(default: Any = dataclasses.MISSING, *, help: str, identity: bool = True) -> Any:
    """
    Declare a field of a backbone's settings.

    :param help: one sentence for ``--help``.
    :param identity: False for what does not change the features (where a file lies).
    """
    return dataclasses.field(default=default, metadata={'help': help}, compare=identity)


def backbone_class(kind: str) -> Any:
    """
    Return the class of a kind of features, importing its module now.

    :raises SettingsError: no such kind.
    """
    if kind not in KINDS:
        raise SettingsError(f'features {kind!r} are unknown: take one of {", ".join(KINDS)}')
    module, name = KINDS[kind].split(':')
    return getattr(importlib.import_module(module), name)


def settings_class(kind: str) -> Any:
    """Return the frozen dataclass of a kind's settings."""
    return backbone_class(kind).Settings


def settings_from_json(kind: str, text: str, model: str = '') -> Any:
    """
    Read a kind's settings from a JSON object; what it does not name is the default.

    :param model: the network's file, for kinds that have one; '' = what the object says.
    :raises SettingsError: no such kind, no such setting, one that is missing, or no JSON object.
    """
    cls = settings_class(kind)
    try:
        values = json.loads(text)
        if not isinstance(values, dict):
            raise TypeError('expected an object, {"name": value}')
        if model and 'model' in {field.name for field in dataclasses.fields(cls)}:
            values['model'] = model
        return cls(**values)
    except (ValueError, TypeError) as error:
        names = ', '.join(field.name for field in dataclasses.fields(cls))
        raise SettingsError(
            f'settings {text!r} of features {kind} do not do ({error}): expected a JSON object with {names}'
        ) from error
