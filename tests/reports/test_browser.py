"""Reports in a browser: nothing overflows, nothing fails, what moves is drawn.

Chromium reads a copy of the page into which a few lines were put that measure it; what
they found is read back from the text of the page around it.
"""

import csv
import html
import io
import json
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from report_example import Run, a_film, full_run
from sim2gp import reports as report

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(BROWSER is None, reason="no chromium on the PATH"),
]

#: Before anything else on the page: whatever goes wrong is kept.
LISTEN = """<script>
window.wrong = [];
addEventListener("error", e => wrong.push(e.message || e.target.outerHTML), true);
addEventListener("unhandledrejection", e => wrong.push(String(e.reason)));
for (const name of ["error", "warn"]) {
  console[name] = (...words) => wrong.push(words.join(" "));
}
</script>"""
#: After everything: plays a little, then says what it sees.
MEASURE = """<script>
addEventListener("load", () => setTimeout(() => {
  const root = document.documentElement, wide = [];
  for (const node of document.body.querySelectorAll("*")) {
    const box = node.getBoundingClientRect();
    const hidden = node.closest(".scroll, .picture, svg") !== null;
    if (box.right > innerWidth + 1 && !hidden) wide.push(node.outerHTML.slice(0, 80));
  }
  const texts = [...document.querySelectorAll("p, li, td, dd, h1, h2, h3")].filter(
    node => node.offsetParent !== null);
  const player = document.querySelector(".player"), film = {};
  if (player) {
    const figure = player.querySelector("svg.stage");
    const scrub = player.querySelector("input"), look = player.querySelector(".look");
    const at = () => figure.querySelector(".bodies").innerHTML;
    const see = when => {
      scrub.value = when; scrub.dispatchEvent(new Event("input")); return at();
    };
    film.moves = see(0) !== see(scrub.max / 3);
    film.controls = !player.querySelector(".controls").hidden;
    film.said = player.querySelector(".said").textContent;
    film.look = !look.hidden;
    film.figure = getComputedStyle(figure).display !== "none";
    const canvas = player.querySelector("canvas");
    const there = node => node !== null && getComputedStyle(node).display !== "none";
    film.canvas = there(canvas);
    if (film.canvas) {
      const pixel = when => {
        see(when);
        const pen = canvas.getContext("2d");
        return [...pen.getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data];
      };
      film.pixels = [pixel(0), pixel(+scrub.max)];
      look.click();
      film.lines = there(figure) && !there(canvas);
    }
  }
  const copy = document.querySelector(".copy");
  parent.postMessage(JSON.stringify({
    csv: copy && copy.csv(), paper: getComputedStyle(document.body).backgroundColor,
    wrong, wide, film, inner: innerWidth, scroll: root.scrollWidth,
    title: document.title,
    sections: [...document.querySelectorAll("section")].map(node => node.id),
    smallest: Math.min(...texts.map(n => parseFloat(getComputedStyle(n).fontSize))),
    narrow: Math.min(...texts.map(n => n.getBoundingClientRect().width)),
    loaded: performance.getEntriesByType("resource").map(entry => entry.name).filter(
      name => !name.startsWith("data:")),
  }), "*");
}, 700));
</script>"""
#: A browser's window is never narrower than 500 pixels; a frame can be.
FRAME = """<body>
<iframe style="border:0" src="{page}" width="{width}" height="900"></iframe>
<script>
addEventListener("message", event => {{
  const said = document.createElement("script");
  said.type = "text/plain";
  said.id = "measured";
  said.textContent = event.data;
  document.body.append(said);
}});
</script>"""


def chromium(page: Path, width: int, *options: str) -> bytes:
    """What a headless browser makes of a page."""
    command = [
        str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu",
        "--hide-scrollbars", f"--user-data-dir={page.parent / 'browser'}",
        f"--window-size={width},900", "--virtual-time-budget=4000", *options,
        page.as_uri(),
    ]  # fmt: skip
    for _ in range(3):
        done = subprocess.run(command, capture_output=True, timeout=120, check=False)
        if done.returncode == 0:
            return done.stdout
        time.sleep(1.0)
    raise AssertionError(done.stderr.decode(errors="replace")[-2000:])


def measured(page: Path, width: int) -> dict[str, Any]:
    """What the page says of itself at a width in pixels."""
    text = page.read_text(encoding="utf-8")
    copy = page.with_name(f"measured_{width}.html")
    text = text.replace("<head>", "<head>" + LISTEN, 1)
    copy.write_text(text.replace("</body>", MEASURE + "</body>"), encoding="utf-8")
    outside = page.with_name(f"frame_{width}.html")
    outside.write_text(FRAME.format(page=copy.name, width=width), encoding="utf-8")
    dom = chromium(outside, width + 200, "--dump-dom").decode("utf-8")
    found = re.search(r'id="measured">(.*?)</script>', dom, re.DOTALL)
    assert found, dom[-2000:]
    answer: dict[str, Any] = json.loads(html.unescape(found[1]))
    return answer


def picture(page: Path, width: int, *options: str) -> np.ndarray:
    """The screenshot, which stays beside the page."""
    out = page.with_name(f"{page.stem}_{width}.png")
    chromium(
        page, width, f"--screenshot={out}", f"--window-size={width},4000", *options
    )
    with Image.open(io.BytesIO(out.read_bytes())) as image:
        return np.asarray(image.convert("RGB"))


def runs() -> dict[str, Run]:
    """One of everything that a report can show, and the film of a robot."""
    bare = {"command": "demo", "title": "An empty run"}
    summary, arrays = full_run()
    path = "/data/somebody/" + "recordings_of_the_arm/" * 5 + "a_very_long_name.parquet"
    warnings = [*summary["warnings"], f"W127 fewer episodes than announced in {path}"]
    everything = summary | {"warnings": warnings, "title": f"what {path} determines"}
    return {
        "everything": (everything, arrays), "figure": a_film(pictures=False),
        "rendered": a_film(), "empty": (bare, {}),
    }  # fmt: skip


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("reports")
    found = {}
    for name, run in runs().items():
        found[name] = folder / name / "report.html"
        found[name].parent.mkdir()
        found[name].write_text(report.write_report(*run), encoding="utf-8")
    return found


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("name", ["everything", "figure", "rendered", "empty"])
def test_a_report_is_readable_and_whole(
    pages: dict[str, Path], name: str, width: int
) -> None:
    answer = measured(pages[name], width)
    assert answer["inner"] == width
    assert answer["wrong"] == []
    assert answer["wide"] == []
    assert answer["scroll"] <= width
    assert answer["loaded"] == []
    assert answer["title"].startswith("sim2gp")
    assert answer["smallest"] >= 13.0  # pixels
    assert answer["narrow"] > 0.0
    text = pages[name].read_text(encoding="utf-8")
    assert answer["sections"] == re.findall('<section id="(.*?)"', text)
    if name == "empty":
        assert answer["film"] == {}
        return
    film = answer["film"]
    assert film["moves"]
    assert film["controls"]
    assert film["canvas"] is film["look"] is (name == "rendered")
    assert film["figure"] is not film["canvas"]
    if film["canvas"]:
        first, last = (np.asarray(pixel) for pixel in film["pixels"])
        np.testing.assert_allclose(first, [0, 200, 90, 255], atol=12)
        np.testing.assert_allclose(last, [180, 80, 90, 255], atol=12)
        assert film["lines"]


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("name", ["everything", "figure", "rendered"])
def test_a_screenshot_shows_the_machine(
    pages: dict[str, Path], name: str, width: int
) -> None:
    """Colours of the figure, or of the frames, cover some of the picture."""
    seen = picture(pages[name], width).astype(int)
    assert seen.shape[1] == width
    orange = np.abs(seen - [0xD5, 0x5E, 0x00]).sum(axis=-1) < 40
    frame = np.abs(seen[..., 2] - 90) + np.abs(seen[..., 0] + 1.5 * seen[..., 1] - 300)
    shown = (frame < 30) if name == "rendered" else orange
    assert shown.sum() > (20_000 if name == "rendered" else 200)
    assert len(np.unique(seen.reshape(-1, 3), axis=0)) > 20


def test_a_table_is_copied_as_csv(pages: dict[str, Path]) -> None:
    text = measured(pages["everything"], 1280)["csv"]
    rows = list(csv.reader(io.StringIO(text)))
    assert len({len(row) for row in rows}) == 1
    assert len(rows) > 2
    assert measured(pages["empty"], 390)["csv"] is None


@pytest.mark.parametrize(("scheme", "dark"), [(0, True), (1, False)])
def test_the_page_follows_the_scheme(
    pages: dict[str, Path], scheme: int, dark: bool
) -> None:
    """Paper and ink are those of the reader's choice, far apart in brightness."""
    option = f"--blink-settings=preferredColorScheme={scheme}"
    seen = picture(pages["everything"], 1280, option)
    paper = float(np.median(seen[:200]))
    assert (paper < 60.0) is dark
    assert np.ptp(seen[:200].astype(float)) > 150.0
