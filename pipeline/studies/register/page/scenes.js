// Both visits' scenes on one canvas: one camera, and an edge or a share between them.
//
// `window.visits` offers, for tests: `ready`, a promise; and from then on `pair`. Progress is kept in
// <html data-scenes>: "live", or "pictures" where the page keeps its still pictures.

const WHOLE = { jaw: 0, cut: [0, 0, 0, 1], support: false, mesh: false };
const element = (id) => document.getElementById(id);

class Pair extends Screen {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {object} page see `live_scenes` in live.py
   * @param {Splats[]} both
   */
  constructor(canvas, page, both) {
    super(canvas, page.orbiting);
    this.page = page;
    this.mode = "wipe";
    this.at = 0.5;  // where the edge is from the left, or the share of the second visit
    this.visits = page.scenes.map(({ format, from_common: frame }, index) => {
      const renderer = new SplatRenderer(canvas, format, both[index], page.shaders);
      const sorter = new Sorter(both[index].positions, (order) => {
        renderer.setOrder(order);
        this.wake(false);
      });
      return { renderer, sorter, frame, positions: both[index].positions };
    });
  }

  panes() {
    const [width, height] = this.fitCanvas();
    return [{ pose: this.camera.fitted(width, height), left: 0 }];
  }

  sort([{ pose }]) {
    for (const { sorter, frame } of this.visits) sorter.request(depthAxis(carried(pose, frame)));
  }

  draw([{ pose }]) {
    const edge = Math.round(this.at * pose.width);
    const where = this.mode === "wipe" ? [{ to: edge }, { from: edge }] : [{}, { share: this.at }];
    this.visits.forEach(({ renderer, frame }, index) => {
      renderer.draw(carried(pose, frame), this.page.background, WHOLE, where[index]);
    });
  }

  /** Sort and draw at once, at full resolution. */
  render() {
    this.advance(performance.now());
    this.shown = 1;
    const panes = this.panes();
    for (const { renderer, frame, positions } of this.visits) {
      renderer.setOrder(backToFront(positions, depthAxis(carried(panes[0].pose, frame))));
    }
    this.draw(panes);
  }

  /** The drawn picture, RGBA bytes, bottom row first. */
  pixels() {
    this.render();
    const { gl } = this.visits[0].renderer;
    const { width, height } = this.canvas;
    const bytes = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }

  /** @param {"wipe" | "fade"} mode @param {number} at in 0..1 */
  show(mode, at) {
    this.mode = mode;
    this.at = clamp(at, 0, 1);
    const slider = element("between");
    const percent = Math.round(100 * this.at);
    slider.value = percent;
    slider.setAttribute("aria-valuetext", mode === "wipe"
      ? `first visit on the left ${percent} %, second visit on the right ${100 - percent} %`
      : `${100 - percent} % first visit, ${percent} % second visit`);
    element("between-name").textContent = mode === "wipe" ? "Edge" : "Blend";
    element("edge").hidden = mode !== "wipe";
    element("edge").style.left = `${100 * this.at}%`;
    for (const name of ["wipe", "fade"]) element(name).setAttribute("aria-pressed", mode === name);
    element("live").dataset.mode = mode;
    element("live").style.setProperty("--at", this.at);
    this.wake(false);
  }

  goTo(index, still = false) {
    this.approach(this.page.places[index], still);
    this.#mark(index);
  }

  leave() {
    this.#mark(-1);
    super.leave();
  }

  #mark(place) {
    for (const [index, button] of [...element("places").children].entries()) {
      button.setAttribute("aria-pressed", index === place);
    }
  }
}

/** The edge can be taken and drawn along the canvas. */
function addEdge(pair) {
  const edge = element("edge");
  edge.addEventListener("pointerdown", (event) => {
    edge.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  edge.addEventListener("pointermove", (event) => {
    if (!edge.hasPointerCapture(event.pointerId)) return;
    const box = pair.canvas.getBoundingClientRect();
    pair.show("wipe", (event.clientX - box.left) / box.width);
  });
}

function addControls(pair) {
  const stage = element("live");
  element("between").addEventListener("input", (event) => {
    pair.show(pair.mode, event.target.value / 100);
  });
  for (const name of ["wipe", "fade"]) {
    element(name).addEventListener("click", () => pair.show(name, pair.at));
  }
  [...element("places").children].forEach((button, index) => {
    button.addEventListener("click", () => pair.goTo(index));
  });
  element("swap").addEventListener("click", () => pair.show(pair.mode, pair.at < 0.5 ? 1 : 0));
  const full = element("whole");
  full.hidden = !stage.requestFullscreen;
  full.addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else stage.requestFullscreen().catch(() => {});
  });
  const alone = () => document.fullscreenElement === stage;
  addEdge(pair);
  addPointers(pair, undefined, () => alone() || document.activeElement === pair.canvas);
  const keys = {
    ...steeringKeys(pair),
    "[": () => pair.show(pair.mode, pair.at - 0.05), "]": () => pair.show(pair.mode, pair.at + 0.05),
    r: () => pair.goTo(pair.page.first),
  };
  pair.canvas.addEventListener("keydown", (event) => {
    const key = keyOf(event, keys);
    if (!keys[key]) return;
    keys[key](event.shiftKey);
    event.preventDefault();
  });
}

async function startPair() {
  const page = JSON.parse(element("scenes").textContent);
  const both = await Promise.all(page.scenes.map(
    ({ format }, index) => unpacked(element(`splats-${index}`).textContent, format)));
  const stage = element("live");
  const show = (live) => {
    stage.hidden = !live;
    document.documentElement.dataset.scenes = live ? "live" : "pictures";
  };
  const pair = new Pair(element("both"), page, both);
  addControls(pair);
  show(true);
  pair.show("wipe", 0.5);
  pair.goTo(page.first, true);
  pair.render();
  new ResizeObserver(() => pair.wake(false)).observe(pair.canvas);
  const restore = () => {
    for (const { renderer } of pair.visits) renderer.restore();
    pair.wake();
  };
  keepContext(pair.canvas, restore, (gone) => show(!gone));
  window.visits.pair = pair;
}

window.visits = {};
window.visits.ready = startPair().catch((error) => {
  element("live").hidden = true;
  document.documentElement.dataset.scenes = "pictures";
  document.documentElement.dataset.problem = String(error?.message ?? error);
});
