# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy of this repository."""

from pathlib import Path
from xml.etree import ElementTree

POLICY = Path(__file__).parents[2] / 'config' / 'sros2_policy.xml'


def names_of(node: str) -> dict[str, set[str]]:
    """Return the names in the profile of a node, by right: publish, subscribe, reply ..."""
    (profile,) = ElementTree.parse(POLICY).findall(f'.//profile[@node="{node}"]')
    names: dict[str, set[str]] = {}
    for group in profile:
        (right,) = group.attrib
        texts = {rule.text.replace('~', f'/{node}') for rule in group if rule.text}
        names[right] = names.get(right, set()) | texts
    return names
