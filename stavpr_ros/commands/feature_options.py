# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command-line options of the features, generated from each kind's settings."""

import argparse
import dataclasses
import sys
from typing import Any, TYPE_CHECKING

from stavpr_ros.commands.program import say
from stavpr_ros.devices import DEVICES
from stavpr_ros.errors import SettingsError
from stavpr_ros.features.registry import AUTO, default_of, kinds, settings_class
from stavpr_ros.parameters import default

if TYPE_CHECKING:
    from stavpr_ros.features import FeatureExtractor


def boolean(text: str) -> bool:
    """Convert ``true`` or ``false``."""
    if text.lower() not in ('true', 'false'):
        raise argparse.ArgumentTypeError(f'{text!r} must be true or false')
    return text.lower() == 'true'


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(','))


CONVERTERS = {bool: boolean, tuple: _numbers}


def add_feature_options(parser: argparse.ArgumentParser) -> None:
    """
    Add ``--features``, the general options and ``--KIND-NAME`` for each setting of a kind.

    The help of the latter is in ``--help-features``.
    """
    add = parser.add_argument_group('features').add_argument
    choices = (AUTO, *kinds())
    kind_help = f'kind of features: {", ".join(choices)} (%(default)s)'
    add('--features', choices=choices, default=default('features'), metavar='KIND', help=kind_help)
    strips = 'vertical strips of an image (7; 1 if the features are one vector)'
    add('--strips', type=int, metavar='W', help=strips)
    projection = 'reduce each strip to D dimensions by a random projection (none)'
    add('--projection', type=int, metavar='D', help=projection)
    add('--seed', type=int, default=0, help='seed of the random projection (%(default)s)')
    add('--device', default='auto', choices=DEVICES, help='where to compute features')
    hidden_parser = argparse.ArgumentParser(add_help=False, usage=argparse.SUPPRESS)
    for kind in kinds():
        group_of_kind = hidden_parser.add_argument_group(f'features {kind}')
        for row in dataclasses.fields(settings_class(kind)):
            example = default_of(row)
            required = example is dataclasses.MISSING
            example = '' if required else example
            default_text = 'required' if required else str(example).strip('()') or 'none'
            text = f'{row.metadata.get("help", "")} ({default_text})'.replace('%', '%%')
            for group, words in ((parser, argparse.SUPPRESS), (group_of_kind, text)):
                group.add_argument(
                    _option(kind, row.name),
                    type=CONVERTERS.get(type(example), type(example)),
                    metavar=row.name.upper(),
                    help=words,
                )
    more = 'show the options of each kind of features, such as networks, and exit'
    add('--help-features', action='version', version=hidden_parser.format_help(), help=more)


def make_extractor(arguments: argparse.Namespace) -> 'FeatureExtractor':
    """
    Return the extractor of the parsed options, where ``auto`` becomes a kind, which is printed.

    :raises SettingsError: an option is missing, out of range or of another kind.
    """
    from stavpr_ros.features import FeatureExtractor

    extractor = FeatureExtractor(
        arguments.features,
        _backbone_settings(arguments),
        arguments.strips,
        arguments.projection,
        arguments.seed,
        arguments.device,
    )
    if extractor.choice:
        say(extractor.choice, sys.stderr)
    arguments.features = extractor.settings.kind
    return extractor


def kind_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values of the options ``--KIND-NAME``, by option; None = not given."""
    return {
        _option(kind, row.name): getattr(arguments, f'{kind}_{row.name}')
        for kind in kinds()
        for row in dataclasses.fields(settings_class(kind))
    }


def _option(kind: str, name: str) -> str:
    return f'--{kind}-{name.replace("_", "-")}'


def _backbone_settings(arguments: argparse.Namespace) -> Any:
    """Return the settings of the chosen kind from the parsed options, None for ``auto``."""
    kind, values = arguments.features, {}
    for other in kinds():
        for row in dataclasses.fields(settings_class(other)):
            value = getattr(arguments, f'{other}_{row.name}')
            if value is not None and other != kind:
                raise SettingsError(
                    f'{_option(other, row.name)} was given with --features {kind}: give '
                    f'--features {other}'
                )
            if value is not None:
                values[row.name] = value
    if kind == AUTO:
        return None
    missing = [
        _option(kind, row.name)
        for row in dataclasses.fields(settings_class(kind))
        if default_of(row) is dataclasses.MISSING and row.name not in values
    ]
    if missing:
        raise SettingsError(f'--features {kind} needs {" and ".join(missing)}')
    return settings_class(kind)(**values)
