"""The page of the report: its text, style and script; ``@@NAME@@`` is filled in."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>@@TITLE@@</title><style>@@STYLE@@</style></head><body><main>
<header><p class="kicker">stavpr_ros evaluation</p><h1>@@TITLE@@</h1><p class="lead">@@LEAD@@</p></header>
<section class="cards">@@CARDS@@</section>
<section class="two">
<figure><h2>Precision over recall</h2>@@CURVES@@<figcaption>
<span class="key" style="--c:@@SEQUENCE@@">sequences</span>
<span class="key" style="--c:@@SINGLE@@">single images</span> The ring is the threshold with the best F1.
<span id="pr-text"></span></figcaption></figure>
<figure><h2>How sure the answers are</h2>@@SCORES@@<figcaption>@@SCORE_KEYS@@
What lies left of the line is accepted.</figcaption></figure>
</section>
<section><h2>Every image against every place</h2>
<p class="quiet">Places of the map run to the right, query images down; dark is near. Yellow is the truth;
dots are answers that are accepted at the threshold of the best F1:
<span class="key" style="--c:@@RIGHT@@">right</span> <span class="key" style="--c:@@WRONG@@">wrong</span>
Click into it to look at that image below.</p>@@MATRIX@@</section>
<section><h2>Image by image</h2>
<p class="quiet">Drag, or use the arrow keys. The line is the warping path of the window around the image.</p>
<div class="explore"><div class="pictures"><figure><img id="query" alt=""><figcaption>query image
<b id="query-name"></b></figcaption></figure><figure><img id="answer" alt=""><figcaption>answer: place
<b id="answer-name"></b></figcaption></figure><figure id="truth-box">
<img id="truth" alt=""><figcaption>true place <b id="truth-name"></b></figcaption></figure></div>
<div><canvas id="window" width="720" height="340"></canvas><p class="quiet" id="window-text"></p></div></div>
<input id="slider" type="range" min="0" value="0" aria-label="query image"></section>
<section><h2>The worst mistakes</h2><p class="quiet">@@MISTAKES_TEXT@@</p>
<div class="mistakes">@@MISTAKES@@</div></section>
<section><h2>All numbers</h2><div class="scroll"><table>@@TABLE@@</table></div>
<details><summary>What they mean</summary>@@GLOSSARY@@</details></section>
<section class="two"><div><h2>Settings</h2><table class="plain">@@SETTINGS@@</table></div>
<div><h2>Times</h2><table class="plain">@@TIMES@@</table></div></section>
</main><script type="application/json" id="data">@@DATA@@</script><script>@@SCRIPT@@</script></body></html>
"""

GLOSSARY = """<dl>
<dt>accepted</dt><dd>The answer's distance is below the threshold.</dd>
<dt>F1</dt><dd>2 TP / (2 TP + FP + FN) at the threshold where it is best: TP accepted and right, FP accepted
and wrong, FN rejected although the place is in the map.</dd>
<dt>average precision</dt><dd>Area under scikit-learn's precision-recall curve of all answers.</dd>
<dt>recall@k</dt><dd>Share of the queries with a place in the map that have a right one among the k nearest.
The first and last images of a drive, which have no window centered on them, have one answer only.</dd>
<dt>recall at 100 % precision</dt><dd>The largest recall (TP / (TP + FN)) before the first wrong answer is
accepted.</dd>
<dt>without the ends</dt><dd>Only images that have a window centered on them.</dd>
<dt>false alarms</dt><dd>Share of images of places that are not in the map that are accepted all the same, at
the threshold of the best F1.</dd>
<dt>scikit-learn's F1</dt><dd>Counts only right answers that are rejected as misses; given for comparison with
other programs.</dd></dl>"""

STYLE = """
:root{--ink:#22262c;--quiet:#69707b;--line:#e3e3de;--paper:#fbfbf9;--card:#fff;--blue:#2358a5}
*{box-sizing:border-box}body{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.55 system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif}
main{max-width:1120px;margin:0 auto;padding:40px 28px 80px}
.kicker{margin:0;color:var(--blue);font-size:13px;font-weight:600;letter-spacing:.08em;text-transform:uppercase}
h1{margin:.1em 0 .35em;font-size:34px;line-height:1.15;letter-spacing:-.015em;overflow-wrap:anywhere}
h2{margin:0 0 .5em;font-size:19px;letter-spacing:-.005em}.lead{max-width:46em;margin:0;
font-size:18px;color:#3b414a}
section{margin-top:44px}.quiet,figcaption{color:var(--quiet);font-size:14px;margin:.4em 0 1em}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(170px,1fr));gap:14px;margin-top:30px}
.card{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:16px 18px}
.card b{display:block;font-size:34px;line-height:1.2;font-weight:650;font-variant-numeric:tabular-nums}
.card span{color:var(--quiet);font-size:14px}.card i{display:block;height:5px;margin-top:10px;
border-radius:3px;background:linear-gradient(90deg,var(--c,var(--blue)) var(--v),var(--line) 0)}
.two{display:grid;grid-template-columns:repeat(auto-fit,minmax(420px,1fr));gap:28px}
figure{margin:0}svg{display:block;width:100%;height:auto}svg text{font-size:12px;fill:var(--quiet)}
.axis{fill:none;stroke:#9aa0a8}.grid{stroke:var(--line)}.curve{fill:none;stroke-width:2.2;stroke-linejoin:round}
.best{fill:#fff;stroke-width:2.4}.threshold{stroke:var(--ink);stroke-width:1.3;stroke-dasharray:5 3}
.key{white-space:nowrap;margin-right:.6em}.key::before{content:'';display:inline-block;width:10px;height:10px;
margin-right:5px;border-radius:50%;background:var(--c)}
#matrix{border-radius:8px;cursor:crosshair}.cursor{stroke:#4fb3ff;stroke-width:1.6;fill:none;
pointer-events:none}
.explore{display:grid;grid-template-columns:minmax(230px,300px) 1fr;gap:24px;align-items:start}
.pictures{display:grid;gap:10px}.pictures figure,.mistakes figure{background:var(--card);
border:1px solid var(--line);border-radius:10px;overflow:hidden}
.pictures img,.mistakes img{display:block;width:100%;aspect-ratio:16/9;
object-fit:cover;background:#ecece8}.pictures figcaption{margin:0;padding:5px 10px}
.pictures figure.right{border-color:#2e8b57;box-shadow:0 0 0 2px #2e8b57}
.pictures figure.wrong{border-color:#c8402f;box-shadow:0 0 0 2px #c8402f}
canvas{width:100%;border-radius:8px;background:#fff;border:1px solid var(--line)}
input[type=range]{width:100%;margin-top:12px;accent-color:var(--blue)}
.mistakes{display:grid;grid-template-columns:repeat(auto-fill,minmax(480px,1fr));gap:16px}
.mistakes div{display:grid;grid-template-columns:1fr 1fr 1fr;gap:2px}.mistakes div span{position:relative}
.mistakes em{position:absolute;left:6px;bottom:6px;padding:1px 7px;border-radius:9px;background:#000a;
color:#fff;font-size:12px;font-style:normal}.mistakes figcaption{margin:0;padding:7px 12px}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:15px}
th,td{padding:6px 12px;border-bottom:1px solid var(--line);text-align:right}
th:first-child,td:first-child{text-align:left}
thead th{color:var(--quiet);font-weight:600;font-size:13px}.plain td{text-align:left;overflow-wrap:anywhere}
.plain td:first-child{color:var(--quiet);white-space:nowrap;padding-left:0}.scroll{overflow-x:auto}
details{margin-top:14px;color:#3b414a}summary{cursor:pointer;color:var(--blue)}dt{font-weight:600;margin-top:.6em}
dd{margin:0 0 0 1.2em}
@media(max-width:760px){.explore,.two{grid-template-columns:1fr}.mistakes{grid-template-columns:1fr}h1{font-size:27px}}
@media print{.explore,#slider{break-inside:avoid}}
"""

SCRIPT = """
'use strict';
const data = JSON.parse(document.getElementById('data').textContent), $ = id => document.getElementById(id);
const NEAR = [13, 20, 38], FAR = [240, 241, 236];
function shade(v) { return 'rgb(' + NEAR.map((n, i) => Math.round(n + (FAR[i] - n) * v)).join(',') + ')'; }
function decode(text) { return Uint8Array.from(atob(text), c => c.charCodeAt(0)); }
function picture(img, url) { if (url) { img.src = url; } else { img.removeAttribute('src'); } }

const views = data.views, slider = $('slider');
function draw(view) {
  const canvas = $('window'), g = canvas.getContext('2d'), cells = decode(view.cells);
  const rows = view.rows, columns = view.columns, left = 46, top = 10, bottom = 34;
  const w = (canvas.width - left - 10) / columns, h = (canvas.height - top - bottom) / rows;
  g.clearRect(0, 0, canvas.width, canvas.height);
  for (let r = 0; r < rows; r++) for (let c = 0; c < columns; c++) {
    const v = cells[r * columns + c];
    g.fillStyle = v === 255 ? '#fff' : shade(v / 254);
    g.fillRect(left + c * w, top + r * h, w + .6, h + .6);
  }
  g.fillStyle = 'rgba(240,196,25,.42)';
  for (const [r, a, b] of view.truth)
    g.fillRect(left + (a - view.first) * w, top + r * h, (b - a + 1) * w, h);
  g.beginPath(); g.lineWidth = 2.4; g.strokeStyle = view.right ? '#35d07f' : '#ff5440'; g.lineJoin = 'round';
  for (const [r, c] of view.path) g.lineTo(left + (c - view.first + .5) * w, top + (r + .5) * h);
  g.stroke();
  const middle = view.image - view.newest + rows - 1;
  g.strokeStyle = '#4fb3ff'; g.lineWidth = 1.5; g.strokeRect(left, top + middle * h, columns * w, h);
  g.fillStyle = '#69707b'; g.font = '13px system-ui, sans-serif'; g.textAlign = 'center';
  const step = [1, 2, 5, 10, 20, 50, 100, 200].find(s => s * w >= 44) || 500;
  for (let p = Math.ceil(view.first / step) * step; p < view.first + columns; p += step)
    g.fillText(p, left + (p - view.first + .5) * w, canvas.height - 17);
  g.fillText('place in the map', left + columns * w / 2, canvas.height - 2);
  g.textAlign = 'right';
  for (const r of [0, middle, rows - 1])
    g.fillText(view.newest - rows + 1 + r, left - 6, top + (r + .5) * h + 5);
}
function show(index) {
  const view = views[index];
  if (!view) return;
  slider.value = index;
  picture($('query'), data.queries[view.image]); picture($('answer'), data.places[view.answer]);
  picture($('truth'), data.places[view.true]);
  $('query-name').textContent = view.image; $('answer-name').textContent = view.answer;
  $('truth-name').textContent = view.true < 0 ? 'not in the map' : view.true;
  $('truth-box').hidden = view.right; $('answer').parentNode.className = view.right ? 'right' : 'wrong';
  $('window-text').textContent = 'Images ' + (view.newest - view.rows + 1) + ' to ' + view.newest
    + ': distance ' + (view.score === null ? 'none' : view.score.toFixed(4))
    + ', ' + (view.accepted ? 'accepted' : 'rejected')
    + ' at the best threshold, ' + (view.right ? 'right' : 'wrong')
    + '. The nearest place to the image alone is ' + view.single + '.';
  draw(view);
  const m = $('matrix'), y = (view.image + .5) * m.viewBox.baseVal.height / m.dataset.images;
  $('cursor').setAttribute('d', 'M0 ' + y + 'H1000');
}
function nearest(image) {
  let best = 0;
  views.forEach((v, i) => { if (Math.abs(v.image - image) < Math.abs(views[best].image - image)) best = i; });
  return best;
}
if (views.length) {
  slider.max = views.length - 1;
  slider.addEventListener('input', () => show(+slider.value));
  document.addEventListener('keydown', event => {
    const step = {ArrowLeft: -1, ArrowRight: 1}[event.key];
    if (step && event.target !== slider) show(Math.min(views.length - 1, Math.max(0, +slider.value + step)));
  });
  $('matrix').addEventListener('click', event => {
    const box = $('matrix').getBoundingClientRect();
    show(nearest((event.clientY - box.top) / box.height * $('matrix').dataset.images));
  });
  show(nearest(data.start));
}
const pr = $('pr');
pr.addEventListener('mousemove', event => {
  const box = pr.getBoundingClientRect(), x = (event.clientX - box.left) * 440 / box.width;
  const y = (event.clientY - box.top) * 360 / box.height;
  let best = null, distance = 1e9;
  for (const [name, points] of Object.entries(data.curves)) for (const [t, p, r] of points) {
    const dx = 46 + r * 374 - x, dy = 14 + (1 - p) * 300 - y, d = dx * dx + dy * dy;
    if (d < distance) { distance = d; best = [name, t, p, r]; }
  }
  if (!best) return;
  const dot = $('pr-dot');
  dot.setAttribute('cx', 46 + best[3] * 374); dot.setAttribute('cy', 14 + (1 - best[2]) * 300);
  dot.setAttribute('visibility', 'visible');
  $('pr-text').textContent = best[0] + ' below ' + best[1].toPrecision(4) + ': precision '
    + best[2].toFixed(3) + ', recall ' + best[3].toFixed(3);
});
"""
