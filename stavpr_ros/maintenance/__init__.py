# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is done to maps by recognition on them; it uses the method, and is no part of it.

Places of several sessions, or of the end and the start of a closed route, that show the same
(:mod:`.same_places`), maps that drives update (:mod:`.upkeep`, :mod:`.same_drive`), places at
which the camera was at rest (:mod:`.near_duplicates`), and a threshold of mode paper to start with
(:mod:`.threshold`).
"""
