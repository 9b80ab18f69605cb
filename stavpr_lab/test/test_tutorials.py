# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tutorials: their blocks ``sh`` and ``python`` run, one after the other, as written."""

from pathlib import Path
import re
import subprocess

from fixtures import route_images
from processes import environment
import pytest
from videos import write_video

TUTORIALS = sorted((Path(__file__).resolve().parents[2] / 'docs/tutorials').glob('*.md'))
SECONDS = 300


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the files that the tutorials begin with."""
    images = route_images(100)
    write_video(tmp_path / 'monday.mp4', images, rate=5)
    write_video(tmp_path / 'tuesday.mp4', [image // 4 * 3 for image in images], rate=5)
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize('page', TUTORIALS, ids=lambda page: page.stem)
def test_blocks_of_tutorial_run(page, folder, request):
    blocks = re.findall(r'^```(sh|python)\n(.*?)^```$', page.read_text(), re.M | re.S)
    assert blocks
    if page.stem == 'public_data':
        (folder / 'VPR-Bench/datasets').mkdir(parents=True)
        data = request.getfixturevalue('data_folder') / 'corridor'
        (folder / 'VPR-Bench/datasets/corridor').symlink_to(data)
    shell = '\n'.join(
        code if kind == 'sh' else f'python3 - <<"PY"\n{code}PY' for kind, code in blocks
    )
    done = subprocess.run(
        ['bash', '-e', '-c', shell],
        cwd=folder,
        env=environment(),
        timeout=SECONDS,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
