"""What the tests of reports look at: a page's text, what it fetches, and what a browser draws."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

from tests.browser import browse, console

PROBE = """<!doctype html><title>probe</title><body>
<iframe id="wide" style="width: 1200px; height: 900px" srcdoc="PAGE"></iframe>
<iframe id="phone" style="width: 390px; height: 800px" srcdoc="PAGE"></iframe>
<script>
onload = async () => {
  const result = {};
  for (const id of ["wide", "phone"]) {
    const page = document.getElementById(id).contentDocument;
    for (const entry of page.querySelectorAll("details")) entry.open = true;
    await new Promise((done) => setTimeout(done, 300));
    const images = [...page.images].filter((image) => !image.closest("dialog"));
    const root = page.documentElement;
    result[id] = {
      images: images.length,
      blank: images.filter((image) => !image.naturalWidth).map((image) => image.alt),
      charts: [...page.querySelectorAll("svg.chart")].map((chart) => {
        const box = chart.getBBox();
        return [box.width, box.height, chart.getBoundingClientRect().width];
      }),
      overflow: root.scrollWidth - root.clientWidth,
      requests: performance.getEntriesByType("resource").map((entry) => entry.name)
        .concat(page.defaultView.performance.getEntriesByType("resource").map((e) => e.name))
        .filter((name) => !name.startsWith("data:")),
    };
  }
  const page = document.getElementById("wide").contentDocument;
  const slider = page.querySelector(".compare input");
  if (slider) {
    slider.value = 20;
    slider.dispatchEvent(new Event("input"));
    result.at = page.querySelector(".compare").style.getPropertyValue("--at");
    const button = page.querySelector("img.zoom").closest("button");
    button?.focus();
    result.focused = page.activeElement === button;
    page.activeElement.click();
    result.zoomed = page.querySelector("dialog").open;
    const table = page.querySelector("table.sort");
    const sorting = () => [...table.querySelectorAll("th")].map((head) => head.ariaSort);
    table.querySelector("th button").click();
    result.sortings = [sorting()];
    table.querySelectorAll("th button")[1].click();
    result.sortings.push(sorting());
    result.sorted = [...table.tBodies[0].rows].map((row) => Number(row.cells[1].dataset.v));
  }
  const text = document.createElement("pre");
  text.id = "result";
  text.textContent = JSON.stringify(result);
  document.body.append(text);
};
</script></body>"""


def text_of(page: str) -> str:
    """What a reader sees: without pictures, styles and tags."""
    page = re.sub(r"<(style|script|svg)\b.*?</\1>", " ", page, flags=re.S)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]*>", " ", page)))


def assert_alone(page: str) -> None:
    """Nothing in the page leads to a file or an address that a browser would fetch."""
    outside = re.findall(
        r"<(?:script|link|img|iframe|source)[^>]*(?:src|href)=[\"'](?!data:)", page
    )
    assert outside == []
    assert not re.search(r"url\((?!#|\"?data:)", page)
    assert "@import" not in page
    assert "default-src 'none'" in page


def look(page: Path, folder: Path) -> dict[str, Any]:
    """Open a report at two widths in headless Chromium; what was drawn, and nothing complained."""
    file = folder / "probe.html"
    file.write_text(PROBE.replace("PAGE", html.escape(page.read_text())))
    dom, log = browse(file, folder, (1300, 1000), "--dump-dom")
    assert console(log) == []
    found = re.search(r'<pre id="result">(.*?)</pre>', dom, re.S)
    assert found, log[-2000:]
    result: dict[str, Any] = json.loads(html.unescape(found[1]))
    for width in ("wide", "phone"):
        seen = result[width]
        assert seen["blank"] == []
        assert seen["overflow"] <= 0
        assert seen["requests"] == []
        assert all(w > 100 and h > 100 and shown > 100 for w, h, shown in seen["charts"])
    return result
