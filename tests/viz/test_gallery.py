"""The page with a gallery, in a real browser where there is one."""

from __future__ import annotations

import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

from r3dpa.geometry import LidarSensor
from r3dpa.viz import PageScan, Tile, range_image_picture, scan_page

BROWSER = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
# Clicks the second tile, drags over the cloud, changes the colour, and says what has changed.
SCRIPT = """
<script>
const errors = [];
addEventListener("error", (event) => errors.push(event.message));
addEventListener("unhandledrejection", (event) => errors.push(String(event.reason)));
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const pixels = () => document.querySelector(".pane canvas.points").toDataURL();
const changed = async (before) => {
  for (let i = 0; i < 100 && pixels() === before; i++) await wait(50);
  return pixels() !== before;
};
(async () => {
  while (!document.documentElement.dataset.ready) await wait(20);
  await wait(500);
  const report = {};
  let shown = pixels();
  document.querySelectorAll("#film button")[1].click();
  report.scan = await changed(shown) && document.querySelector(".caption b").textContent;
  const pane = document.querySelector(".pane");
  pane.setPointerCapture = () => {};
  const at = (type, x) => pane.dispatchEvent(new PointerEvent(type,
    { pointerId: 1, clientX: x, clientY: 300, buttons: 1, bubbles: true, isPrimary: true }));
  shown = pixels();
  at("pointerdown", 700); at("pointermove", 800); at("pointerup", 800);
  report.turned = await changed(shown);
  await wait(500);
  shown = pixels();
  const mode = document.getElementById("mode");
  mode.value = "range";
  mode.dispatchEvent(new Event("change"));
  report.coloured = await changed(shown) && document.querySelector("#legend h2").textContent;
  const images = [...document.images];
  report.pictures = images.every((one) => one.naturalWidth > 0) && images.length;
  report.errors = errors;
  document.documentElement.dataset.report = JSON.stringify(report);
})();
</script>
</body>"""


@pytest.fixture(scope="module")
def page():
    generator = np.random.default_rng(0)
    sensor = LidarSensor(beams=8, columns=64)
    scans, tiles = [], []
    for number in range(3):
        points = generator.uniform(-20, 20, (400, 3)).astype(np.float32)
        scans.append(PageScan(f"seed {number}", points))
        strip = range_image_picture(torch.from_numpy(generator.uniform(2, 50, (8, 64))), sensor)
        tiles.append(Tile(number, f"note <{number}>", {"scene": strip, "nearest": strip}))
    return scan_page(scans, "Gallery", {}, {}, gallery={"Seeds": tiles}, about=["in order"])


def test_tiles_are_in_the_page_in_order(page):
    assert page.count("data:image/png;base64,") == 6
    assert [int(n) for n in re.findall(r'"scan":(\d)', page)] == [0, 1, 2]
    assert "<2>" not in page  # a note cannot end the script


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_a_browser_turns_and_colours_a_cloud_without_errors(page, tmp_path):
    file = tmp_path / "page.html"
    file.write_text(page.replace("</body>", SCRIPT))
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--window-size=1200,700")
    command = [
        BROWSER,
        *options,
        f"--user-data-dir={tmp_path / 'profile'}",
        "--enable-logging=stderr",
    ]
    command += ["--virtual-time-budget=20000", "--dump-dom", file.as_uri()]
    found = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "CONSOLE" not in found.stderr, found.stderr
    report = re.search(r'data-report="(.*?)"', found.stdout)
    assert report is not None, found.stdout[-2000:]
    text = report[1].replace("&quot;", '"')
    expected = '{"scan":"seed 1","turned":true,"coloured":"range (m)","pictures":6,"errors":[]}'
    assert text == expected
