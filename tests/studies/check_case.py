"""A case whose teeth are to be checked, and what a script finds on its page `check.html`."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.artifacts.dental.corrections import Corrections, PhotoCorrection
from pipeline.artifacts.teeth import Teeth
from pipeline.store import Store
from pipeline.studies.report import run_report
from stages.dentition.corrections import apply_corrections
from tests import teeth_case as case
from tests.browser import browse, console
from tests.studies.report_case import write_result

#: What every script on the page begins and ends with.
BEGIN = """<script>
(async () => {
  const result = {};
  const wait = (ms = 50) => new Promise((done) => setTimeout(done, ms));
  const all = (query, inside = document) => [...inside.querySelectorAll(query)];
  const card = (k) => all("article")[k];
  const chip = (k, text) => all(".chip", card(k)).find((entry) => entry.textContent === text);
  const deed = (text) => all("#panel button").find((entry) => entry.textContent.startsWith(text));
  const press = (key, more = {}) => document.activeElement.dispatchEvent(
    new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...more }));
  const row = (k) => all(".chip:not(.gone)", card(k)).map((entry) => entry.textContent);
  const notes = (k) => card(k).querySelector(".notes").textContent;
"""
SAVE = """
  window.showSaveFilePicker = undefined;
  window.Blob = class { constructor(parts) { result.yaml = parts.join(""); } };
  URL.createObjectURL = () => "blob:x";
  HTMLAnchorElement.prototype.click = function () { result.download = this.download; };
  document.getElementById("save").click();
  await wait();
"""
END = """
  const text = document.createElement("pre");
  text.id = "result";
  text.textContent = JSON.stringify(result);
  document.body.append(text);
})();
</script></body>"""


def doubtful_case(
    folder: Path, teeth: Teeth | None = None, failure: str = "Doubtful.",
    corner: tuple[int, int] = (0, 0),
) -> Path:  # fmt: skip
    """A workspace in which init found teeth, but no safe result."""
    folder.mkdir()
    request = {"images": ["/photos"], "preset": None, "overrides": ["fit.iterations=20"],
               "stages": ["views", "init"], "from": None}  # fmt: skip
    (folder / "request.json").write_text(json.dumps(request))
    write_result(folder, "views", [case.views(corner=corner)])
    store = Store(folder)
    store.failures.keep("init", {}, {"teeth": teeth or case.teeth("it is <b>blurred</b>")})
    store.failures.record("init", "key", failure)
    return folder


#: A place where no crown is, be it that one was.
NOWHERE = (4.0, 8.0)


def corrected_case(
    folder: Path, read: Teeth, said: Mapping[str, PhotoCorrection], applied: bool = True
) -> Path:
    """A workspace of a run with this in its `teeth.yaml`; what is `NOWHERE` was said after it, or
    all of it."""
    there = {
        name: replace(photo, crowns=tuple(c for c in photo.crowns if c.at != NOWHERE))
        for name, photo in said.items()
    }
    teeth = apply_corrections(read, case.views(), Corrections(there)) if applied else read
    workspace = doubtful_case(folder, teeth)
    request = json.loads((workspace / "request.json").read_text())
    request["stages"] = ["views", "teeth", "init"]
    (workspace / "request.json").write_text(json.dumps(request))
    write_result(workspace, "teeth", [read])
    lines = ["photographs:"]
    for name, photo in said.items():
        lines += [f'  "{name}":', *["    mirrored: true"] * bool(photo.mirrored)]
        lines += [*["    use: false"] * (photo.use is False), "    crowns:"]
        for change in photo.crowns:
            what = f"tooth: {change.tooth}" if change.tooth else "remove: true"
            if change.split:
                what = f"split: {[list(place) for place in change.split]}"
            lines.append(f"    - {{at: {list(change.at)}, {what}}}")
    case.write(workspace / "teeth.yaml", "\n".join(lines))
    return workspace


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'id="data">(.*?)</script>', page, re.S)
    assert found
    return json.loads(found[1])


def probed(workspace: Path, folder: Path, *script: str) -> dict[str, Any]:
    """What a script finds on the page of a case."""
    run_report(workspace)
    page = workspace / "check.html"
    page.write_text(page.read_text().replace("</body>", "".join([BEGIN, *script, END])))
    folder.mkdir(exist_ok=True)
    dom, log = browse(page, folder, (1300, 900), "--dump-dom")
    assert console(log) == []
    found = re.search(r'<pre id="result">(.*?)</pre>', dom, re.S)
    assert found
    result: dict[str, Any] = json.loads(html.unescape(found[1]))
    return result
