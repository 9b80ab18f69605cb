# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a report in Chromium, as wide as a phone and as a desk; screenshots stay."""

import shutil
import subprocess

import cv2
from evaluation_commands import write_images
from fixtures import route_images
import pytest
from stavpr_lab.commands import evaluate

CHROMIUM = shutil.which('chromium')
CLICKS = """<script>
document.querySelectorAll('.pair').forEach((card, i) => {
  for (let n = 0; n < i % 3; n++) card.click();
});
const marked = document.getElementById('marks').textContent;
document.title = Math.max(0, document.documentElement.scrollWidth - innerWidth) + ' ' + marked;
</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason='Chromium is not installed')
def test_report_fits_a_phone_and_marks_pairs_by_clicks(tmp_path):
    images = route_images(40)
    write_images(tmp_path / 'map', images)
    write_images(tmp_path / 'query', [image // 2 for image in images])
    options = [f'--{name}={tmp_path / name}' for name in ('map', 'query')]
    assert evaluate.main([*options, '--output', str(tmp_path)]) == 0
    page = tmp_path / 'clicked.html'
    page.write_text((tmp_path / 'report.html').read_text() + CLICKS)
    for width in (1400, 390):
        shot, size = tmp_path / f'{width}.png', f'--window-size={width},2400'
        browser = [CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu', size]
        run = [*browser, f'--screenshot={shot}', page.as_uri()]
        subprocess.run(run, check=True, capture_output=True, timeout=100)
        assert cv2.imread(str(shot)).std() > 10
        print(f'screenshot: {shot}')
    text = subprocess.check_output([*browser, '--dump-dom', page.as_uri()], text=True, timeout=100)
    assert '<title>0 16 of 24 pairs are marked</title>' in text  # 0 pixels are cut off
