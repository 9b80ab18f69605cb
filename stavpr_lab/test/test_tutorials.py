# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tutorials: their blocks ``sh`` and ``python`` run, one page after the other, as written."""

import os
from pathlib import Path
import re
import subprocess

from fixtures import route_images
from processes import environment
import pytest
from videos import write_video

FOLDER = Path(__file__).resolve().parents[2] / 'docs/tutorials'
PAGES = ('first_map', 'first_robot', 'tune', 'debug')  # in the order of the README
SECONDS = 900
IMAGES = 100  # of each video


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the files that the tutorials begin with."""
    images = route_images(IMAGES)
    write_video(tmp_path / 'monday.mp4', images, rate=5)
    write_video(tmp_path / 'tuesday.mp4', [image // 4 * 3 for image in images], rate=5)
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize('pages', [PAGES, ('public_data',)], ids='-'.join)
def test_blocks_of_tutorials_run_in_order_in_one_folder(pages, folder, request):
    if pages != PAGES:
        (folder / 'VPR-Bench/datasets').mkdir(parents=True)
        data = request.getfixturevalue('data_folder') / 'corridor'
        (folder / 'VPR-Bench/datasets/corridor').symlink_to(data)
    text = ''.join((FOLDER / f'{page}.md').read_text() for page in pages)
    blocks = re.findall(r'^```(sh|python)\n(.*?)^```$', text, re.M | re.S)
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
    recordings = [*folder.glob('*.jsonl')]
    assert len(recordings) == (2 if pages == PAGES else 0)
    assert {len(file.read_text().splitlines()) for file in recordings} <= {IMAGES}


def test_webcam_page_opens_the_newest_recording(tmp_path):
    text = (FOLDER / 'webcam.md').read_text()
    recording = re.search(r'save_path:=(\S+)', text)[1]
    expression = re.search(r'map_path:=(.*)', text)[1]
    for age, name in ((20, 'route.stavpr'), (10, 'route-2.stavpr')):
        path = tmp_path / name
        path.touch()
        os.utime(path, (1e9 - age, 1e9 - age))
        echo = ['bash', '-c', f'echo {recording} {expression}']
        first, newest = subprocess.check_output(echo, cwd=tmp_path, text=True).split()
        assert (first, newest) == (str(tmp_path / 'route.stavpr'), str(path))
