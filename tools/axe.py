"""Look for barriers in a page with a scene with axe-core (https://github.com/dequelabs/axe-core).

    npm install axe-core
    python tools/axe.py node_modules/axe-core/axe.min.js runs/demo/results/viewer.html

Runs axe in Chromium at 1280 and 390 pixels; in a viewer page with the tools open, the help open and
neither. Exit status 1 if it finds anything.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.browser import run_in  # noqa: E402

SIZES = ((1280, 800), (390, 780))
SCRIPT = """
(async () => {
  await (window.dentalsplat ?? window.visits)?.ready;
  const press = (key) => document.body.dispatchEvent(
    new KeyboardEvent("keydown", { key, bubbles: true }));
  const found = {};
  for (const [state, keys] of [["plain", ""], ["tools", "tvux"], ["help", "th"]]) {
    for (const key of keys) press(key);
    const { violations, passes } = await axe.run(document, { resultTypes: ["violations"] });
    found[state] = { passes: passes.length, violations: violations.map((v) =>
      [v.id, v.impact, v.help, v.nodes.map((node) => node.html.slice(0, 160))]) };
  }
  tell(found);
})().catch((error) => tell({ failed: String(error) }));
"""


def main(axe: Path, page: Path) -> int:
    """Print what axe says of the page in each state; returns the exit status."""
    count = 0
    for size in SIZES:
        with tempfile.TemporaryDirectory() as folder:
            script = f"{axe.read_text()}\n</script><script>{SCRIPT}"
            found, _ = run_in(page.read_text(), script, Path(folder), size)
        if "failed" in found:
            print(f"{size[0]} px: {found['failed']}")
            return 1
        for state, said in found.items():
            print(f"{size[0]} px, {state}: {said['passes']} rules passed, "
                  f"{len(said['violations'])} violated")  # fmt: skip
            for rule, impact, text, nodes in said["violations"]:
                print(f"  {rule} ({impact}): {text}")
                print("".join(f"    {node}\n" for node in nodes), end="")
            count += len(said["violations"])
    return 1 if count else 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
