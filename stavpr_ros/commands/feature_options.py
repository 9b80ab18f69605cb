# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command-line options of the features, generated from each kind's settings."""

import argparse
import dataclasses
from typing import Any, TYPE_CHECKING

from stavpr_ros.devices import choose_device, DEVICES
from stavpr_ros.errors import SettingsError
from stavpr_ros.features.registry import KINDS, settings_class

if TYPE_CHECKING:
    from stavpr_ros.features import FeatureExtractor


def _boolean(text: str) -> bool:
    if text.lower() not in ('true', 'false'):
        raise argparse.ArgumentTypeError(f'{text!r} must be true or false')
    return text.lower() == 'true'


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(','))


def _converter(example: Any) -> Any:
    if isinstance(example, bool):
        return _boolean
    return _numbers if isinstance(example, tuple) else type(example)


def add_feature_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--features``, the general options and ``--KIND-NAME`` for each setting of a kind."""
    group = parser.add_argument_group('features')
    group.add_argument(
        '--features',
        choices=list(KINDS),
        default='gradient',
        help='kind of features (%(default)s)',
    )
    group.add_argument(
        '--strips',
        type=int,
        default=7,
        metavar='W',
        help='vertical strips of an image (%(default)s)',
    )
    group.add_argument(
        '--projection',
        type=int,
        metavar='D',
        help='random projection of each strip to D dimensions (none)',
    )
    group.add_argument(
        '--seed', type=int, default=0, help='of the random projection (%(default)s)'
    )
    group.add_argument(
        '--device', default='auto', choices=DEVICES, help='where features are computed'
    )
    for kind in KINDS:
        group = parser.add_argument_group(f'features {kind}')
        for row in dataclasses.fields(settings_class(kind)):
            required = row.default is dataclasses.MISSING
            example = '' if required else row.default
            default = 'required' if required else str(example).strip('()') or 'none'
            group.add_argument(
                f'--{kind}-{row.name.replace("_", "-")}',
                type=_converter(example),
                metavar=row.name.upper(),
                help=f'{row.metadata["help"]} ({default})'.replace('%', '%%'),
            )


def make_extractor(arguments: argparse.Namespace) -> 'FeatureExtractor':
    """
    Return the extractor of the parsed options.

    :raises SettingsError: an option is missing, out of range or of another kind.
    """
    from stavpr_ros.features import FeatureExtractor

    return FeatureExtractor(
        arguments.features,
        _backbone_settings(arguments),
        arguments.strips,
        arguments.projection,
        arguments.seed,
        choose_device(arguments.device),
    )


def kind_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values of the options ``--KIND-NAME``, by option; None = not given."""
    rows = [(kind, row.name) for kind in KINDS for row in dataclasses.fields(settings_class(kind))]
    return {
        f'--{kind}-{name.replace("_", "-")}': getattr(arguments, f'{kind}_{name}')
        for kind, name in rows
    }


def _backbone_settings(arguments: argparse.Namespace) -> Any:
    """
    Return the settings of the chosen kind from the parsed options.

    :raises SettingsError: an option of this kind is missing, or one of another kind was given.
    """
    given: dict[str, dict[str, Any]] = {kind: {} for kind in KINDS}
    for kind, values in given.items():
        for row in dataclasses.fields(settings_class(kind)):
            value = getattr(arguments, f'{kind}_{row.name}')
            if value is not None:
                values[row.name] = value
    for kind, values in given.items():
        if values and kind != arguments.features:
            name = f'--{kind}-' + next(iter(values)).replace('_', '-')
            raise SettingsError(
                f'{name} was given with --features {arguments.features}: give --features {kind}'
            )
    chosen = settings_class(arguments.features)
    missing = [
        f'--{arguments.features}-{row.name.replace("_", "-")}'
        for row in dataclasses.fields(chosen)
        if row.default is dataclasses.MISSING and row.name not in given[arguments.features]
    ]
    if missing:
        raise SettingsError(f'--features {arguments.features} needs {" and ".join(missing)}')
    return chosen(**given[arguments.features])
