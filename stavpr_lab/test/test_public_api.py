# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The public API is that of the stored list: a change of a promised name is visible in review."""

import difflib

from public_api import COMMAND, FILE, public_api


def test_public_api_is_that_of_the_stored_list():
    stored = FILE.read_text(encoding='utf-8').splitlines()
    changes = [*difflib.unified_diff(stored, public_api().splitlines(), n=0, lineterm='')]
    assert not changes, '\n'.join([f'write the changed list by {COMMAND}:', *changes])
