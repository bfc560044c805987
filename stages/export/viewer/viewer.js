// The view of the scene: what the camera sees, in one pane or in two.

const byId = (id) => document.getElementById(id);
const root = document.documentElement;
root.dataset.state = "loading";

function report(error) {
  root.dataset.errors = `${root.dataset.errors ?? ""}${error?.message ?? error}\n`;
}

function fail(error) {
  report(error);
  root.dataset.state = "failed";
  byId("reason").textContent = `${error?.message ?? error} Try a recent Chrome, Edge, Firefox or `
    + "Safari with graphics acceleration switched on. splats.ply, from the same export, opens in "
    + "any viewer for 3D Gaussians.";
  byId("message").hidden = false;
  byId("bar").hidden = true;
}

addEventListener("error", (event) => report(event.error ?? event.message));
addEventListener("unhandledrejection", (event) => report(event.reason));

const BACKGROUNDS = [[0, 0, 0], [0.5, 0.5, 0.5], [1, 1, 1]];

class Viewer extends Screen {
  /** @param {object} scene as the page holds it @param {Splats} splats @param {Store} store */
  constructor(scene, splats, store) {
    super(byId("canvas"), scene.orbiting);
    this.scene = scene;
    this.splats = splats;
    this.store = store;
    this.renderer = new SplatRenderer(this.canvas, scene.format, splats, scene.shaders);
    this.positions = splats.positions;
    this.sorters = [this.#sorter(0)];
    this.marks = null;      // what is drawn over the scene
    this.background = 0;
    const own = scene.background;
    this.backgrounds = own.some((value) => value > 0) ? [own, ...BACKGROUNDS] : BACKGROUNDS;
    this.backdrop = this.backgrounds[0];
    this.exact = null;      // a pose set through the hook
    this.view = -1;         // the photograph whose camera this is, or -1
    this.lens = scene.first;  // the photograph whose lens this is
  }

  #sorter(pane) {
    return new Sorter(this.positions, (order) => {
      this.renderer.setOrder(order, pane);
      this.wake(false);
    });
  }

  sort(panes) {
    panes.forEach((pane, index) => {
      this.sorters[index] ??= this.#sorter(index);
      this.sorters[index].request(depthAxis(pane.pose));
    });
  }

  draw(panes) {
    const shown = this.shownParts();
    this.renderer.clear(this.backdrop);
    panes.forEach(({ pose, left }, pane) => {
      this.renderer.draw(pose, this.backdrop, shown, { pane, left });
    });
    this.#layPhoto(panes[0].pose);
    this.marks?.draw(panes);
  }

  /** What of the scene is drawn: jaw, section plane and overlays as the shaders take them. */
  shownParts() {
    const { jaw, support, mesh } = this.store.now;
    return { jaw: CHOICES.jaw.indexOf(jaw), cut: this.#cut(), support, mesh };
  }

  /** The section plane [4]: what has n . x > d is cut away. */
  #cut() {
    const { axis, at } = this.store.now;
    const number = { across: 0, height: 1, depth: 2 }[axis];
    if (number === undefined) return [0, 0, 0, 1];
    const normal = this.axes()[number];
    const { centre, radius } = this.scene.orbiting;
    return [...normal, dot(normal, centre) + at * radius];
  }

  /** The patient's left, up and out of the mouth; without teeth those of the photographs. */
  axes() {
    const { up, front } = this.scene.orbiting;
    return this.scene.axes ?? [cross(up, front), up, front];
  }

  /**
   * What is drawn where, in pixels of the canvas.
   * @returns {{pose: Pose, left: number}[]}
   */
  panes() {
    if (this.exact) {
      this.canvas.width = this.exact.width;
      this.canvas.height = this.exact.height;
      return [{ pose: this.exact, left: 0 }];
    }
    const [width, height] = this.fitCanvas();
    const { below, beside } = this.#covered();
    const [strip, side] = [below * height, Math.round(beside * width)];
    if (!this.store.now.sides) {
      return [{ pose: this.camera.fitted(width, height, strip, side), left: 0 }];
    }
    const half = Math.floor((width - side) / 2);
    const pose = this.camera.fitted(half, height, strip);
    const other = mirrored(pose, this.scene.orbiting.centre, unit(this.axes()[0]));
    return [{ pose, left: 0 }, { pose: other, left: half }];
  }

  /** Shares of the canvas that the controls cover: at the bottom, and at the right. */
  #covered() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const tools = byId("tools");
    const sheet = tools.offsetWidth > 0.8 * width;  // on phones it lies below
    return {
      below: Math.min(Math.max(byId("bar").offsetHeight, sheet ? tools.offsetHeight : 0) / height,
        0.5),
      beside: sheet || tools.hidden || byId("bar").hidden ? 0
        : Math.min(1 - tools.offsetLeft / width, 0.4),
    };
  }

  /** The pane and its pixel under a place on the page, and how many make one of the page. */
  paneAt(x, y) {
    const panes = this.panes();
    const box = this.canvas.getBoundingClientRect();
    const scale = this.canvas.width / box.width;
    const pixel = [(x - box.left) * scale, (y - box.top) * scale];
    const { pose, left } = panes[panes.length > 1 && pixel[0] >= panes[1].left ? 1 : 0];
    return { pose, x: pixel[0] - left, y: pixel[1], fine: scale };
  }

  /** The middle of the free part of the first pane, in pixels of the page. */
  crosshair() {
    const { pose } = this.panes()[0];
    const scale = this.canvas.clientWidth / this.canvas.width;
    const { left = 0, top = 0, width = pose.width, height = pose.height } = pose.frame ?? {};
    return [(left + width / 2) * scale, (top + height / 2) * scale];
  }

  #layPhoto(pose) {
    const photo = byId("photo");
    const shown = this.scene.views[this.view]?.photo;
    const alone = shown && !this.motion && !this.store.now.sides;
    const share = alone ? Number(byId("opacity").value) / 100 : 0;
    photo.style.opacity = share;
    if (!pose.frame || share === 0) return;
    for (const [side, whole] of
      [["left", pose.width], ["top", pose.height], ["width", pose.width], ["height", pose.height]]) {
      photo.style[side] = `${100 * pose.frame[side] / whole}%`;
    }
  }

  /** Sort and draw at once, as things stand at this moment, at full resolution. */
  render() {
    this.advance(performance.now());
    this.shown = 1;
    const panes = this.panes();
    panes.forEach(({ pose }, index) => {
      this.renderer.setOrder(backToFront(this.positions, depthAxis(pose)), index);
    });
    this.draw(panes);
  }

  /** The user moved the camera: it is no longer that of a photograph. */
  leave() {
    this.exact = null;
    if (this.view >= 0) {
      this.view = -1;
      byId("opacity").value = 0;
      this.#announce();
    }
    super.leave();
  }

  goTo(index, { still = false } = {}) {
    const pose = this.scene.views[index];
    if (!pose) return;
    this.stopTurning();
    this.exact = null;
    this.view = this.lens = index;
    if (pose.photo) byId("photo").src = pose.photo;
    this.#announce();
    this.approach(pose, still);
  }

  #announce() {
    byId("label").textContent = this.view >= 0 ? `View ${this.view + 1}` : "";
    for (const [index, button] of [...byId("views").children].entries()) {
      button.setAttribute("aria-pressed", index === this.view);
      if (index === this.view) button.scrollIntoView?.({ block: "nearest", inline: "nearest" });
    }
  }

  /** Stand where a link says. */
  stand({ rotation, target, distance, lens }) {
    this.goTo(lens, { still: true });
    Object.assign(this.camera, { rotation, target, distance });
    const home = this.scene.views[lens];
    const pose = this.camera.pose();
    const shift = Math.hypot(...minus(pose.translation, home.translation));
    const turn = Math.hypot(...pose.rotation.map((value, k) => value - home.rotation[k]));
    if (shift > 1e-3 * this.scene.orbiting.radius || turn > 1e-3) this.leave();
  }

  nearestView() {
    const towards = this.camera.rotation.slice(6, 9);
    const likeness = this.scene.views.map((view) => dot(view.rotation.slice(6, 9), towards));
    return likeness.indexOf(Math.max(...likeness));
  }

  startTurning() {
    this.leave();
    const range = this.scene.orbiting.turn;
    const { azimuth } = this.camera.angles();
    const middle = (range[0] + range[1]) / 2;
    const reach = Math.max((range[1] - range[0]) / 2, Math.abs(azimuth - middle), 0.05);
    const first = Math.asin(clamp((azimuth - middle) / reach, -1, 1));
    this.turning = { middle, reach, first, start: performance.now(), period: 4000 + 9000 * reach };
    byId("turn").setAttribute("aria-pressed", true);
    this.wake();
  }

  stopTurning() {
    super.stopTurning();
    byId("turn").setAttribute("aria-pressed", false);
  }

  nextBackground() {
    this.background = (this.background + 1) % this.backgrounds.length;
    this.backdrop = this.backgrounds[this.background];
    this.wake(false);
  }

  /** What is seen as a PNG: the scene, the photograph over it, numbers and marks. */
  async save() {
    this.render();
    const { width, height } = this.canvas;
    const paper = Object.assign(document.createElement("canvas"), { width, height });
    const brush = paper.getContext("2d");
    brush.drawImage(this.canvas, 0, 0);
    const photo = byId("photo");
    const share = Number(photo.style.opacity);
    if (share > 0) {
      const { left, top, width: wide, height: high } = this.panes()[0].pose.frame;
      brush.globalAlpha = share;
      brush.drawImage(photo, left, top, wide, high);
      brush.globalAlpha = 1;
    }
    brush.drawImage(await this.marks.picture(width, height), 0, 0, width, height);
    paper.toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = "dentalsplat.png";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }
}
